//! The vector abstraction that kernels are generic over, and how a kernel is compiled for an instruction set.
//!
//! Implementations forward to `std::arch` intrinsics, which only become single instructions inside a function with the
//! right `#[target_feature]`. Hence the rule for everything generic over [`Simd`]: it is `#[inline(always)]`, and it
//! hands no vector to a function or closure that is not. [`launch`] provides the outermost function.
use super::Isa;

/// Vectors of 32-bit lanes; each operation reads the bits as it needs them, as `f32` or as `u32`.
///
/// # Safety
/// All functions require a CPU that has the instruction set of the implementation, and pointers that are valid for the
/// lanes that are accessed (no alignment is needed).
pub(super) trait Simd {
    const LANES: usize;
    /// Vectors that fit into the registers at once.
    const REGISTERS: usize;
    type V: Copy;
    /// One truth value per lane.
    type M: Copy;

    unsafe fn load(p: *const f32) -> Self::V;
    unsafe fn store(p: *mut f32, v: Self::V);
    /// Loads the first `n < LANES` lanes, the others are zero.
    unsafe fn load_head(p: *const f32, n: usize) -> Self::V;
    /// Stores the first `n < LANES` lanes.
    unsafe fn store_head(p: *mut f32, n: usize, v: Self::V);
    unsafe fn splat_bits(bits: u32) -> Self::V;
    /// Hints that the cache line at `p`, which need not be valid, will be read soon.
    unsafe fn prefetch(p: *const f32);

    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once where the hardware can.
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `if a < b { a } else { b }`
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V;
    /// `if a > b { a } else { b }`
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sqrt(a: Self::V) -> Self::V;
    unsafe fn floor(a: Self::V) -> Self::V;

