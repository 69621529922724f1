//! `e^x - 1`, which keeps the digits of small `x`; `y' = e^x`.
//!
//! Kernels compute `tanh(x / 2) (e^x + 1)`, the same without a difference.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Expm1;

impl Pointwise for Expm1 {
    fn name(&self) -> &'static str {
        "expm1"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().exp_m1())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        // Not `y + 1`, which has lost the digits where x is far below 0.
        vec![Some(g * x[0].exp())]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let half = b.emit(Prim::Mul, &[a[0], b.f(0.5)]);
        let tanh = b.emit(Prim::Tanh, &[half]);
        let e = b.emit(Prim::Exp, a);
        let sum = b.emit(Prim::Add, &[e, b.f(1.0)]);
        b.emit(Prim::Mul, &[tanh, sum])
    }
}

impl Tensor {
    /// `e^x - 1`, precise also near 0.
    #[track_caller]
    pub fn expm1(&self) -> Tensor {
        map(Expm1, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("expm1", -1.0, 1.0, Tensor::expm1)]
}
