//! The nearest value in an interval; its derivative is 1 inside and on the bounds, 0 outside. NaN stays NaN.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Clamp {
    pub low: f64,
    pub high: f64,
}

impl Pointwise for Clamp {
    fn name(&self) -> &'static str {
        "clamp"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let x = a[0].f();
        let raised = if self.low > x { self.low } else { x };
        Lane::F(if self.high < raised { self.high } else { raised })
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (low, high) = (Tensor::scalar(self.low), Tensor::scalar(self.high));
        let inside = x[0].greater_equal(&low).bit_and(&x[0].less_equal(&high));
        vec![Some(inside.select(g, &Tensor::scalar(0.0)))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        // With the bounds first the primitives pass NaN on.
        let raised = b.emit(Prim::Max, &[b.f(self.low as f32), a[0]]);
        b.emit(Prim::Min, &[b.f(self.high as f32), raised])
    }
}

impl Tensor {
    /// The nearest value in `low..=high`; the gradient is 0 outside. Either bound may be infinite.
    #[track_caller]
    pub fn clamp(&self, low: f64, high: f64) -> Tensor {
        if low <= high {
            return map(Clamp { low, high }, &[self]);
        }
        Tensor::misfit("clamp", &[self], format!("bounds {low} and {high}"), "the lower bound is at most the upper one")
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        unary("clamp", -1.0, 1.0, |x| x.clamp(-0.4, 0.3)),
        unary("clamp from below", -1.0, 1.0, |x| x.clamp(-0.2, f64::INFINITY)),
    ]
}
