//! Dynamic loss scaling (Micikevicius et al., Mixed precision training, ICLR 2018, section 3.2), as part of the step's graph.
//!
//! Gradients of the layers' outputs are stored in half precision, whose numbers end at 6e-8 and 65504. The loss is multiplied
//! by a scale before it is differentiated, and every parameter's gradient divided by it. If a gradient is not finite, the step
//! changes no parameter and no moment, and the scale is halved; after [`PATIENCE`] steps without that it is doubled.

use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Shape, Tensor};

const START: f64 = 65536.0;
const LEAST: f64 = 1.0;
const MOST: f64 = 16_777_216.0;
/// Steps with finite gradients after which the scale grows.
const PATIENCE: f64 = 1000.0;

/// Sums of channels that many invocations compute, and that few do.
const MANY: usize = 1024;
const FEW: usize = 64;

/// Sums of every `count`th channel.
#[track_caller]
fn grouped(x: &Tensor, count: usize) -> Tensor {
    let all = x.channels().count() as u32;
    x.channel_groups((0..count as u32).map(|first| (first..all).step_by(count).collect()).collect())
}

/// The scale of a step. States of the session: `loss_scale`, where 0 stands for its first value, and `loss_scale.steps`, the
/// steps since it last changed.
pub struct LossScale {
    held: Tensor,
    steps: Tensor,
    scale: Tensor,
}

impl LossScale {
    #[track_caller]
    pub fn new() -> LossScale {
        let state = |name| Tensor::input(name, Role::State, Shape::new(&[], 1));
        let (held, steps) = (state("loss_scale"), state("loss_scale.steps"));
        let scale = held.equal(&Tensor::scalar(0.0)).select(&Tensor::scalar(START), &held);
        LossScale { held, steps, scale }
    }

    /// What to differentiate.
    #[track_caller]
    pub fn scaled(&self, loss: &Tensor) -> Tensor {
        loss * &self.scale
    }

    /// A parameter's gradient from that of the scaled loss.
    #[track_caller]
    pub fn unscaled(&self, gradient: &Tensor) -> Tensor {
        gradient / &self.scale
    }

    /// Whether all gradients are finite: a mask without axes. A sum of squares beyond all floats counts as infinite.
    ///
    /// Channels are summed in groups, because a GPU takes one invocation a sum.
    #[track_caller]
    pub fn finite(gradients: &[Tensor]) -> Tensor {
        let squares = gradients.iter().map(|g| {
            let square = g * g;
            let square = if g.axes().is_empty() { square } else { square.sum_over(g.axes()) };
            let square = square.reshape(square.channels().count());
            if square.channels().count() > 4 * MANY { grouped(&square, MANY) } else { square }
        });
        let few = squares.map(|s| if s.channels().count() > FEW { grouped(&s, FEW) } else { s.sum_channels() });
        let sum = few.reduce(|a, b| a + b).unwrap_or_else(|| Tensor::scalar(0.0)).sum_channels();
        sum.less_equal(&Tensor::scalar(f64::from(f32::MAX)))
    }

    /// The scale's own updates after a step.
    #[track_caller]
    pub fn updates(self, finite: &Tensor) -> Vec<(Tensor, Tensor)> {
        let zero = Tensor::scalar(0.0);
        let counted = finite.select(&(&self.steps + 1.0), &zero);
        let grows = counted.greater_equal(&Tensor::scalar(PATIENCE));
        let good = grows.select(&(&self.scale * 2.0), &self.scale);
        let next = finite.select(&good, &(&self.scale * 0.5)).clamp(LEAST, MOST);
        let steps = grows.select(&zero, &counted);
        vec![(self.held, next), (self.steps, steps)]
    }
}
