//! Arc cosine of numbers in `-1..=1`, `atan2(sqrt((1 - x) (1 + x)), x)`; beyond, that of the nearer bound.
//!
//! `y' = -1 / sqrt(1 - x^2)`, and 0 on the bounds, where it is infinite, and beyond.

use super::asin::{cosine, per_cosine};
use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Acos;

impl Pointwise for Acos {
    fn name(&self) -> &'static str {
        "acos"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().clamp(-1.0, 1.0).acos())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(-per_cosine(&x[0], g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let sine = cosine(b, a[0]);
        b.emit(Prim::Atan2, &[sine, a[0]])
    }
}

impl Tensor {
    /// Arc cosine in `0..=pi`, of `x` clamped to `-1..=1`.
    #[track_caller]
    pub fn acos(&self) -> Tensor {
        map(Acos, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("acos", -0.9, 0.9, Tensor::acos)]
}
