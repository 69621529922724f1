//! Scalar primitives on runs of lanes: one call applies one [`Prim`] to `len` lanes.
//!
//! Every primitive is compiled for every combination of operand kinds, so that a call costs one dispatch and the loop
//! has no branches.
use super::Isa;
use super::math;
use super::simd::{Kernel, Simd, launch};
use raygrad_compiler::scalar::Prim;

/// One operand of a primitive: 32-bit lanes, `f32` or the bits of `u32`.
#[derive(Clone, Copy, Debug)]
pub enum Operand {
    /// A run of lanes.
    Lanes(*const f32),
    /// The same bits in all lanes.
    Splat(u32),
}

impl Operand {
    /// The same float in all lanes.
    pub fn splat(value: f32) -> Operand {
        Operand::Splat(value.to_bits())
    }
}

/// The operands of a call. Kinds and words lie apart: an enum is written in halves and read whole, which a processor waits
/// for, and most runs of lanes are so short that the wait would be a third of their time.
#[derive(Clone, Copy, Debug)]
pub struct Operands {
    splat: [bool; 3],
    /// An address, or the bits of all lanes.
    words: [usize; 3],
}

impl Operands {
    /// No operands.
    pub const NONE: Operands = Operands { splat: [true; 3], words: [0; 3] };

    /// Makes `operand` the one at position `i`.
    #[inline(always)]
    pub fn set(&mut self, i: usize, operand: Operand) {
        (self.splat[i], self.words[i]) = match operand {
            Operand::Lanes(at) => (false, at.expose_provenance()),
            Operand::Splat(bits) => (true, bits as usize),
        };
    }

    #[inline(always)]
    fn get(&self, i: usize) -> Operand {
        match self.splat[i] {
            false => Operand::Lanes(std::ptr::with_exposed_provenance(self.words[i])),
            true => Operand::Splat(self.words[i] as u32),
        }
    }
}

impl From<[Operand; 3]> for Operands {
    fn from(all: [Operand; 3]) -> Operands {
        let mut operands = Operands::NONE;
        all.into_iter().enumerate().for_each(|(i, operand)| operands.set(i, operand));
        operands
    }
}

/// Computes `out[i] = prim(operand 0 [i], ...)` for `len` lanes; operands beyond the primitive's arity are ignored.
///
/// # Safety
/// `isa.supported()`; `out` and the used operands are valid for `len` lanes; `out` equals an operand's pointer or does
/// not overlap it.
#[inline]
pub unsafe fn apply(isa: Isa, prim: Prim, out: *mut f32, operands: &Operands, len: usize) {
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &Apply { prim, out, operands, len }) }
}

struct Apply<'a> {
    prim: Prim,
    out: *mut f32,
    operands: &'a Operands,
    len: usize,
}

/// What a primitive does to vectors; unary and binary ones ignore the rest of the operands.
trait Op {
    /// # Safety
    /// As [`Simd`].
    unsafe fn eval<S: Simd>(operands: [S::V; 3]) -> S::V;
}

/// Defines an [`Op`] per primitive, and the dispatch from a [`Prim`] to the method of `Apply` for its arity.
macro_rules! primitives {
    ($($arity:ident { $($name:ident($($arg:pat),+) => $body:expr;)+ })+) => {
        mod ops {
            $($(pub(super) struct $name;)+)+
        }
        $($(impl Op for ops::$name {
            #[inline(always)]
            unsafe fn eval<S: Simd>(operands: [S::V; 3]) -> S::V {
                let [$($arg),+, ..] = operands;
                // SAFETY: works on registers only; the caller vouches for the instruction set.
                unsafe { $body }
            }
        })+)+
        impl Kernel for Apply<'_> {
            type Out = ();

            #[inline(always)]
            unsafe fn run<S: Simd>(&self) {
                match self.prim {
                    // SAFETY: forwarded contract of `apply`.
                    $($(Prim::$name => unsafe { self.$arity::<S, ops::$name>() },)+)+
                }
            }
        }
    };
}

primitives! {
    unary {
        Neg(a) => math::negate::<S>(a);
        Abs(a) => math::abs::<S>(a);
        Floor(a) => S::floor(a);
        Exp(a) => math::exp::<S>(a);
        Log(a) => math::log::<S>(a);
        Sqrt(a) => S::sqrt(a);
        Sin(a) => math::sin::<S>(a);
        Cos(a) => math::cos::<S>(a);
        Tanh(a) => math::tanh::<S>(a);
        ToF32(a) => S::to_f32(a);
        ToU32(a) => S::to_u32(a);
    }
    binary {
        Add(a, b) => S::add(a, b);
        Sub(a, b) => S::sub(a, b);
        Mul(a, b) => S::mul(a, b);
        Div(a, b) => S::div(a, b);
        Min(a, b) => S::min(a, b);
        Max(a, b) => S::max(a, b);
        Atan2(y, x) => math::atan2::<S>(y, x);
        Lt(a, b) => truth::<S>(S::lt(a, b));
        Le(a, b) => truth::<S>(S::le(a, b));
        Eq(a, b) => truth::<S>(S::eq(a, b));
        UAdd(a, b) => S::uadd(a, b);
        UMul(a, b) => S::umul(a, b);
        UAnd(a, b) => S::and(a, b);
        UOr(a, b) => S::or(a, b);
        UXor(a, b) => S::xor(a, b);
        UShl(a, b) => S::shl(a, b);
        UShr(a, b) => S::shr(a, b);
        ULt(a, b) => truth::<S>(S::ult(a, b));
        UEq(a, b) => truth::<S>(S::ueq(a, b));
    }
    ternary {
        Select(c, a, b) => S::select(S::ueq(c, S::splat_bits(0)), b, a);
    }
}

