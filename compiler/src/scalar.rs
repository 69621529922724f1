//! Scalar primitives: everything the kernels know about pointwise ops.
//!
//! A pointwise op lowers itself to a [`ScalarProgram`], a straight-line SSA list of these primitives. Each primitive is
//! one thing that a SIMD lane and a naga expression can both do, so a new pointwise op needs no change in `kernels`.
//! Lanes are 32 bits wide and hold an `f32` or a `u32`; truth values are `u32` 0 or 1.

/// One operation on 32-bit lanes. Types are in the comments: `f` is `f32`, `u` is `u32`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Prim {
    // f -> f
    Neg,
    Abs,
    Floor,
    Exp,
    Log,
    Sqrt,
    /// Sine in radians; arguments beyond a few thousand radians lose precision on every backend.
    Sin,
    Cos,
    Tanh,
    // f, f -> f
    Add,
    Sub,
    Mul,
    Div,
    /// `if a < b { a } else { b }`: of NaN, a second operand passes and a first one does not.
    Min,
    /// `if a > b { a } else { b }`, likewise.
    Max,
    /// `Atan2(y, x)`
    Atan2,
    // f, f -> u (0 or 1)
    Lt,
    Le,
    Eq,
    // u, t, t -> t: `if c != 0 { a } else { b }`, operands c, a, b
    Select,
    // u, u -> u (wrapping; shifts take the amount modulo 32)
    UAdd,
    UMul,
    UAnd,
    UOr,
    UXor,
    UShl,
    UShr,
    // u, u -> u (0 or 1)
    ULt,
    UEq,
    // u -> f, exact below 2^24, else rounded to nearest
    ToF32,
    // f -> u, truncates towards zero and saturates; NaN gives 0
    ToU32,
}

/// Lane type of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum DType {
    F32,
    U32,
}

impl Prim {
    /// Number of operands.
    pub fn arity(self) -> usize {
        use Prim::*;
        match self {
            Neg | Abs | Floor | Exp | Log | Sqrt | Sin | Cos | Tanh | ToF32 | ToU32 => 1,
            Select => 3,
            _ => 2,
        }
    }

    /// Type of the result, given the type of the last operand (only `Select` depends on it).
    pub fn result(self, last: DType) -> DType {
        use Prim::*;
        match self {
            Lt | Le | Eq | UAdd | UMul | UAnd | UOr | UXor | UShl | UShr | ULt | UEq | ToU32 => DType::U32,
            Select => last,
            _ => DType::F32,
        }
    }

    /// Arithmetic cost in multiply-add-like operations, for the cost model.
    pub fn flops(self) -> u64 {
        use Prim::*;
        match self {
            Exp | Log | Sin | Cos | Tanh => 16,
            Atan2 => 24,
            Sqrt | Div => 8,
            _ => 1,
        }
    }
}

/// An operand of a scalar instruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Val {
    /// Operand of the op, by position.
    Input(u8),
    /// Bits of a constant lane.
    Const(u32),
    /// Result of an earlier instruction.
    Inst(u16),
}

/// Straight-line program over 32-bit lanes.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Default)]
pub struct ScalarProgram {
    pub code: Vec<(Prim, Vec<Val>)>,
}

impl ScalarProgram {
    /// Builds a program by running `build`, whose result must be the last instruction it emitted.
    pub fn build(build: impl FnOnce(&mut ScalarBuilder) -> Val) -> ScalarProgram {
        let mut b = ScalarBuilder::default();
        let last = build(&mut b);
        debug_assert_eq!(last, Val::Inst(b.0.code.len() as u16 - 1), "a scalar program ends in its result");
        b.0
    }
    pub fn flops(&self) -> u64 {
        self.code.iter().map(|(p, _)| p.flops()).sum()
    }
}

/// Emits scalar instructions; what a pointwise op's `lower` writes to.
#[derive(Default)]
pub struct ScalarBuilder(ScalarProgram);

impl ScalarBuilder {
    pub fn emit(&mut self, prim: Prim, args: &[Val]) -> Val {
        debug_assert_eq!(args.len(), prim.arity());
        self.0.code.push((prim, args.to_vec()));
        Val::Inst(self.0.code.len() as u16 - 1)
    }
    /// An `f32` constant.
    pub fn f(&self, x: f32) -> Val {
        Val::Const(x.to_bits())
    }
    /// A `u32` constant.
    pub fn u(&self, x: u32) -> Val {
        Val::Const(x)
    }
}
