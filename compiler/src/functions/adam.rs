//! The Adam update (Kingma and Ba, Adam: a method for stochastic optimization, ICLR 2015, algorithm 1) as a graph.
//!
//! ```text
//! m' = beta1 m + (1 - beta1) g,   v' = beta2 v + (1 - beta2) g^2
//! p' = p - lr (m' / (1 - beta1^t)) / (sqrt(v' / (1 - beta2^t)) + epsilon)
//! ```
//!
//! What depends on the step comes as tensors, so no step recompiles anything.

use crate::graph::Tensor;
use crate::ops::input::Role;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    pub beta1: f64,
    pub beta2: f64,
    pub epsilon: f64,
}

impl Default for Adam {
    fn default() -> Adam {
        Adam { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 }
    }
}

/// Values of one step, one channel each.
#[derive(Clone, Debug)]
pub struct StepScalars {
    /// Learning rate.
    pub lr: Tensor,
    /// `1 / (1 - beta1^t)` at step t = 1, 2, ...
    pub bias1: Tensor,
    /// `1 / (1 - beta2^t)`.
    pub bias2: Tensor,
}

/// First and second moment of a parameter's gradient.
#[derive(Clone, Debug)]
pub struct Moments {
    pub m: Tensor,
    pub v: Tensor,
}

impl Moments {
    /// The state that belongs to `parameter`: inputs `adam.m.{name}` and `adam.v.{name}`, zero at first.
    #[track_caller]
    pub fn of(parameter: &Tensor) -> Moments {
        let name = parameter.input_name().unwrap_or("unnamed");
        Moments {
            m: Tensor::input(format!("adam.m.{name}"), Role::State, parameter.shape().clone()),
            v: Tensor::input(format!("adam.v.{name}"), Role::State, parameter.shape().clone()),
        }
    }
}

impl Adam {
    /// `(1 / (1 - beta1^t), 1 / (1 - beta2^t))`, for the host to fill [`StepScalars`] with; `t` counts from 1.
    pub fn bias_corrections(&self, t: u64) -> (f64, f64) {
        let correction = |beta: f64| 1.0 / (1.0 - beta.powf(t as f64));
        (correction(self.beta1), correction(self.beta2))
    }

    /// The parameter and its moments after one step.
    #[track_caller]
    pub fn update(
        &self,
        parameter: &Tensor,
        gradient: &Tensor,
        old: &Moments,
        step: &StepScalars,
    ) -> (Tensor, Moments) {
        let m = &old.m * self.beta1 + gradient * (1.0 - self.beta1);
        let v = &old.v * self.beta2 + gradient * gradient * (1.0 - self.beta2);
        let spread = (&v * &step.bias2).sqrt() + self.epsilon;
        let updated = parameter - &step.lr * (&m * &step.bias1 / spread);
        (updated, Moments { m, v })
    }
}
