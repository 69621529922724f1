//! The largest integer not above `x`; its derivative is 0.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Floor;

impl Pointwise for Floor {
    fn name(&self) -> &'static str {
        "floor"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().floor())
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Floor, a)
    }
}

impl Tensor {
    /// The largest integer not above `x`.
    #[track_caller]
    pub fn floor(&self) -> Tensor {
        map(Floor, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("floor", -3.0, 3.0, Tensor::floor).not_differentiable()]
}
