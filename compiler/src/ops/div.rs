//! Division, `a / b`. Where `b` is 0 the gradient is 0, so that a quotient in a branch not taken does no harm.

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
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        if x[1].as_constant().is_some_and(|b| b.iter().all(|b| *b != 0.0)) {
            let da = g / &x[1];
            let db = -(&da * y);
            return vec![Some(da), Some(db)];
        }
        let void = x[1].equal(&zero);
        let da = void.select(&zero, &(g / void.select(&one, &x[1])));
        let db = -(&da * void.select(&zero, y));
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
