//! Negation, `-x`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Neg;

impl Pointwise for Neg {
    fn name(&self) -> &'static str {
        "neg"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(-a[0].f())
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(-g)]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Neg, a)
    }
}

impl std::ops::Neg for &Tensor {
    type Output = Tensor;
    #[track_caller]
    fn neg(self) -> Tensor {
        map(Neg, &[self])
    }
}
impl std::ops::Neg for Tensor {
    type Output = Tensor;
    #[track_caller]
    fn neg(self) -> Tensor {
        map(Neg, &[&self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("neg", -1.0, 1.0, |x| -x)]
}
