//! Softplus, `log(1 + e^(beta x)) / beta`, and `x` where `beta x > 20`.
//!
//! Evaluated as `max(x, 0) + log(1 + e) / beta` with `e = e^-|beta x|`, which neither overflows nor cancels. Kernels take
//! the logarithm from the series of [`log1p`]: `log` would lose every digit of a small `e`.
//! The derivative is `sigmoid(beta x)`, and 1 in the linear part.

use super::pointwise::unary;
use super::{Pointwise, Sample, log1p, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Softplus {
    pub beta: f64,
}

/// Where `beta x` exceeds this, the function is `x`.
const LINEAR: f64 = 20.0;

impl Pointwise for Softplus {
    fn name(&self) -> &'static str {
        "softplus"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let x = a[0].f();
        let z = self.beta * x;
        Lane::F(if z > LINEAR { x } else { (z.max(0.0) + (-z.abs()).exp().ln_1p()) / self.beta })
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let z = if self.beta == 1.0 { x[0].clone() } else { &x[0] * self.beta };
        let curved = g * z.sigmoid();
        vec![Some(z.greater_than(&Tensor::scalar(LINEAR)).select(g, &curved))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let zero = b.f(0.0);
        let z = b.emit(Prim::Mul, &[a[0], b.f(self.beta as f32)]);
        let size = b.emit(Prim::Abs, &[z]);
        let minus = b.emit(Prim::Neg, &[size]);
        let e = b.emit(Prim::Exp, &[minus]);
        let log = log1p::series(b, e);
        let ramp = b.emit(Prim::Max, &[zero, z]);
        let total = b.emit(Prim::Add, &[ramp, log]);
        let curved = b.emit(Prim::Mul, &[total, b.f((1.0 / self.beta) as f32)]);
        let linear = b.emit(Prim::Lt, &[b.f(LINEAR as f32), z]);
        b.emit(Prim::Select, &[linear, a[0], curved])
    }
}

impl Tensor {
    /// `log(1 + e^(beta x)) / beta`, linear above `20 / beta`.
    #[track_caller]
    pub fn softplus(&self, beta: f64) -> Tensor {
        if beta <= 0.0 || !beta.is_finite() {
            return Tensor::misfit("softplus", &[self], format!("beta is {beta}"), "beta is positive");
        }
        map(Softplus { beta }, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        unary("softplus", -3.0, 3.0, |x| x.softplus(1.0)),
        unary("softplus, beta 10", -3.0, 3.0, |x| x.softplus(10.0)),
        unary("softplus, far out", -60.0, 60.0, |x| x.softplus(1.0)).not_differentiable(),
    ]
}
