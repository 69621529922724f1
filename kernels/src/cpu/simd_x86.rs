//! Vectors of x86-64: AVX-512 and AVX2 with FMA.
use super::simd::{Kernel, Simd, dot_of_halves, pair_of_rounded};
use std::arch::x86_64::*;

/// Runs `kernel` with 512-bit vectors.
///
/// # Safety
/// The CPU has AVX-512 F, VL, DQ, BW, AVX2 and FMA, and the kernel's contract holds.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
pub(super) unsafe fn run_avx512<K: Kernel>(kernel: &K) -> K::Out {
    // SAFETY: forwarded contract.
    unsafe { kernel.run::<Avx512<false>>() }
}

/// Runs `kernel` with 512-bit vectors and dot products of pairs.
///
/// # Safety
/// As [`run_avx512`], and the CPU has AVX-512 BF16.
#[target_feature(enable = "avx512bf16,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
pub(super) unsafe fn run_avx512_bf16<K: Kernel>(kernel: &K) -> K::Out {
    // SAFETY: forwarded contract.
    unsafe { kernel.run::<Avx512<true>>() }
}

/// Runs `kernel` with 256-bit vectors.
///
/// # Safety
/// The CPU has AVX2 and FMA, and the kernel's contract holds.
#[target_feature(enable = "avx2,fma")]
pub(super) unsafe fn run_avx2<K: Kernel>(kernel: &K) -> K::Out {
    // SAFETY: forwarded contract.
    unsafe { kernel.run::<Avx2>() }
}

/// Methods that are one floating-point intrinsic.
macro_rules! float {
    ($($name:ident($($arg:ident),+) = $intrinsic:ident;)*) => {$(
        #[inline(always)]
        unsafe fn $name($($arg: Self::V),+) -> Self::V {
            // SAFETY: works on registers only; the caller vouches for the instruction set.
            unsafe { $intrinsic($($arg),+) }
        }
    )*};
}

/// Methods that are one integer intrinsic between casts.
macro_rules! integer {
    ($int:ident, $float:ident; $($name:ident = $intrinsic:ident;)*) => {$(
        #[inline(always)]
        unsafe fn $name(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: works on registers only; the caller vouches for the instruction set.
            unsafe { $float($intrinsic($int(a), $int(b))) }
        }
    )*};
}

/// Methods with a body that works on registers only.
macro_rules! registers {
    ($(fn $name:ident($($arg:ident: $ty:ty),+) -> $out:ty $body:block)*) => {$(
        #[inline(always)]
        unsafe fn $name($($arg: $ty),+) -> $out {
            // SAFETY: works on registers only; the caller vouches for the instruction set.
            unsafe { $body }
        }
    )*};
}

/// 16 lanes. `BF16`: the CPU multiplies pairs of bfloat16 values.
pub(super) struct Avx512<const BF16: bool>;

impl<const BF16: bool> Avx512<BF16> {
    /// Mask of the first `n < 16` lanes.
    #[inline(always)]
    fn head(n: usize) -> __mmask16 {
        ((1u32 << (n & 15)) - 1) as __mmask16
    }
}

/// Halves of 16-bit values, `[first 16 | second 16]`, in pairs.
static INTERLEAVE: [u16; 32] = {
    let mut index = [0; 32];
    let mut i = 0;
    while i < 32 {
        index[i] = (i / 2 + i % 2 * 16) as u16;
        i += 1;
    }
    index
};

impl<const BF16: bool> Simd for Avx512<BF16> {
    const LANES: usize = 16;
    const REGISTERS: usize = 32;
    type V = __m512;
    type M = __mmask16;

    #[inline(always)]
    unsafe fn load(p: *const f32) -> __m512 {
        // SAFETY: the caller vouches for 16 lanes at `p`.
        unsafe { _mm512_loadu_ps(p) }
    }

    #[inline(always)]
    unsafe fn store(p: *mut f32, v: __m512) {
        // SAFETY: the caller vouches for 16 lanes at `p`.
        unsafe { _mm512_storeu_ps(p, v) }
    }

    #[inline(always)]
    unsafe fn load_head(p: *const f32, n: usize) -> __m512 {
        // SAFETY: the caller vouches for `n` lanes at `p`; masked lanes are not accessed.
        unsafe { _mm512_maskz_loadu_ps(Self::head(n), p) }
    }

    #[inline(always)]
    unsafe fn store_head(p: *mut f32, n: usize, v: __m512) {
        // SAFETY: the caller vouches for `n` lanes at `p`; masked lanes are not accessed.
        unsafe { _mm512_mask_storeu_ps(p, Self::head(n), v) }
    }