/// The integers 1 and 0.
///
/// # Safety
/// As [`Simd`].
#[inline(always)]
unsafe fn truth<S: Simd>(m: S::M) -> S::V {
    // SAFETY: forwarded contract.
    unsafe { S::select(m, S::splat_bits(1), S::splat_bits(0)) }
}

/// An operand whose kind is known at compile time.
trait Source: Copy {
    /// Lanes `i..i + S::LANES`.
    ///
    /// # Safety
    /// As [`Simd`], and these lanes are valid.
    unsafe fn vector<S: Simd>(self, i: usize) -> S::V;
    /// Lanes `i..i + n`, `n < S::LANES`.
    ///
    /// # Safety
    /// As [`Simd`], and these lanes are valid.
    unsafe fn head<S: Simd>(self, i: usize, n: usize) -> S::V;
}

#[derive(Clone, Copy)]
struct Run(*const f32);

impl Source for Run {
    #[inline(always)]
    unsafe fn vector<S: Simd>(self, i: usize) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::load(self.0.add(i)) }
    }
    #[inline(always)]
    unsafe fn head<S: Simd>(self, i: usize, n: usize) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::load_head(self.0.add(i), n) }
    }
}

#[derive(Clone, Copy)]
struct Value(u32);

impl Source for Value {
    #[inline(always)]
    unsafe fn vector<S: Simd>(self, _: usize) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::splat_bits(self.0) }
    }
    #[inline(always)]
    unsafe fn head<S: Simd>(self, _: usize, _: usize) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::splat_bits(self.0) }
    }
}

/// Stands for an operand that the primitive does not have.
const UNUSED: Value = Value(0);

impl Apply<'_> {
    /// # Safety
    /// As [`apply`]; the same holds for the other methods.
    #[inline(always)]
    unsafe fn unary<S: Simd, O: Op>(&self) {
        // SAFETY: forwarded contract.
        unsafe {
            match self.operands.get(0) {
                Operand::Lanes(a) => self.sweep::<S, O>(Run(a), UNUSED, UNUSED),
                Operand::Splat(a) => self.sweep::<S, O>(Value(a), UNUSED, UNUSED),
            }
        }
    }

    #[inline(always)]
    unsafe fn binary<S: Simd, O: Op>(&self) {
        use Operand::{Lanes, Splat};
        // SAFETY: forwarded contract.
        unsafe {
            match (self.operands.get(0), self.operands.get(1)) {
                (Lanes(a), Lanes(b)) => self.sweep::<S, O>(Run(a), Run(b), UNUSED),
                (Lanes(a), Splat(b)) => self.sweep::<S, O>(Run(a), Value(b), UNUSED),
                (Splat(a), Lanes(b)) => self.sweep::<S, O>(Value(a), Run(b), UNUSED),
                (Splat(a), Splat(b)) => self.sweep::<S, O>(Value(a), Value(b), UNUSED),
            }
        }
    }

    #[inline(always)]
    unsafe fn ternary<S: Simd, O: Op>(&self) {
        use Operand::{Lanes, Splat};
        // SAFETY: forwarded contract.
        unsafe {
            match (self.operands.get(0), self.operands.get(1), self.operands.get(2)) {
                (Lanes(a), Lanes(b), Lanes(c)) => self.sweep::<S, O>(Run(a), Run(b), Run(c)),
                (Lanes(a), Lanes(b), Splat(c)) => self.sweep::<S, O>(Run(a), Run(b), Value(c)),
                (Lanes(a), Splat(b), Lanes(c)) => self.sweep::<S, O>(Run(a), Value(b), Run(c)),
                (Lanes(a), Splat(b), Splat(c)) => self.sweep::<S, O>(Run(a), Value(b), Value(c)),
                (Splat(a), Lanes(b), Lanes(c)) => self.sweep::<S, O>(Value(a), Run(b), Run(c)),
                (Splat(a), Lanes(b), Splat(c)) => self.sweep::<S, O>(Value(a), Run(b), Value(c)),
                (Splat(a), Splat(b), Lanes(c)) => self.sweep::<S, O>(Value(a), Value(b), Run(c)),
                (Splat(a), Splat(b), Splat(c)) => self.sweep::<S, O>(Value(a), Value(b), Value(c)),
            }
        }
    }

    /// The loop over all lanes.
    #[inline(always)]
    unsafe fn sweep<S: Simd, O: Op>(&self, a: impl Source, b: impl Source, c: impl Source) {
        let (out, len) = (self.out, self.len);
        let mut i = 0;
        // SAFETY: all accesses are to lanes below `len`. Lanes are read before the same lanes are written.
        unsafe {
            while i + S::LANES <= len {
                let v = O::eval::<S>([a.vector::<S>(i), b.vector::<S>(i), c.vector::<S>(i)]);
                S::store(out.add(i), v);
                i += S::LANES;
            }
            let n = len - i;
            if n > 0 {
                let v = O::eval::<S>([a.head::<S>(i, n), b.head::<S>(i, n), c.head::<S>(i, n)]);
                S::store_head(out.add(i), n, v);
            }
        }
    }
}
