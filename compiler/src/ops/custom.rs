//! A value with a gradient rule of its own.

use super::identity::same_lanes;
use super::{Form, Op, Sample, SampleInput};
use crate::graph::{Misfit, Shape, Tensor};
use crate::reference::Array;
use std::fmt;
use std::sync::Arc;

type Rule = dyn Fn(&[Tensor], &Tensor) -> Vec<Option<Tensor>> + Send + Sync;

/// Operand 0, whose gradient goes to the other operands by `rule`.
pub struct Custom {
    rule: Arc<Rule>,
}

impl fmt::Debug for Custom {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "custom {:p}", Arc::as_ptr(&self.rule))
    }
}

impl Op for Custom {
    fn name(&self) -> &'static str {
        "custom_adjoint"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        Ok(inputs[0].clone())
    }
    fn form(&self) -> Form {
        Form::Identity
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        same_lanes(inputs[0], out)
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let mut grads = vec![None];
        grads.extend((self.rule)(&inputs[1..], g));
        grads
    }
}

/// `value`, differentiated by `rule` instead of by what it is computed from: `rule(inputs, grad)` gives the gradient of
/// each of `inputs`. Test it against the composed gradient; second derivatives go through what the rule records.
#[track_caller]
pub fn custom_adjoint(
    value: &Tensor,
    inputs: &[&Tensor],
    rule: impl Fn(&[Tensor], &Tensor) -> Vec<Option<Tensor>> + Send + Sync + 'static,
) -> Tensor {
    let mut operands = vec![value];
    operands.extend(inputs);
    Tensor::record(Custom { rule: Arc::new(rule) }, &operands)
}

pub fn samples() -> Vec<Sample> {
    // x^3 by a rule of its own: the checks compare it with central differences like any other op.
    vec![Sample::new("custom_adjoint", vec![SampleInput::new(Shape::new(&[], 3), 0.5, 1.5)], |x| {
        custom_adjoint(&(&x[0] * &x[0] * &x[0]), &[&x[0]], |x, g| vec![Some(g * &x[0] * &x[0] * 3.0)])
    })]
}