    #[inline(always)]
    unsafe fn prefetch(p: *const f32) {
        // SAFETY: a prefetch never faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }

    float! {
        add(a, b) = _mm512_add_ps;
        sub(a, b) = _mm512_sub_ps;
        mul(a, b) = _mm512_mul_ps;
        div(a, b) = _mm512_div_ps;
        fma(a, b, c) = _mm512_fmadd_ps;
        min(a, b) = _mm512_min_ps;
        max(a, b) = _mm512_max_ps;
        sqrt(a) = _mm512_sqrt_ps;
        and(a, b) = _mm512_and_ps;
        or(a, b) = _mm512_or_ps;
        xor(a, b) = _mm512_xor_ps;
        scale(p, n) = _mm512_scalef_ps;
    }

    integer! { _mm512_castps_si512, _mm512_castsi512_ps;
        uadd = _mm512_add_epi32;
        umul = _mm512_mullo_epi32;
    }

    registers! {
        fn splat_bits(bits: u32) -> __m512 { _mm512_castsi512_ps(_mm512_set1_epi32(bits as i32)) }
        fn floor(a: __m512) -> __m512 { _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(a) }
        fn shl(a: __m512, b: __m512) -> __m512 {
            let amount = _mm512_and_si512(_mm512_castps_si512(b), _mm512_set1_epi32(31));
            _mm512_castsi512_ps(_mm512_sllv_epi32(_mm512_castps_si512(a), amount))
        }
        fn shr(a: __m512, b: __m512) -> __m512 {
            let amount = _mm512_and_si512(_mm512_castps_si512(b), _mm512_set1_epi32(31));
            _mm512_castsi512_ps(_mm512_srlv_epi32(_mm512_castps_si512(a), amount))
        }
        fn to_f32(a: __m512) -> __m512 { _mm512_cvtepu32_ps(_mm512_castps_si512(a)) }
        fn to_u32(a: __m512) -> __m512 {
            // The maximum is 0 for NaN and negative values; too large ones convert to all ones.
            _mm512_castsi512_ps(_mm512_cvttps_epu32(_mm512_max_ps(a, _mm512_setzero_ps())))
        }
        fn lt(a: __m512, b: __m512) -> __mmask16 { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) }
        fn le(a: __m512, b: __m512) -> __mmask16 { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b) }
        fn eq(a: __m512, b: __m512) -> __mmask16 { _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a, b) }
        fn ult(a: __m512, b: __m512) -> __mmask16 {
            _mm512_cmplt_epu32_mask(_mm512_castps_si512(a), _mm512_castps_si512(b))
        }
        fn ueq(a: __m512, b: __m512) -> __mmask16 {
            _mm512_cmpeq_epi32_mask(_mm512_castps_si512(a), _mm512_castps_si512(b))
        }
        fn select(m: __mmask16, a: __m512, b: __m512) -> __m512 { _mm512_mask_blend_ps(m, b, a) }
    }

    #[inline(always)]
    unsafe fn load_even_odd(p: *const f32) -> (__m512, __m512) {
        // SAFETY: the caller vouches for 32 lanes at `p`.
        unsafe {
            let (a, b) = (_mm512_loadu_ps(p), _mm512_loadu_ps(p.add(16)));
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_or_si512(even, _mm512_set1_epi32(1));
            (_mm512_permutex2var_ps(a, even, b), _mm512_permutex2var_ps(a, odd, b))
        }
    }

    #[inline(always)]
    unsafe fn pair(first: __m512, second: __m512) -> __m512 {
        // SAFETY: register operations, and a constant; the caller vouches for the instruction set.
        unsafe {
            if BF16 {
                let halves: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(second, first));
                let order = _mm512_loadu_si512(INTERLEAVE.as_ptr().cast());
                _mm512_castsi512_ps(_mm512_permutexvar_epi16(order, halves))
            } else {
                pair_of_rounded::<Self>(first, second)
            }
        }
    }

    #[inline(always)]
    unsafe fn load_pairs(p: *const f32) -> __m512 {
        // SAFETY: the caller vouches for 32 lanes at `p`, and for the instruction set.
        unsafe {
            if BF16 {
                std::mem::transmute::<__m512bh, __m512>(_mm512_cvtne2ps_pbh(Self::load(p.add(16)), Self::load(p)))
            } else {
                let (even, odd) = Self::load_even_odd(p);
                Self::pair(even, odd)
            }
        }
    }

    #[inline(always)]
    unsafe fn dot(a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: register operations; the caller vouches for the instruction set.
        unsafe {
            if BF16 {
                let [a, b] = std::mem::transmute::<[__m512; 2], [__m512bh; 2]>([a, b]);
                _mm512_dpbf16_ps(c, a, b)
            } else {
                dot_of_halves::<Self>(a, b, c)
            }
        }
    }

    #[inline(always)]
    unsafe fn transpose_rows(from: &[*const f32; 16], row: usize, to: *mut f32, stride: usize) {
        // SAFETY: the caller vouches for four floats from `row` on, and for 16 lanes at each vector.
        unsafe {
            // Quarter q holds four rows of channel 4 q + i; inserting from memory leaves the shuffle unit alone.
            let mut v = [_mm512_setzero_ps(); 4];
            for i in 0..4 {
                let quarter = |q: usize| _mm_loadu_ps(from[4 * q + i].add(row));
                let lower = _mm512_insertf32x4::<1>(_mm512_castps128_ps512(quarter(0)), quarter(1));
                v[i] = _mm512_insertf32x4::<3>(_mm512_insertf32x4::<2>(lower, quarter(2)), quarter(3));
            }
            let [a, b, c, d] = v;
            for (r, x, y) in [
                (0, _mm512_unpacklo_ps(a, b), _mm512_unpacklo_ps(c, d)),
                (2, _mm512_unpackhi_ps(a, b), _mm512_unpackhi_ps(c, d)),
            ] {
                let (x, y) = (_mm512_castps_pd(x), _mm512_castps_pd(y));
                Self::store(to.add(r * stride), _mm512_castpd_ps(_mm512_unpacklo_pd(x, y)));
                Self::store(to.add((r + 1) * stride), _mm512_castpd_ps(_mm512_unpackhi_pd(x, y)));
            }
        }
    }
}

