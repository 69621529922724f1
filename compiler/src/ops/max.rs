//! The larger of two values, NaN if either is; on ties the gradient goes to `a`.

use super::pointwise::{binary, unary};
use super::reduce::larger;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Max;

impl Pointwise for Max {
    fn name(&self) -> &'static str {
        "max"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(larger(a[0].f(), a[1].f()))
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (first, zero) = (x[0].greater_equal(&x[1]), Tensor::scalar(0.0));
        vec![Some(first.select(g, &zero)), Some(first.select(&zero, g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        // The primitive passes on a NaN of its second operand only.
        let larger = b.emit(Prim::Max, a);
        let number = b.emit(Prim::Eq, &[a[0], a[0]]);
        b.emit(Prim::Select, &[number, larger, a[0]])
    }
}

impl Tensor {
    /// The larger of the two, lane by lane; NaN where either is.
    #[track_caller]
    pub fn max(&self, other: &Tensor) -> Tensor {
        map(Max, &[self, other])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        binary("max", (-1.0, 1.0), (-1.0, 1.0), |a, b| a.max(b)),
        unary("max with a number", -1.0, 1.0, |x| x.max(&Tensor::scalar(0.1))),
    ]
}
