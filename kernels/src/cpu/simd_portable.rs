//! Vectors as arrays of eight lanes, for targets without hand-picked instructions; the compiler vectorises the loops.
use super::simd::{Kernel, Simd};

/// Runs `kernel` with arrays; a function of its own, so that its stack frame does not burden the dispatch.
///
/// # Safety
/// The kernel's contract holds.
#[inline(never)]
pub(super) unsafe fn run_portable<K: Kernel>(kernel: &K) -> K::Out {
    // SAFETY: these vectors need no CPU feature; the caller vouches for the kernel's contract.
    unsafe { kernel.run::<Portable>() }
}

/// Plain Rust lanes.
pub(super) struct Portable;

const LANES: usize = 8;

/// Eight 32-bit lanes.
#[derive(Clone, Copy)]
#[repr(align(32))]
pub(super) struct Lanes([u32; LANES]);

#[inline(always)]
fn map(a: Lanes, f: impl Fn(u32) -> u32) -> Lanes {
    let mut out = a;
    for lane in &mut out.0 {
        *lane = f(*lane);
    }
    out
}

#[inline(always)]
fn zip(a: Lanes, b: Lanes, f: impl Fn(u32, u32) -> u32) -> Lanes {
    let mut out = a;
    for i in 0..LANES {
        out.0[i] = f(a.0[i], b.0[i]);
    }
    out
}

#[inline(always)]
fn map_f(a: Lanes, f: impl Fn(f32) -> f32) -> Lanes {
    map(a, |a| f(f32::from_bits(a)).to_bits())
}

#[inline(always)]
fn zip_f(a: Lanes, b: Lanes, f: impl Fn(f32, f32) -> f32) -> Lanes {
    zip(a, b, |a, b| f(f32::from_bits(a), f32::from_bits(b)).to_bits())
}

/// All bits of a lane set where `f` holds.
#[inline(always)]
fn test(a: Lanes, b: Lanes, f: impl Fn(u32, u32) -> bool) -> Lanes {
    zip(a, b, |a, b| if f(a, b) { !0 } else { 0 })
}

#[inline(always)]
fn test_f(a: Lanes, b: Lanes, f: impl Fn(f32, f32) -> bool) -> Lanes {
    test(a, b, |a, b| f(f32::from_bits(a), f32::from_bits(b)))
}

/// Fused only where that is one instruction: the library fallback is a hundred times slower than two roundings.
#[inline(always)]
fn mul_add(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(any(target_feature = "fma", target_arch = "aarch64")) { a.mul_add(b, c) } else { a * b + c }
}

/// Largest integer not above `x`, without a library call: beyond 2^23 every float is integral.
#[inline(always)]
fn floor(x: f32) -> f32 {
    let truncated = x as i32 as f32;
    let floored = truncated - if truncated > x { 1.0 } else { 0.0 };
    let small = x.abs() < 8_388_608.0;
    // The sign of `x` survives in a zero result; a negative `x` has no positive floor.
    let signed = f32::from_bits(floored.to_bits() | (x.to_bits() & 0x8000_0000));
    if small { signed } else { x }
}

impl Simd for Portable {
    const LANES: usize = LANES;
    // The usual 128-bit registers hold half a vector.
    const REGISTERS: usize = 8;
    type V = Lanes;
    type M = Lanes;

    #[inline(always)]
    unsafe fn load(p: *const f32) -> Lanes {
        // SAFETY: the caller vouches for eight lanes at `p`.
        Lanes(unsafe { p.cast::<[u32; LANES]>().read_unaligned() })
    }

    #[inline(always)]
    unsafe fn store(p: *mut f32, v: Lanes) {
        // SAFETY: the caller vouches for eight lanes at `p`.
        unsafe { p.cast::<[u32; LANES]>().write_unaligned(v.0) }
    }

    #[inline(always)]
    unsafe fn load_head(p: *const f32, n: usize) -> Lanes {
        let mut v = Lanes([0; LANES]);
        for i in 0..n.min(LANES) {
            // SAFETY: the caller vouches for `n` lanes at `p`.
            v.0[i] = unsafe { p.cast::<u32>().add(i).read_unaligned() };
        }
        v
    }

    #[inline(always)]
    unsafe fn store_head(p: *mut f32, n: usize, v: Lanes) {
        for i in 0..n.min(LANES) {
            // SAFETY: the caller vouches for `n` lanes at `p`.
            unsafe { p.cast::<u32>().add(i).write_unaligned(v.0[i]) };
        }
    }

