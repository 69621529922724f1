//! Ops whose value is their operand: reshaped channels and stop-gradient.

use super::{Form, Op, Sample, SampleInput};
use crate::graph::{Channels, Misfit, Shape, Tensor};
use crate::reference::{Array, Data};

/// The same lanes with other channels, row by row.
#[derive(Clone, Debug)]
pub struct Reshape(pub Channels);

impl Op for Reshape {
    fn name(&self) -> &'static str {
        "reshape"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        let n = inputs[0].channels.count();
        if self.0.count() != n {
            return Err(Misfit::new(
                format!("{} channels cannot be seen as {}", inputs[0].channels, self.0),
                format!("the counts must agree: {n} here"),
            ));
        }
        Ok(inputs[0].clone().with_channels(self.0))
    }
    fn form(&self) -> Form {
        Form::Identity
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        same_lanes(inputs[0], out)
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.reshape(inputs[0].channels()))]
    }
}

/// The operand, without a gradient.
#[derive(Clone, Debug)]
pub struct StopGradient;

impl Op for StopGradient {
    fn name(&self) -> &'static str {
        "stop_gradient"
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
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None]
    }
}

pub(crate) fn same_lanes(a: &Array, out: &Shape) -> Array {
    match &a.data {
        Data::F(v) => Array::floats(out, v.clone()),
        Data::U(v) => Array::integers(out, v.clone()),
    }
}

impl Tensor {
    /// The same channels in another arrangement, for example 9 channels as a `(3, 3)` matrix, row by row.
    #[track_caller]
    pub fn reshape(&self, channels: impl Into<Channels>) -> Tensor {
        let channels = channels.into();
        if channels == self.channels() { self.clone() } else { Tensor::record(Reshape(channels), &[self]) }
    }
    /// This value as a constant: no gradient passes.
    #[track_caller]
    pub fn stop_gradient(&self) -> Tensor {
        Tensor::record(StopGradient, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    let x = || vec![SampleInput::new(Shape::new(&[], 6), -1.0, 1.0)];
    vec![
        Sample::new("reshape", x(), |x| x[0].reshape((2, 3))),
        Sample::new("stop_gradient", x(), |x| &x[0] * x[0].stop_gradient()).not_differentiable(),
    ]
}
