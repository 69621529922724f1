//! Sums over groups of channels; the adjoint of picking channels.

use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::cost::Work;
use crate::graph::{Axis, Channels, Misfit, Shape, Tensor};
use crate::reference::{Array, Lane};
use crate::scalar::DType;
use std::sync::Arc;

/// Output channel `j` is the sum of the input channels in `groups[j]`; an empty group gives 0.
#[derive(Clone, Debug)]
pub struct ChannelSum(pub Arc<[Vec<u32>]>);

impl Op for ChannelSum {
    fn name(&self) -> &'static str {
        "sum_channels"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        let has = inputs[0].channels;
        if let Some(c) = self.0.iter().flatten().find(|c| **c as usize >= has.count()) {
            return Err(Misfit::new(
                format!("channel {c} of a tensor with {has} channels"),
                format!("channels 0 to {} exist", has.count() - 1),
            ));
        }
        if self.0.is_empty() {
            return Err(Misfit::new("no groups of channels", "give at least one group"));
        }
        Ok(inputs[0].clone().with_channels(Channels::Vector(self.0.len())))
    }
    fn form(&self) -> Form {
        Form::ChannelSum(self.0.clone())
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        Array::from_fn(out, |e, j| Lane::F(self.0[j].iter().map(|c| inputs[0].at(e, *c as usize).f()).sum()))
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let mut back = vec![vec![]; inputs[0].width()];
        for (j, group) in self.0.iter().enumerate() {
            for c in group {
                back[*c as usize].push(j as u32);
            }
        }
        vec![Some(g.channel_groups(back).reshape(inputs[0].channels()))]
    }
    fn key(&self) -> String {
        let mut hash = blake3::Hasher::new();
        for group in self.0.iter() {
            hash.update(&(group.len() as u32).to_le_bytes());
            for c in group {
                hash.update(&c.to_le_bytes());
            }
        }
        format!("sum_channels {}", hash.finalize())
    }
    fn work(&self, _: &[Shape], _: &Shape) -> Work {
        Work::others(self.0.iter().map(|g| g.len() as u64).sum())
    }
}

impl Tensor {
    /// Sum over all channels.
    #[track_caller]
    pub fn sum_channels(&self) -> Tensor {
        if self.width() == 1 {
            return self.reshape(1);
        }
        self.channel_groups(vec![(0..self.width() as u32).collect()])
    }
    /// Sums over groups of channels: one output channel a group.
    #[track_caller]
    pub fn channel_groups(&self, groups: Vec<Vec<u32>>) -> Tensor {
        Tensor::record(ChannelSum(groups.into()), &[self])
    }
    /// Mean over all channels.
    #[track_caller]
    pub fn mean_channels(&self) -> Tensor {
        self.sum_channels() * (1.0 / self.width() as f64)
    }
}

pub fn samples() -> Vec<Sample> {
    let row = Axis::new("row", 3);
    let x = || vec![SampleInput::new(Shape::new(&[&row], 4), -1.0, 1.0)];
    vec![
        Sample::new("sum_channels", x(), |x| x[0].sum_channels()),
        Sample::new("channel_groups", x(), |x| x[0].channel_groups(vec![vec![1, 3], vec![], vec![2], vec![0, 1, 2]])),
    ]
}
