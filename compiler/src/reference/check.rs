//! Central differences in the f64 interpreter.

use super::{Array, Bindings, EvalError, evaluate};
use crate::graph::Tensor;
use crate::scalar::DType;

/// Which way an input moves.
pub enum Direction<'a> {
    /// Along a given vector, one value a lane.
    Along(&'a [f64]),
    /// One lane alone.
    Lane(usize),
}

/// Derivative of the sum of `output` when input `name` moves along `direction`: central differences of step `step`,
/// extrapolated once (Richardson), so the error is of fourth order.
///
/// # Errors
/// If `output` cannot be evaluated or is of whole numbers, or no float input `name` has a value with such a direction.
pub fn central_difference(
    output: &Tensor,
    bindings: &Bindings,
    name: &str,
    direction: &Direction,
    step: f64,
) -> Result<f64, EvalError> {
    let problem = match (bindings.get(name), direction) {
        _ if output.dtype() == DType::U32 => Some("the output is of whole numbers".to_string()),
        (None, _) => Some("no input of that name has a value".to_string()),
        (Some(array), _) if array.shape.dtype == DType::U32 => Some(format!("it is {}", array.shape)),
        (Some(array), Direction::Along(v)) if v.len() != array.shape.lanes() => {
            Some(format!("the direction has {} numbers, the input is {}", v.len(), array.shape))
        }
        (Some(array), Direction::Lane(i)) if *i >= array.shape.lanes() => {
            Some(format!("there is no lane {i}, the input is {}", array.shape))
        }
        _ => None,
    };
    if let Some(problem) = problem {
        return Err(EvalError::Difference { name: name.into(), problem });
    }
    let at = |t: f64| -> Result<f64, EvalError> {
        let mut moved = bindings.clone();
        if let Some(array) = moved.get_mut(name) {
            shift(array, direction, t);
        }
        Ok(evaluate(std::slice::from_ref(output), &moved)?[0].f().iter().sum())
    };
    let slope = |h: f64| -> Result<f64, EvalError> { Ok((at(h)? - at(-h)?) / (2.0 * h)) };
    let (coarse, fine) = (slope(step)?, slope(step / 2.0)?);
    Ok((4.0 * fine - coarse) / 3.0)
}

fn shift(array: &mut Array, direction: &Direction, by: f64) {
    match direction {
        Direction::Along(v) => array.f_mut().iter_mut().zip(*v).for_each(|(x, d)| *x += by * d),
        Direction::Lane(i) => array.f_mut()[*i] += by,
    }
}
