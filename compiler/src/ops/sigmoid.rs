//! Logistic function, `1 / (1 + e^-x)`; `y' = y (1 - y)`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Sigmoid;

impl Pointwise for Sigmoid {
    fn name(&self) -> &'static str {
        "sigmoid"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(1.0 / (1.0 + (-a[0].f()).exp()))
    }
    fn vjp(&self, _: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g * y * (1.0 - y))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let one = b.f(1.0);
        let minus = b.emit(Prim::Neg, a);
        let e = b.emit(Prim::Exp, &[minus]);
        let below = b.emit(Prim::Add, &[one, e]);
        b.emit(Prim::Div, &[one, below])
    }
}

impl Tensor {
    /// `1 / (1 + e^-x)`.
    #[track_caller]
    pub fn sigmoid(&self) -> Tensor {
        map(Sigmoid, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("sigmoid", -3.0, 3.0, Tensor::sigmoid)]
}
