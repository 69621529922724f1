//! The smaller of two values, NaN if either is; on ties the gradient goes to `a`.

use super::pointwise::{binary, unary};
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Min;

impl Pointwise for Min {
    fn name(&self) -> &'static str {
        "min"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let (x, y) = (a[0].f(), a[1].f());
        Lane::F(if x < y || x.is_nan() { x } else { y })
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (first, zero) = (x[0].less_equal(&x[1]), Tensor::scalar(0.0));
        vec![Some(first.select(g, &zero)), Some(first.select(&zero, g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        // The primitive passes on a NaN of its second operand only.
        let smaller = b.emit(Prim::Min, a);
        let number = b.emit(Prim::Eq, &[a[0], a[0]]);
        b.emit(Prim::Select, &[number, smaller, a[0]])
    }
}

impl Tensor {
    /// The smaller of the two, lane by lane; NaN where either is.
    #[track_caller]
    pub fn min(&self, other: &Tensor) -> Tensor {
        map(Min, &[self, other])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        binary("min", (-1.0, 1.0), (-1.0, 1.0), |a, b| a.min(b)),
        unary("min with a number", -1.0, 1.0, |x| x.min(&Tensor::scalar(0.1))),
    ]
}