    unsafe fn uadd(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn umul(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn and(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn or(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn xor(a: Self::V, b: Self::V) -> Self::V;
    /// Shifts by `b` modulo 32.
    unsafe fn shl(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn shr(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn to_f32(a: Self::V) -> Self::V;
    /// Truncates towards zero and saturates; NaN gives 0.
    unsafe fn to_u32(a: Self::V) -> Self::V;

    unsafe fn lt(a: Self::V, b: Self::V) -> Self::M;
    unsafe fn le(a: Self::V, b: Self::V) -> Self::M;
    unsafe fn eq(a: Self::V, b: Self::V) -> Self::M;
    unsafe fn ult(a: Self::V, b: Self::V) -> Self::M;
    unsafe fn ueq(a: Self::V, b: Self::V) -> Self::M;
    unsafe fn select(m: Self::M, a: Self::V, b: Self::V) -> Self::V;

    /// The even and the odd ones of `2 * LANES` floats.
    unsafe fn load_even_odd(p: *const f32) -> (Self::V, Self::V);

    /// Stores four vectors, `stride` floats apart: vector `r` holds `*from[i].add(row + r)` in lane `i`.
    unsafe fn transpose_rows(from: &[*const f32; 16], row: usize, to: *mut f32, stride: usize);

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self::V {
        // SAFETY: forwarded contract.
        unsafe { Self::splat_bits(x.to_bits()) }
    }

    /// Lanes of two bfloat16 values, `first` in the low half: each rounded to nearest, ties to even.
    #[inline(always)]
    unsafe fn pair(first: Self::V, second: Self::V) -> Self::V {
        // SAFETY: forwarded contract.
        unsafe { pair_of_rounded::<Self>(first, second) }
    }

    /// `2 * LANES` floats in pairs, as [`Simd::pair`].
    #[inline(always)]
    unsafe fn load_pairs(p: *const f32) -> Self::V {
        // SAFETY: forwarded contract.
        unsafe {
            let (even, odd) = Self::load_even_odd(p);
            Self::pair(even, odd)
        }
    }

    /// `c` plus both products of the pairs in `a` and `b`.
    #[inline(always)]
    unsafe fn dot(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // SAFETY: forwarded contract.
        unsafe { dot_of_halves::<Self>(a, b, c) }
    }

    /// `p * 2^n` for integral `n` in -160..=160 and `p` near 1, rounded once.
    #[inline(always)]
    unsafe fn scale(p: Self::V, n: Self::V) -> Self::V {
        // SAFETY: forwarded contract. Two factors, because 2^n itself may be out of range; the first product is exact.
        unsafe {
            let magic = Self::splat(ROUND_MAGIC);
            let half = Self::sub(Self::fma(n, Self::splat(0.5), magic), magic);
            let rest = Self::sub(n, half);
            Self::mul(Self::mul(p, pow2::<Self>(half)), pow2::<Self>(rest))
        }
    }
}

/// Adding 1.5 * 2^23 rounds a float of magnitude below 2^22 to an integer, which the low mantissa bits then hold.
pub(super) const ROUND_MAGIC: f32 = 12_582_912.0;

/// [`Simd::pair`] where no instruction rounds.
#[inline(always)]
pub(super) unsafe fn pair_of_rounded<S: Simd + ?Sized>(first: S::V, second: S::V) -> S::V {
    // SAFETY: forwarded contract of `Simd`.
    unsafe {
        let low = S::shr(round_bf16::<S>(first), S::splat_bits(16));
        S::or(low, S::and(round_bf16::<S>(second), S::splat_bits(0xffff_0000)))
    }
}

/// [`Simd::dot`] where no instruction multiplies pairs: a bfloat16 value is the upper half of the same float.
#[inline(always)]
pub(super) unsafe fn dot_of_halves<S: Simd + ?Sized>(a: S::V, b: S::V, c: S::V) -> S::V {
    // SAFETY: forwarded contract of `Simd`.
    unsafe {
        let (low, high) = (S::splat_bits(16), S::splat_bits(0xffff_0000));
        let c = S::fma(S::and(a, high), S::and(b, high), c);
        S::fma(S::shl(a, low), S::shl(b, low), c)
    }
}

/// Bits whose upper half is `a` rounded to bfloat16. A NaN stays one.
#[inline(always)]
unsafe fn round_bf16<S: Simd + ?Sized>(a: S::V) -> S::V {
    // SAFETY: forwarded contract of `Simd`.
    unsafe {
        let even = S::and(S::shr(a, S::splat_bits(16)), S::splat_bits(1));
        let rounded = S::uadd(S::uadd(a, S::splat_bits(0x7fff)), even);
        S::select(S::eq(a, a), rounded, S::or(a, S::splat_bits(0x40_0000)))
    }
}

/// `2^n` for integral `n` in -126..=127.
#[inline(always)]
unsafe fn pow2<S: Simd + ?Sized>(n: S::V) -> S::V {
    // SAFETY: forwarded contract of `Simd`. The low bits of `n + magic` are `n`, and the shift drops those of `magic`.
    unsafe {
        let bits = S::shl(S::add(n, S::splat(ROUND_MAGIC)), S::splat_bits(23));
        S::uadd(bits, S::splat(1.0))
    }
}

/// A computation that is generic over the vector type.
pub(super) trait Kernel {
    type Out;
    /// Whether it multiplies pairs ([`Simd::dot`]); others are not compiled for them.
    const PAIRS: bool = false;

    /// Runs the kernel; implementations are `#[inline(always)]`.
    ///
    /// # Safety
    /// The CPU has the instruction set of `S`, and the kernel's own contract holds.
    unsafe fn run<S: Simd>(&self) -> Self::Out;
}

/// Runs `kernel` in a function compiled for `isa`. By reference: copying fresh arguments in wide pieces would stall.
///
/// # Safety
/// `isa.supported()`, and the kernel's own contract holds.
#[inline]
pub(super) unsafe fn launch<K: Kernel>(isa: Isa, kernel: &K) -> K::Out {
    debug_assert!(isa.supported(), "{isa} is not supported by this machine");
    match isa {
        // SAFETY: the caller vouches for `isa` and for the kernel's contract.
        #[cfg(target_arch = "x86_64")]
        Isa::AmxBf16 | Isa::Avx512Bf16 if K::PAIRS => unsafe { super::simd_x86::run_avx512_bf16(kernel) },
        // SAFETY: as above; the other instruction sets have this one.
        #[cfg(target_arch = "x86_64")]
        Isa::AmxBf16 | Isa::Avx512Bf16 | Isa::Avx512 => unsafe { super::simd_x86::run_avx512(kernel) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => unsafe { super::simd_x86::run_avx2(kernel) },
        // SAFETY: the portable vectors need no CPU feature; the caller vouches for the kernel's contract.
        _ => unsafe { super::simd_portable::run_portable(kernel) },
    }
}
