//! Sine of radians; `y' = cos x`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Sin;

impl Pointwise for Sin {
    fn name(&self) -> &'static str {
        "sin"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().sin())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g * x[0].cos())]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Sin, a)
    }
}

impl Tensor {
    /// Sine of radians.
    #[track_caller]
    pub fn sin(&self) -> Tensor {
        map(Sin, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("sin", -3.0, 3.0, Tensor::sin)]
}
