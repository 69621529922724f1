//! Division, `a / b`.

use super::pointwise::{binary, unary};
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Div;

impl Pointwise for Div {
    fn name(&self) -> &'static str {
        "div"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f() / a[1].f())
    }
    fn vjp(&self, x: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let da = g / &x[1];
        let db = -(&da * y);
        vec![Some(da), Some(db)]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Div, a)
    }
}

super::pointwise::operator!(Div, div, Div);

pub fn samples() -> Vec<Sample> {
    vec![
        binary("div", (-1.0, 1.0), (0.5, 1.5), |a, b| a / b),
        unary("reciprocal", -2.0, -0.5, |x| 1.0 / x),
    ]
}
