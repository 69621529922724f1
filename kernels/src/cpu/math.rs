//! Transcendental functions on vectors: branch-free range reductions and minimax polynomials, good to about 2 ulp.
//!
//! All instruction sets run the same operations, so results agree bit for bit wherever multiply-adds are fused.
use super::simd::{ROUND_MAGIC, Simd};
use std::f32::consts;

/// ln 2 in two parts; the first has few bits, so that its product with an exponent is exact.
const LN2_HIGH: f32 = 355.0 / 512.0;
const LN2_LOW: f32 = -2.121_944_4e-4;
/// Pi in three parts, likewise.
const PI_HIGH: f32 = 3.140_625;
const PI_MIDDLE: f32 = 9.675_026e-4;
const PI_LOW: f32 = 1.509_958e-7;

/// `(exp(r) - 1 - r) / r^2` for `|r| <= ln 2 / 2`.
const EXP: [f32; 5] = [0.499_999_94, 0.166_665_21, 0.041_668_292, 0.008_368_716, 0.001_381_869_8];
/// `(sin(r) / r - 1) / r^2` in `r^2`, for `|r| <= pi / 2`.
pub(crate) const SIN: [f32; 4] = [-0.166_666_6, 0.008_333_069, -0.000_198_097_67, 2.606_047e-6];
/// `(tanh(x) / x - 1) / x^2` in `x^2`, for `|x| <= 0.63`.
pub(crate) const TANH: [f32; 5] = [-0.333_332_78, 0.133_313_2, -0.053_729_13, 0.020_603_238, -0.005_663_615];
/// `(ln(1 + f) - f + f^2 / 2) / f^3` for `1 + f` between `sqrt(1/2)` and `sqrt(2)`.
const LOG: [f32; 8] =
    [0.333_333_3, -0.250_008_2, 0.200_012_42, -0.166_234_09, 0.142_015_8, -0.131_596_1, 0.127_622_17, -0.076_364_39];
/// `(atan(t) / t - 1) / t^2` in `t^2`, for `|t| <= 1`.
pub(crate) const ATAN: [f32; 8] = [
    -0.333_331_53,
    0.199_937_69,
    -0.142_110_24,
    0.106_658_93,
    -0.075_519_934,
    0.043_209_426,
    -0.016_366_52,
    0.002_920_359_8,
];

const SIGN: u32 = 0x8000_0000;

/// `c[0] + c[1] x + c[2] x^2 + ...`
///
/// # Safety
/// As [`Simd`]; the same holds for all functions below.
#[inline(always)]
unsafe fn polynomial<S: Simd, const N: usize>(x: S::V, c: [f32; N]) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        let mut sum = S::splat(c[N - 1]);
        for i in (0..N - 1).rev() {
            sum = S::fma(sum, x, S::splat(c[i]));
        }
        sum
    }
}

#[inline(always)]
pub(super) unsafe fn negate<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe { S::xor(x, S::splat_bits(SIGN)) }
}

#[inline(always)]
pub(super) unsafe fn abs<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe { S::and(x, S::splat_bits(!SIGN)) }
}

/// The non-negative `magnitude` with the sign of `x`.
#[inline(always)]
unsafe fn with_sign<S: Simd>(magnitude: S::V, x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe { S::or(magnitude, S::and(x, S::splat_bits(SIGN))) }
}

/// `exp(x) = 2^n exp(r)` with `|r| <= ln 2 / 2`; underflows gradually to 0.
#[inline(always)]
pub(super) unsafe fn exp<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        // Beyond these bounds the result is infinite or rounds to 0. The operand order lets NaN through.
        let x = S::max(S::splat(-104.0), S::min(S::splat(89.0), x));
        let magic = S::splat(ROUND_MAGIC);
        let n = S::sub(S::fma(x, S::splat(consts::LOG2_E), magic), magic);
        let r = S::fma(n, S::splat(-LN2_HIGH), x);
        let r = S::fma(n, S::splat(-LN2_LOW), r);
        let p = S::fma(polynomial::<S, _>(r, EXP), S::mul(r, r), r);
        S::scale(S::add(p, S::splat(1.0)), n)
    }
}