/// 8 lanes.
pub(super) struct Avx2;

impl Avx2 {
    /// All bits set in the first `n < 8` lanes.
    #[inline(always)]
    unsafe fn head(n: usize) -> __m256i {
        // SAFETY: register operations of AVX2.
        unsafe { _mm256_cmpgt_epi32(_mm256_set1_epi32(n as i32), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)) }
    }
}

impl Simd for Avx2 {
    const LANES: usize = 8;
    const REGISTERS: usize = 16;
    type V = __m256;
    /// All bits of a lane set or clear.
    type M = __m256;

    #[inline(always)]
    unsafe fn load(p: *const f32) -> __m256 {
        // SAFETY: the caller vouches for 8 lanes at `p`.
        unsafe { _mm256_loadu_ps(p) }
    }

    #[inline(always)]
    unsafe fn store(p: *mut f32, v: __m256) {
        // SAFETY: the caller vouches for 8 lanes at `p`.
        unsafe { _mm256_storeu_ps(p, v) }
    }

    #[inline(always)]
    unsafe fn load_head(p: *const f32, n: usize) -> __m256 {
        // SAFETY: the caller vouches for `n` lanes at `p`; masked lanes are not accessed.
        unsafe { _mm256_maskload_ps(p, Self::head(n)) }
    }

    #[inline(always)]
    unsafe fn store_head(p: *mut f32, n: usize, v: __m256) {
        // SAFETY: the caller vouches for `n` lanes at `p`; masked lanes are not accessed.
        unsafe { _mm256_maskstore_ps(p, Self::head(n), v) }
    }

