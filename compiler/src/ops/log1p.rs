//! `log(1 + x)`, which keeps the digits of small `x`; `y' = 1 / (1 + x)`, and 0 where `x <= -1`.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Log1p;

/// Kernels take the series where `|x|` is below this.
const NEAR: f32 = 0.5;

impl Pointwise for Log1p {
    fn name(&self) -> &'static str {
        "log1p"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().ln_1p())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        let above = &x[0] + 1.0;
        let positive = above.greater_than(&zero);
        vec![Some(positive.select(&(g / positive.select(&above, &one)), &zero))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let near = series(b, a[0]);
        let above = b.emit(Prim::Add, &[a[0], b.f(1.0)]);
        let far = b.emit(Prim::Log, &[above]);
        let size = b.emit(Prim::Abs, a);
        let is_near = b.emit(Prim::Lt, &[size, b.f(NEAR)]);
        b.emit(Prim::Select, &[is_near, near, far])
    }
}

/// `log(1 + x) = 2 artanh(s)`, `s = x / (2 + x)`, for `x` in `-0.5..=1`, so that `|s| <= 1/3`: `log` would lose every digit of
/// a small `x`.
pub(super) fn series(b: &mut ScalarBuilder, x: Val) -> Val {
    let below = b.emit(Prim::Add, &[b.f(2.0), x]);
    let s = b.emit(Prim::Div, &[x, below]);
    let s2 = b.emit(Prim::Mul, &[s, s]);
    // 2 artanh(s) = s (2 + 2/3 s^2 + 2/5 s^4 + ...); the first term left out is below 2e-8 of the sum.
    let mut sum = b.f(2.0 / 15.0);
    for k in (0..7).rev() {
        let scaled = b.emit(Prim::Mul, &[sum, s2]);
        sum = b.emit(Prim::Add, &[scaled, b.f(2.0 / (2 * k + 1) as f32)]);
    }
    b.emit(Prim::Mul, &[sum, s])
}

impl Tensor {
    /// `log(1 + x)`, precise also near 0.
    #[track_caller]
    pub fn log1p(&self) -> Tensor {
        map(Log1p, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("log1p", -0.4, 0.4, Tensor::log1p), unary("log1p, far out", 0.6, 3.0, Tensor::log1p)]
}
