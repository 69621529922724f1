//! Conversion between lane types; no gradient passes.

use super::pointwise::unary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

/// To `f32`: exact below 2^24. To `u32`: truncates towards zero and saturates; NaN gives 0.
#[derive(Clone, Debug)]
pub struct Cast {
    pub to: DType,
}

impl Pointwise for Cast {
    fn name(&self) -> &'static str {
        match self.to {
            DType::F32 => "to_f32",
            DType::U32 => "to_u32",
        }
    }
    fn operands(&self) -> &'static [Option<DType>] {
        match self.to {
            DType::F32 => &[Some(DType::U32)],
            DType::U32 => &[Some(DType::F32)],
        }
    }
    fn result(&self) -> Option<DType> {
        Some(self.to)
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        match a[0] {
            Lane::F(x) => Lane::U(x as u32),
            Lane::U(x) => Lane::F(x as f64),
        }
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        match self.to {
            DType::F32 => b.emit(Prim::ToF32, a),
            DType::U32 => b.emit(Prim::ToU32, a),
        }
    }
}

impl Tensor {
    /// These integers as floats.
    #[track_caller]
    pub fn to_f32(&self) -> Tensor {
        if self.dtype() == DType::F32 { self.clone() } else { map(Cast { to: DType::F32 }, &[self]) }
    }
    /// These floats as integers: truncated towards zero, saturated; NaN gives 0.
    #[track_caller]
    pub fn to_u32(&self) -> Tensor {
        if self.dtype() == DType::U32 { self.clone() } else { map(Cast { to: DType::U32 }, &[self]) }
    }
}

pub fn samples() -> Vec<Sample> {
    vec![unary("to_u32, to_f32", -2.0, 9.0, |x| x.to_u32().to_f32()).not_differentiable()]
}