    #[inline(always)]
    unsafe fn prefetch(p: *const f32) {
        // SAFETY: a prefetch never faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }

    float! {
        add(a, b) = _mm256_add_ps;
        sub(a, b) = _mm256_sub_ps;
        mul(a, b) = _mm256_mul_ps;
        div(a, b) = _mm256_div_ps;
        fma(a, b, c) = _mm256_fmadd_ps;
        min(a, b) = _mm256_min_ps;
        max(a, b) = _mm256_max_ps;
        sqrt(a) = _mm256_sqrt_ps;
        floor(a) = _mm256_floor_ps;
        and(a, b) = _mm256_and_ps;
        or(a, b) = _mm256_or_ps;
        xor(a, b) = _mm256_xor_ps;
    }

    integer! { _mm256_castps_si256, _mm256_castsi256_ps;
        uadd = _mm256_add_epi32;
        umul = _mm256_mullo_epi32;
        ueq = _mm256_cmpeq_epi32;
    }

    registers! {
        fn splat_bits(bits: u32) -> __m256 { _mm256_castsi256_ps(_mm256_set1_epi32(bits as i32)) }
        fn shl(a: __m256, b: __m256) -> __m256 {
            let amount = _mm256_and_si256(_mm256_castps_si256(b), _mm256_set1_epi32(31));
            _mm256_castsi256_ps(_mm256_sllv_epi32(_mm256_castps_si256(a), amount))
        }
        fn shr(a: __m256, b: __m256) -> __m256 {
            let amount = _mm256_and_si256(_mm256_castps_si256(b), _mm256_set1_epi32(31));
            _mm256_castsi256_ps(_mm256_srlv_epi32(_mm256_castps_si256(a), amount))
        }
        fn to_f32(a: __m256) -> __m256 {
            // Both halves convert exactly, so that the multiply-add rounds once.
            let bits = _mm256_castps_si256(a);
            let high = _mm256_cvtepi32_ps(_mm256_srli_epi32::<16>(bits));
            let low = _mm256_cvtepi32_ps(_mm256_and_si256(bits, _mm256_set1_epi32(0xffff)));
            _mm256_fmadd_ps(high, _mm256_set1_ps(65536.0), low)
        }
        fn to_u32(a: __m256) -> __m256 {
            // Values from 2^31 on convert after subtracting 2^31; too large ones become 0x8000_0000, whence all ones.
            let limit = _mm256_set1_ps(2_147_483_648.0);
            let a = _mm256_max_ps(a, _mm256_setzero_ps());
            let large = _mm256_cmp_ps::<_CMP_GE_OQ>(a, limit);
            let converted = _mm256_cvttps_epi32(_mm256_sub_ps(a, _mm256_and_ps(large, limit)));
            let bits = _mm256_add_epi32(converted, _mm256_slli_epi32::<31>(_mm256_castps_si256(large)));
            let overflow = _mm256_cmp_ps::<_CMP_GE_OQ>(a, _mm256_set1_ps(4_294_967_296.0));
            _mm256_or_ps(_mm256_castsi256_ps(bits), overflow)
        }
        fn lt(a: __m256, b: __m256) -> __m256 { _mm256_cmp_ps::<_CMP_LT_OQ>(a, b) }
        fn le(a: __m256, b: __m256) -> __m256 { _mm256_cmp_ps::<_CMP_LE_OQ>(a, b) }
        fn eq(a: __m256, b: __m256) -> __m256 { _mm256_cmp_ps::<_CMP_EQ_OQ>(a, b) }
        fn ult(a: __m256, b: __m256) -> __m256 {
            let flip = _mm256_set1_epi32(i32::MIN);
            let (a, b) = (_mm256_castps_si256(a), _mm256_castps_si256(b));
            _mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_xor_si256(b, flip), _mm256_xor_si256(a, flip)))
        }
        fn select(m: __m256, a: __m256, b: __m256) -> __m256 { _mm256_blendv_ps(b, a, m) }
    }

    #[inline(always)]
    unsafe fn load_even_odd(p: *const f32) -> (__m256, __m256) {
        // SAFETY: the caller vouches for 16 lanes at `p`.
        unsafe {
            // In each half of a vector first those of `a`, then those of `b`: the middle quarters change places.
            let (a, b) = (_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8)));
            let ordered = |v| _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(v)));
            (ordered(_mm256_shuffle_ps::<0b10_00_10_00>(a, b)), ordered(_mm256_shuffle_ps::<0b11_01_11_01>(a, b)))
        }
    }

    #[inline(always)]
    unsafe fn transpose_rows(from: &[*const f32; 16], row: usize, to: *mut f32, stride: usize) {
        // SAFETY: the caller vouches for four floats from `row` on, and for 8 lanes at each vector.
        unsafe {
            // Half h holds four rows of channel 4 h + i.
            let mut v = [_mm256_setzero_ps(); 4];
            for i in 0..4 {
                let half = |h: usize| _mm_loadu_ps(from[4 * h + i].add(row));
                v[i] = _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(half(0)), half(1));
            }
            let [a, b, c, d] = v;
            for (r, x, y) in [
                (0, _mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d)),
                (2, _mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d)),
            ] {
                let (x, y) = (_mm256_castps_pd(x), _mm256_castps_pd(y));
                Self::store(to.add(r * stride), _mm256_castpd_ps(_mm256_unpacklo_pd(x, y)));
                Self::store(to.add((r + 1) * stride), _mm256_castpd_ps(_mm256_unpackhi_pd(x, y)));
            }
        }
    }
}
