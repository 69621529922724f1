//! Absolute value, `|x|`; its derivative at 0 is 0.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Abs;

impl Pointwise for Abs {
    fn name(&self) -> &'static str {
        "abs"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().abs())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let zero = Tensor::scalar(0.0);
        let positive = x[0].greater_than(&zero).select(g, &zero);
        vec![Some(x[0].less_than(&zero).select(&-g, &positive))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Abs, a)
    }
}

impl Tensor {
    /// `|x|`.
    #[track_caller]
    pub fn abs(&self) -> Tensor {
        map(Abs, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("abs", -1.0, 1.0, Tensor::abs)]
}
