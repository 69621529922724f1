//! Maximum over the channels, NaN if one is; its gradient is shared equally between ties.

use super::{Form, Op, Sample, expect_dtype, pointwise::unary, reduce::{larger, without_nan}};
use crate::cost::Work;
use crate::graph::{Channels, Misfit, Shape, Tensor, function};
use crate::reference::{Array, Lane};
use crate::scalar::DType;

#[derive(Clone, Debug)]
pub struct ChannelMax;

impl Op for ChannelMax {
    fn name(&self) -> &'static str {
        "max_channels"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        Ok(inputs[0].clone().with_channels(Channels::Vector(1)))
    }
    fn form(&self) -> Form {
        Form::ChannelMax
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let channels = inputs[0].shape.channels.count();
        Array::from_fn(out, |e, _| {
            let lanes = (0..channels).map(|c| inputs[0].at(e, c).f());
            Lane::F(lanes.fold(f64::NEG_INFINITY, larger))
        })
    }
    fn vjp(&self, inputs: &[Tensor], output: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let hit = inputs[0].equal(output).to_f32();
        // At least one: NaN equals nothing.
        let ties = hit.sum_channels().max(&Tensor::scalar(1.0));
        vec![Some(hit * (g / ties))]
    }
    fn work(&self, inputs: &[Shape], _: &Shape) -> Work {
        Work::others(inputs[0].channels.count() as u64)
    }
}

impl Tensor {
    /// Maximum over all channels.
    #[track_caller]
    pub fn max_channels(&self) -> Tensor {
        Tensor::record(ChannelMax, &[self])
    }
    /// Minimum over all channels.
    #[track_caller]
    pub fn min_channels(&self) -> Tensor {
        let _called = function("min_channels");
        -(-self).max_channels()
    }
    /// The channel of the largest value as `u32`, of equal ones the first. NaN is larger than nothing.
    #[track_caller]
    pub fn argmax_channels(&self) -> Tensor {
        let _called = function("argmax_channels");
        // Not the channel that equals the maximum: a value computed twice may differ in its rounding.
        let number = without_nan(self);
        let mut most = number.ch(0);
        let mut at = most.less_than(&most);
        for c in 1..self.width() {
            let next = number.ch(c);
            let above = most.less_than(&next);
            at = above.select(&Tensor::integers(&[c as u32]), &at);
            most = above.select(&next, &most);
        }
        at
    }
    /// The channel of the smallest value, likewise.
    #[track_caller]
    pub fn argmin_channels(&self) -> Tensor {
        let _called = function("argmin_channels");
        (-self).argmax_channels()
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        unary("max_channels", -1.0, 1.0, Tensor::max_channels),
        unary("min_channels", -1.0, 1.0, Tensor::min_channels),
        unary("argmax_channels", -1.0, 1.0, |x| x.argmax_channels().to_f32()).not_differentiable(),
        unary("argmin_channels", -1.0, 1.0, |x| x.argmin_channels().to_f32()).not_differentiable(),
    ]
}
