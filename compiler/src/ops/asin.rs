//! Arc sine of numbers in `-1..=1`, `atan2(x, sqrt((1 - x) (1 + x)))`; beyond, that of the nearer bound.
//!
//! `y' = 1 / sqrt(1 - x^2)`, and 0 on the bounds, where it is infinite, and beyond.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Asin;

impl Pointwise for Asin {
    fn name(&self) -> &'static str {
        "asin"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().clamp(-1.0, 1.0).asin())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(per_cosine(&x[0], g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let cosine = cosine(b, a[0]);
        b.emit(Prim::Atan2, &[a[0], cosine])
    }
}

/// `sqrt(1 - x^2)` as a product, which keeps its digits near the bounds, and 0 beyond.
pub(super) fn cosine(b: &mut ScalarBuilder, x: Val) -> Val {
    let (zero, one) = (b.f(0.0), b.f(1.0));
    let above = b.emit(Prim::Sub, &[one, x]);
    let below = b.emit(Prim::Add, &[one, x]);
    let product = b.emit(Prim::Mul, &[above, below]);
    let inside = b.emit(Prim::Max, &[zero, product]);
    b.emit(Prim::Sqrt, &[inside])
}

/// `g / sqrt(1 - x^2)` inside the bounds, else 0.
pub(super) fn per_cosine(x: &Tensor, g: &Tensor) -> Tensor {
    let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
    let product = (1.0 - x) * (1.0 + x);
    let inside = product.greater_than(&zero);
    inside.select(&(g / inside.select(&product, &one).sqrt()), &zero)
}

impl Tensor {
    /// Arc sine in `-pi/2..=pi/2`, of `x` clamped to `-1..=1`.
    #[track_caller]
    pub fn asin(&self) -> Tensor {
        map(Asin, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("asin", -0.9, 0.9, Tensor::asin)]
}
