//! Reductions over the rows of a channel-major tile.
//!
//! Sixteen partial results, one per row modulo 16, are combined in a fixed tree: the result does not depend on the
//! instruction set.
use super::Isa;
use super::simd::{Kernel, Simd, launch};

/// Adds to `acc[c]` the sum of the first `rows` values of channel `c`.
///
/// # Safety
/// `isa.supported()`; `x` is valid for `[channels][rows]` with row stride `ldx`, and `acc` for `channels` values.
pub unsafe fn rows_sum(isa: Isa, x: *const f32, ldx: usize, channels: usize, rows: usize, acc: *mut f32) {
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &Reduce::<Sum> { x, ldx, channels, rows, acc, op: Sum }) }
}

/// Raises `acc[c]` to the maximum of the first `rows` values of channel `c`, which hold no NaN.
///
/// # Safety
/// As [`rows_sum`].
pub unsafe fn rows_max(isa: Isa, x: *const f32, ldx: usize, channels: usize, rows: usize, acc: *mut f32) {
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &Reduce::<Max> { x, ldx, channels, rows, acc, op: Max }) }
}

/// An associative operation.
trait Combine: Copy {
    /// Neutral element.
    const START: f32;
    /// # Safety
    /// As [`Simd`].
    unsafe fn vectors<S: Simd>(a: S::V, b: S::V) -> S::V;
    fn scalars(a: f32, b: f32) -> f32;
}

#[derive(Clone, Copy)]
struct Sum;
#[derive(Clone, Copy)]
struct Max;

impl Combine for Sum {
    // Adding -0 changes nothing, not even a zero's sign.
    const START: f32 = -0.0;
    #[inline(always)]
    unsafe fn vectors<S: Simd>(a: S::V, b: S::V) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::add(a, b) }
    }
    #[inline(always)]
    fn scalars(a: f32, b: f32) -> f32 {
        a + b
    }
}

impl Combine for Max {
    const START: f32 = f32::NEG_INFINITY;
    #[inline(always)]
    unsafe fn vectors<S: Simd>(a: S::V, b: S::V) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::max(a, b) }
    }
    #[inline(always)]
    fn scalars(a: f32, b: f32) -> f32 {
        if a > b { a } else { b }
    }
}

struct Reduce<C> {
    x: *const f32,
    ldx: usize,
    channels: usize,
    rows: usize,
    acc: *mut f32,
    #[expect(dead_code, reason = "names the operation")]
    op: C,
}

/// Partial results per channel.
const PARTS: usize = 16;

impl<C: Combine> Kernel for Reduce<C> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        for c in 0..self.channels {
            // SAFETY: `c < channels`.
            unsafe {
                let total = self.channel::<S>(self.x.add(c * self.ldx));
                let acc = self.acc.add(c);
                *acc = C::scalars(*acc, total);
            }
        }
    }
}

impl<C: Combine> Reduce<C> {
    /// Reduces the channel at `x`.
    ///
    /// # Safety
    /// `x` is valid for `rows` values, and the CPU has the instruction set of `S`.
    #[inline(always)]
    unsafe fn channel<S: Simd>(&self, x: *const f32) -> f32 {
        const { assert!(S::LANES == PARTS || 2 * S::LANES == PARTS) };
        let vectors = PARTS / S::LANES;
        let whole = self.rows / PARTS * PARTS;
        // SAFETY: rows up to `whole` are read in vectors, the rest is copied to a padded array.
        unsafe {
            let mut parts = [S::splat(C::START); 2];
            for row in (0..whole).step_by(PARTS) {
                for j in 0..vectors {
                    parts[j] = C::vectors::<S>(parts[j], S::load(x.add(row + j * S::LANES)));
                }
            }
            if whole < self.rows {
                let mut tail = [C::START; PARTS];
                std::ptr::copy_nonoverlapping(x.add(whole), tail.as_mut_ptr(), self.rows - whole);
                for j in 0..vectors {
                    parts[j] = C::vectors::<S>(parts[j], S::load(tail.as_ptr().add(j * S::LANES)));
                }
            }
            let mut p = [0.0f32; PARTS];
            for j in 0..vectors {
                S::store(p.as_mut_ptr().add(j * S::LANES), parts[j]);
            }
            let mut half = PARTS / 2;
            while half > 0 {
                for i in 0..half {
                    p[i] = C::scalars(p[i], p[i + half]);
                }
                half /= 2;
            }
            p[0]
        }
    }
}