/// `log(x) = e ln 2 + ln(1 + f)` with `1 + f` between `sqrt(1/2)` and `sqrt(2)`.
#[inline(always)]
pub(super) unsafe fn log<S: Simd>(x: S::V) -> S::V {
    // Bits of 1, of sqrt(1/2), and of the mantissa.
    const ONE: u32 = 0x3f80_0000;
    const SQRT_HALF: u32 = 0x3f35_04f3;
    const MANTISSA: u32 = 0x007f_ffff;
    // Or-ing a small integer into the bits of 2^23 gives 2^23 plus the integer; 127 is the exponent's bias.
    const TWO_23: u32 = 0x4b00_0000;
    const OFFSET: f32 = 8_388_608.0 + 127.0;
    // SAFETY: forwarded contract.
    unsafe {
        let subnormal = S::lt(x, S::splat(f32::MIN_POSITIVE));
        let normal = S::select(subnormal, S::mul(x, S::splat(8_388_608.0)), x);
        let offset = S::select(subnormal, S::splat(OFFSET + 23.0), S::splat(OFFSET));
        let bits = S::uadd(normal, S::splat_bits(ONE - SQRT_HALF));
        let e = S::sub(S::or(S::shr(bits, S::splat_bits(23)), S::splat_bits(TWO_23)), offset);
        let m = S::uadd(S::and(bits, S::splat_bits(MANTISSA)), S::splat_bits(SQRT_HALF));

        let f = S::sub(m, S::splat(1.0));
        let f2 = S::mul(f, f);
        let cubic = S::mul(polynomial::<S, _>(f, LOG), f);
        let low = S::fma(cubic, f2, S::mul(e, S::splat(LN2_LOW)));
        let low = S::fma(f2, S::splat(-0.5), low);
        let r = S::fma(e, S::splat(LN2_HIGH), S::add(f, low));

        let r = S::select(S::lt(x, S::splat(f32::INFINITY)), r, x);
        let zero = S::splat(0.0);
        let r = S::select(S::eq(x, zero), S::splat(f32::NEG_INFINITY), r);
        S::select(S::lt(x, zero), S::splat(f32::NAN), r)
    }
}

/// `sin(x - q pi)`, where `|x - q pi|` is about pi / 2 at most.
#[inline(always)]
unsafe fn sin_reduced<S: Simd>(x: S::V, q: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        let r = S::fma(q, S::splat(-PI_HIGH), x);
        let r = S::fma(q, S::splat(-PI_MIDDLE), r);
        let r = S::fma(q, S::splat(-PI_LOW), r);
        // Huge arguments have no significant digits left; the result stays bounded nevertheless. NaN passes.
        let r = S::max(S::splat(-1.6), S::min(S::splat(1.6), r));
        let z = S::mul(r, r);
        S::fma(S::mul(polynomial::<S, _>(z, SIN), z), r, r)
    }
}

/// `sin(x) = (-1)^n sin(x - n pi)`.
#[inline(always)]
pub(super) unsafe fn sin<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        let magic = S::splat(ROUND_MAGIC);
        let rounded = S::fma(x, S::splat(consts::FRAC_1_PI), magic);
        let sign = S::shl(rounded, S::splat_bits(31));
        S::xor(sin_reduced::<S>(x, S::sub(rounded, magic)), sign)
    }
}

/// `cos(x) = -(-1)^n sin(x - (n + 1/2) pi)`.
#[inline(always)]
pub(super) unsafe fn cos<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        let magic = S::splat(ROUND_MAGIC);
        let rounded = S::add(S::fma(x, S::splat(consts::FRAC_1_PI), S::splat(-0.5)), magic);
        let sign = S::xor(S::shl(rounded, S::splat_bits(31)), S::splat_bits(SIGN));
        let q = S::add(S::sub(rounded, magic), S::splat(0.5));
        S::xor(sin_reduced::<S>(x, q), sign)
    }
}

/// A polynomial near 0, else `1 - 2 / (exp(2 |x|) + 1)`.
#[inline(always)]
pub(super) unsafe fn tanh<S: Simd>(x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        let one = S::splat(1.0);
        let two = S::splat(2.0);
        // From 10 on the result rounds to 1. The operand order lets NaN through.
        let a = S::min(S::splat(10.0), abs::<S>(x));
        let z = S::mul(a, a);
        let near = S::fma(S::mul(polynomial::<S, _>(z, TANH), z), a, a);
        let far = S::sub(one, S::div(two, S::add(exp::<S>(S::mul(a, two)), one)));
        with_sign::<S>(S::select(S::lt(a, S::splat(0.625)), near, far), x)
    }
}

/// The angle of the point `(x, y)`, 0 for the origin.
#[inline(always)]
pub(super) unsafe fn atan2<S: Simd>(y: S::V, x: S::V) -> S::V {
    // SAFETY: forwarded contract.
    unsafe {
        // Infinities become finite, so that their quotient is 1. The operand order lets NaN through.
        let largest = S::splat(f32::MAX);
        let ax = S::min(largest, abs::<S>(x));
        let ay = S::min(largest, abs::<S>(y));
        let steep = S::lt(ax, ay);
        let numerator = S::select(steep, ax, ay);
        // The smallest positive float, in place of 0.
        let denominator = S::max(S::splat_bits(1), S::select(steep, ay, ax));
        let t = S::div(numerator, denominator);
        let z = S::mul(t, t);
        let r = S::fma(S::mul(polynomial::<S, _>(z, ATAN), z), t, t);
        let r = S::select(steep, S::sub(S::splat(consts::FRAC_PI_2), r), r);
        let r = S::select(S::lt(x, S::splat(0.0)), S::sub(S::splat(consts::PI), r), r);
        with_sign::<S>(r, y)
    }
}
