//! Rectifier, `max(x, 0)`; its derivative at 0 is 0. NaN stays NaN.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Relu;

impl Pointwise for Relu {
    fn name(&self) -> &'static str {
        "relu"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let x = a[0].f();
        Lane::F(if 0.0 > x { 0.0 } else { x })
    }
    fn vjp(&self, _: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let zero = Tensor::scalar(0.0);
        vec![Some(y.greater_than(&zero).select(g, &zero))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        // In this order the primitive passes NaN on.
        let zero = b.f(0.0);
        b.emit(Prim::Max, &[zero, a[0]])
    }
}

impl Tensor {
    /// `max(x, 0)`.
    #[track_caller]
    pub fn relu(&self) -> Tensor {
        map(Relu, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("relu", -1.0, 1.0, Tensor::relu)]
}
