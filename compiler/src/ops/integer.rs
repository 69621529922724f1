//! Integer arithmetic modulo 2^32, for indices, hashes and random numbers.

use super::pointwise::binary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Integer {
    Add,
    Mul,
    And,
    Or,
    Xor,
    /// By the amount modulo 32.
    ShiftLeft,
    ShiftRight,
}

impl Pointwise for Integer {
    fn name(&self) -> &'static str {
        match self {
            Integer::Add => "wrapping_add",
            Integer::Mul => "wrapping_mul",
            Integer::And => "bit_and",
            Integer::Or => "bit_or",
            Integer::Xor => "bit_xor",
            Integer::ShiftLeft => "shift_left",
            Integer::ShiftRight => "shift_right",
        }
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::U32), Some(DType::U32)]
    }
    fn result(&self) -> Option<DType> {
        Some(DType::U32)
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let (a, b) = (a[0].u(), a[1].u());
        Lane::U(match self {
            Integer::Add => a.wrapping_add(b),
            Integer::Mul => a.wrapping_mul(b),
            Integer::And => a & b,
            Integer::Or => a | b,
            Integer::Xor => a ^ b,
            Integer::ShiftLeft => a.wrapping_shl(b),
            Integer::ShiftRight => a.wrapping_shr(b),
        })
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None, None]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let prim = match self {
            Integer::Add => Prim::UAdd,
            Integer::Mul => Prim::UMul,
            Integer::And => Prim::UAnd,
            Integer::Or => Prim::UOr,
            Integer::Xor => Prim::UXor,
            Integer::ShiftLeft => Prim::UShl,
            Integer::ShiftRight => Prim::UShr,
        };
        b.emit(prim, a)
    }
}

impl Tensor {
    /// Sum modulo 2^32.
    #[track_caller]
    pub fn wrapping_add(&self, other: &Tensor) -> Tensor {
        map(Integer::Add, &[self, other])
    }
    /// Product modulo 2^32.
    #[track_caller]
    pub fn wrapping_mul(&self, other: &Tensor) -> Tensor {
        map(Integer::Mul, &[self, other])
    }
    #[track_caller]
    pub fn bit_and(&self, other: &Tensor) -> Tensor {
        map(Integer::And, &[self, other])
    }
    #[track_caller]
    pub fn bit_or(&self, other: &Tensor) -> Tensor {
        map(Integer::Or, &[self, other])
    }
    #[track_caller]
    pub fn bit_xor(&self, other: &Tensor) -> Tensor {
        map(Integer::Xor, &[self, other])
    }
    /// `self << other`, the amount modulo 32.
    #[track_caller]
    pub fn shift_left(&self, other: &Tensor) -> Tensor {
        map(Integer::ShiftLeft, &[self, other])
    }
    /// `self >> other`, the amount modulo 32.
    #[track_caller]
    pub fn shift_right(&self, other: &Tensor) -> Tensor {
        map(Integer::ShiftRight, &[self, other])
    }
}

pub fn samples() -> Vec<Sample> {
    let case = |op: Integer| {
        // Operands are spread over all 32 bits; the result is cut to 24, which are exact as a float.
        binary(op.name(), (0.0, 4096.0), (0.0, 64.0), move |a, b| {
            let spread = a.to_u32().wrapping_mul(&Tensor::integers(&[0x9E37_79B1]));
            map(op, &[&spread, &b.to_u32()]).shift_right(&Tensor::integers(&[8])).to_f32()
        })
        .not_differentiable()
    };
    use Integer::*;
    [Add, Mul, And, Or, Xor, ShiftLeft, ShiftRight].map(case).into()
}
