//! The larger of two values, `if a > b { a } else { b }`; on ties the gradient goes to `a`.

use super::pointwise::{binary, unary};
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
        let (x, y) = (a[0].f(), a[1].f());
        Lane::F(if x > y { x } else { y })
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (first, zero) = (x[0].greater_equal(&x[1]), Tensor::scalar(0.0));
        vec![Some(first.select(g, &zero)), Some(first.select(&zero, g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Max, a)
    }
}

impl Tensor {
    /// The larger of the two, lane by lane.
    #[track_caller]
    pub fn max(&self, other: &Tensor) -> Tensor {
        map(Max, &[self, other])
    }
    /// The nearest value in `low..=high`; the gradient is 0 outside.
    #[track_caller]
    pub fn clamp(&self, low: f64, high: f64) -> Tensor {
        self.max(&Tensor::scalar(low)).min(&Tensor::scalar(high))
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        binary("max", (-1.0, 1.0), (-1.0, 1.0), |a, b| a.max(b)),
        unary("max with a number", -1.0, 1.0, |x| x.max(&Tensor::scalar(0.1))),
    ]
}
