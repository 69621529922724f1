//! Evaluates a graph in f64, node by node.

use super::array::Array;
use crate::graph::{RecordError, Shape, Tensor, topological};
use std::collections::HashMap;

/// Values of named inputs.
pub type Bindings = HashMap<String, Array>;

#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    #[error("{0}")]
    Record(Box<RecordError>),
    #[error("input `{name}` ({shape}) has no value")]
    Unbound { name: String, shape: Box<Shape> },
    #[error("input `{name}` is {expected}, but the value given is {found}")]
    Shape { name: String, expected: Box<Shape>, found: Box<Shape> },
    #[error("central differences by `{name}`: {problem}")]
    Difference { name: String, problem: String },
}

/// Values of `roots`, given the values of the inputs they depend on.
pub fn evaluate(roots: &[Tensor], bindings: &Bindings) -> Result<Vec<Array>, EvalError> {
    if let Some(e) = roots.iter().find_map(Tensor::error) {
        return Err(EvalError::Record(Box::new(e.clone())));
    }
    let order = topological(roots.iter().cloned());
    let mut uses: HashMap<u64, usize> = HashMap::new();
    for t in order.iter().flat_map(|t| t.inputs()).chain(roots) {
        *uses.entry(t.id()).or_default() += 1;
    }
    let mut values: HashMap<u64, Array> = HashMap::new();
    for t in &order {
        let value = match t.input_name() {
            Some(name) => bound(name, t.shape(), bindings)?,
            None => {
                let inputs: Vec<&Array> = t.inputs().iter().map(|i| &values[&i.id()]).collect();
                t.op().eval(&inputs, t.shape())
            }
        };
        values.insert(t.id(), value);
        for i in t.inputs() {
            if let Some(n) = uses.get_mut(&i.id()) {
                *n -= 1;
                if *n == 0 {
                    values.remove(&i.id());
                }
            }
        }
    }
    Ok(roots.iter().map(|r| values[&r.id()].clone()).collect())
}

fn bound(name: &str, shape: &Shape, bindings: &Bindings) -> Result<Array, EvalError> {
    let value =
        bindings.get(name).ok_or_else(|| EvalError::Unbound { name: name.into(), shape: Box::new(shape.clone()) })?;
    if value.shape != *shape {
        return Err(EvalError::Shape {
            name: name.into(),
            expected: Box::new(shape.clone()),
            found: Box::new(value.shape.clone()),
        });
    }
    Ok(value.clone())
}
