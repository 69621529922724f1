//! Gaussian activation, `exp(-x^2 / (2 sigma^2))`; `y' = -x y / sigma^2`.
//!
//! Chng, Ramasinghe, Sherrah, Lucey, Gaussian Activated Neural Radiance Fields for High Fidelity Reconstruction and Pose
//! Estimation (ECCV 2022), eq. 2.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Gaussian {
    pub sigma: f64,
}

impl Pointwise for Gaussian {
    fn name(&self) -> &'static str {
        "gaussian"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F((-a[0].f().powi(2) / (2.0 * self.sigma.powi(2))).exp())
    }
    fn vjp(&self, x: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g * y * &x[0] * (-1.0 / self.sigma.powi(2)))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let square = b.emit(Prim::Mul, &[a[0], a[0]]);
        let z = b.emit(Prim::Mul, &[square, b.f((-0.5 / self.sigma.powi(2)) as f32)]);
        b.emit(Prim::Exp, &[z])
    }
}

impl Tensor {
    /// `exp(-x^2 / (2 sigma^2))`.
    #[track_caller]
    pub fn gaussian(&self, sigma: f64) -> Tensor {
        if sigma <= 0.0 || !sigma.is_finite() {
            return Tensor::misfit("gaussian", &[self], format!("sigma is {sigma}"), "sigma is positive");
        }
        map(Gaussian { sigma }, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("gaussian", -1.0, 1.0, |x| x.gaussian(0.4))]
}
