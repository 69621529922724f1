//! Central differences in the f64 interpreter.

use super::{Array, Bindings, EvalError, evaluate};
use crate::graph::Tensor;

/// Which way an input moves.
pub enum Direction<'a> {
    /// Along a given vector, one value a lane.
    Along(&'a [f64]),
    /// One lane alone.
    Lane(usize),
}

/// Derivative of the sum of `output` when input `name` moves along `direction`: central differences of step `step`,
/// extrapolated once (Richardson), so the error is of fourth order.
pub fn central_difference(
    output: &Tensor,
    bindings: &Bindings,
    name: &str,
    direction: &Direction,
    step: f64,
) -> Result<f64, EvalError> {
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
