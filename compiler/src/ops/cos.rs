//! Cosine of radians; `y' = -sin x`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Cos;

impl Pointwise for Cos {
    fn name(&self) -> &'static str {
        "cos"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().cos())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(-(g * x[0].sin()))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Cos, a)
    }
}

impl Tensor {
    /// Cosine of radians.
    #[track_caller]
    pub fn cos(&self) -> Tensor {
        map(Cos, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("cos", -3.0, 3.0, Tensor::cos)]
}