    #[inline(always)]
    unsafe fn splat_bits(bits: u32) -> Lanes {
        Lanes([bits; LANES])
    }

    #[inline(always)]
    unsafe fn prefetch(_: *const f32) {}

    #[inline(always)]
    unsafe fn add(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| a + b)
    }

    #[inline(always)]
    unsafe fn sub(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| a - b)
    }

    #[inline(always)]
    unsafe fn mul(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| a * b)
    }

    #[inline(always)]
    unsafe fn div(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| a / b)
    }

    #[inline(always)]
    unsafe fn fma(a: Lanes, b: Lanes, c: Lanes) -> Lanes {
        let mut out = c;
        for i in 0..LANES {
            let (a, b, c) = (f32::from_bits(a.0[i]), f32::from_bits(b.0[i]), f32::from_bits(c.0[i]));
            out.0[i] = mul_add(a, b, c).to_bits();
        }
        out
    }

    #[inline(always)]
    unsafe fn min(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    unsafe fn max(a: Lanes, b: Lanes) -> Lanes {
        zip_f(a, b, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    unsafe fn sqrt(a: Lanes) -> Lanes {
        map_f(a, f32::sqrt)
    }

    #[inline(always)]
    unsafe fn floor(a: Lanes) -> Lanes {
        map_f(a, floor)
    }

    #[inline(always)]
    unsafe fn uadd(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, u32::wrapping_add)
    }

    #[inline(always)]
    unsafe fn umul(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, u32::wrapping_mul)
    }

    #[inline(always)]
    unsafe fn and(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, |a, b| a & b)
    }

    #[inline(always)]
    unsafe fn or(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, |a, b| a | b)
    }

    #[inline(always)]
    unsafe fn xor(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, |a, b| a ^ b)
    }

    #[inline(always)]
    unsafe fn shl(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, u32::wrapping_shl)
    }

    #[inline(always)]
    unsafe fn shr(a: Lanes, b: Lanes) -> Lanes {
        zip(a, b, u32::wrapping_shr)
    }

    #[inline(always)]
    unsafe fn to_f32(a: Lanes) -> Lanes {
        map(a, |a| (a as f32).to_bits())
    }

    #[inline(always)]
    unsafe fn to_u32(a: Lanes) -> Lanes {
        map(a, |a| f32::from_bits(a) as u32)
    }

    #[inline(always)]
    unsafe fn lt(a: Lanes, b: Lanes) -> Lanes {
        test_f(a, b, |a, b| a < b)
    }

    #[inline(always)]
    unsafe fn le(a: Lanes, b: Lanes) -> Lanes {
        test_f(a, b, |a, b| a <= b)
    }

    #[inline(always)]
    unsafe fn eq(a: Lanes, b: Lanes) -> Lanes {
        test_f(a, b, |a, b| a == b)
    }

    #[inline(always)]
    unsafe fn ult(a: Lanes, b: Lanes) -> Lanes {
        test(a, b, |a, b| a < b)
    }

    #[inline(always)]
    unsafe fn ueq(a: Lanes, b: Lanes) -> Lanes {
        test(a, b, |a, b| a == b)
    }

    #[inline(always)]
    unsafe fn select(m: Lanes, a: Lanes, b: Lanes) -> Lanes {
        let mut out = b;
        for i in 0..LANES {
            out.0[i] = (m.0[i] & a.0[i]) | (!m.0[i] & b.0[i]);
        }
        out
    }

    #[inline(always)]
    unsafe fn load_even_odd(p: *const f32) -> (Lanes, Lanes) {
        let mut halves = (Lanes([0; LANES]), Lanes([0; LANES]));
        for i in 0..LANES {
            // SAFETY: the caller vouches for 16 lanes at `p`.
            unsafe {
                halves.0.0[i] = (*p.add(2 * i)).to_bits();
                halves.1.0[i] = (*p.add(2 * i + 1)).to_bits();
            }
        }
        halves
    }

    #[inline(always)]
    unsafe fn transpose_rows(from: &[*const f32; 16], row: usize, to: *mut f32, stride: usize) {
        for r in 0..4 {
            for i in 0..LANES {
                // SAFETY: the caller vouches for four floats from `row` on, and for eight lanes at each vector.
                unsafe { *to.add(r * stride + i) = *from[i].add(row + r) };
            }
        }
    }
}
