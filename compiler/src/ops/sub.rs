//! Subtraction, `a - b`.

use super::pointwise::binary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Sub;

impl Pointwise for Sub {
    fn name(&self) -> &'static str {
        "sub"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f() - a[1].f())
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.clone()), Some(-g)]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Sub, a)
    }
}

super::pointwise::operator!(Sub, sub, Sub);

pub fn samples() -> Vec<Sample> {
    vec![
        binary("sub", (-1.0, 1.0), (-1.0, 1.0), |a, b| a - b),
        binary("sub from a number", (-1.0, 1.0), (-1.0, 1.0), |a, b| 2.0 - a * b),
    ]
}
