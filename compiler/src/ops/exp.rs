//! Exponential, `e^x`; `y' = y`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Exp;

impl Pointwise for Exp {
    fn name(&self) -> &'static str {
        "exp"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().exp())
    }
    fn vjp(&self, _: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g * y)]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Exp, a)
    }
}

impl Tensor {
    /// `e^x`.
    #[track_caller]
    pub fn exp(&self) -> Tensor {
        map(Exp, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("exp", -1.0, 1.0, Tensor::exp)]
}
