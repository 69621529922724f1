//! Square root; `y' = 1 / (2 y)`, and 0 where `y = 0`, so that a norm has a finite gradient at the origin.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Sqrt;

impl Pointwise for Sqrt {
    fn name(&self) -> &'static str {
        "sqrt"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().sqrt())
    }
    fn vjp(&self, _: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        let positive = y.greater_than(&zero);
        vec![Some(positive.select(&(g * 0.5 / positive.select(y, &one)), &zero))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Sqrt, a)
    }
}

impl Tensor {
    /// Square root.
    #[track_caller]
    pub fn sqrt(&self) -> Tensor {
        map(Sqrt, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("sqrt", 0.5, 2.0, Tensor::sqrt)]
}
