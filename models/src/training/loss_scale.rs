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
fn grouped(x: &Tensor, count: usize) -> Tensor {
    let all = x.channels().count() as u32;
    x.channel_groups((0..count as u32).map(|first| (first..all).step_by(count).collect()).collect())
}

/// States of the session: the scale, where 0 stands for its first value, and the steps since it last changed.
pub const STATES: [&str; 2] = ["loss_scale", "loss_scale.steps"];

/// The scale of a step, see [`STATES`].
pub struct LossScale {
    held: Tensor,
    steps: Tensor,
    scale: Tensor,
}

impl LossScale {
    pub fn new() -> LossScale {
        let state = |name| Tensor::input(name, Role::State, Shape::new(&[], 1));
        let [held, steps] = STATES.map(state);
        let scale = held.equal(&Tensor::scalar(0.0)).select(&Tensor::scalar(START), &held);
        LossScale { held, steps, scale }
    }

    /// What to differentiate.
    pub fn scaled(&self, loss: &Tensor) -> Tensor {
        loss * &self.scale
    }

    /// A parameter's gradient from that of the scaled loss.
    pub fn unscaled(&self, gradient: &Tensor) -> Tensor {
        gradient / &self.scale
    }

    /// Whether all gradients are finite: a mask without axes. A sum of squares beyond all floats counts as infinite.
    ///
    /// Channels are summed in groups, because a GPU takes one invocation a sum.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimise::{Rates, Training};
    use raygrad_compiler::functions::mlp::{Init, Parameter};
    use raygrad_compiler::{Step, compile};
    use raygrad_runtime::{Device, ProgramId, Session};

    const LANES: usize = 5000;

    /// A step of `loss = sum factor p`, whose gradient is the factor.
    fn session() -> (Session, ProgramId) {
        let p = Tensor::parameter("p", Shape::new(&[], LANES));
        let factor = Tensor::data("factor", Shape::new(&[], LANES));
        let loss = (&p * factor).sum_channels();
        let parameter = Parameter { tensor: p, init: Init::Zero, trained: true };
        let optim = crate::config::Layered::load("planar-l2g").unwrap().settings.optim;
        let training = Training { field: &[parameter], warp: &[], held: None, optim: &optim, scaled: true };
        let updates = training.updates(&loss);
        let device = Device::cpu(Some(1)).unwrap();
        let mut session = Session::new(device.clone()).unwrap();
        let program = compile(&Step { outputs: vec![], updates }, &device.target()).unwrap();
        let program = session.add(program).unwrap();
        for (name, value) in Rates::at(&optim, 0).inputs() {
            if session.inputs().any(|(n, _)| n == name) {
                session.set(name, &[value as f32]).unwrap();
            }
        }
        (session, program)
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing_but_the_scale() {
        let (mut session, program) = session();
        let mut factor = vec![1e-3; LANES];
        session.set("factor", &factor).unwrap();
        session.run(program).unwrap();
        let before = ["p", "adam.m.p", "adam.v.p"].map(|n| session.get(n).unwrap());
        assert!(before.iter().all(|v| v.iter().all(|x| *x != 0.0 && x.is_finite())));
        // The moments are those of the gradient itself, not of the scaled one.
        assert!((before[1][7] - 1e-4).abs() < 1e-9, "{}", before[1][7]);
        assert_eq!(session.get("loss_scale").unwrap(), [START as f32]);
        assert_eq!(session.get("loss_scale.steps").unwrap(), [1.0]);
        for (bad, scale) in [(f32::INFINITY, START / 2.0), (f32::NAN, START / 4.0), (1e38, START / 8.0)] {
            factor[LANES - 3] = bad;
            session.set("factor", &factor).unwrap();
            session.run(program).unwrap();
            let after = ["p", "adam.m.p", "adam.v.p"].map(|n| session.get(n).unwrap());
            assert!(after == before, "{bad}");
            assert_eq!(session.get("loss_scale").unwrap(), [scale as f32], "{bad}");
            assert_eq!(session.get("loss_scale.steps").unwrap(), [0.0], "{bad}");
        }
        factor[LANES - 3] = 1e-3;
        session.set("factor", &factor).unwrap();
        session.run(program).unwrap();
        assert!(session.get("p").unwrap().iter().zip(&before[0]).all(|(a, b)| a != b));
    }

    #[test]
    fn the_scale_grows_after_patience() {
        let (mut session, program) = session();
        session.set("factor", &vec![1e-3; LANES]).unwrap();
        for (steps, scale) in [(PATIENCE - 2.0, START), (PATIENCE - 1.0, 2.0 * START)] {
            session.set("loss_scale", &[START as f32]).unwrap();
            session.set("loss_scale.steps", &[steps as f32]).unwrap();
            session.run(program).unwrap();
            assert_eq!(session.get("loss_scale").unwrap(), [scale as f32]);
        }
        assert_eq!(session.get("loss_scale.steps").unwrap(), [0.0]);
        session.set("loss_scale", &[MOST as f32]).unwrap();
        session.set("loss_scale.steps", &[PATIENCE as f32]).unwrap();
        session.run(program).unwrap();
        assert_eq!(session.get("loss_scale").unwrap(), [MOST as f32]);
    }
}
