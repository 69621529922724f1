//! Natural logarithm; `y' = 1 / x`, and 0 where `x <= 0`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Log;

impl Pointwise for Log {
    fn name(&self) -> &'static str {
        "log"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().ln())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        let positive = x[0].greater_than(&zero);
        vec![Some(positive.select(&(g / positive.select(&x[0], &one)), &zero))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Log, a)
    }
}

impl Tensor {
    /// Natural logarithm.
    #[track_caller]
    pub fn log(&self) -> Tensor {
        map(Log, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("log", 0.5, 2.0, Tensor::log)]
}
