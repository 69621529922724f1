//! Reductions over the rows of a channel-major tile.
//!
//! Sixteen partial results, one per row modulo 16, are combined in a fixed tree: the result does not depend on the
//! instruction set. Of long channels every block of rows has its own, and their results are combined in double precision.
use super::Isa;
use super::simd::{Kernel, Simd, launch};
use std::ops::Add;

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
    fn scalars<T: PartialOrd + Add<Output = T>>(a: T, b: T) -> T;
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
    fn scalars<T: PartialOrd + Add<Output = T>>(a: T, b: T) -> T {
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
    fn scalars<T: PartialOrd + Add<Output = T>>(a: T, b: T) -> T {
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
/// Rows of a block.
const BLOCK: usize = 1024;

impl<C: Combine> Kernel for Reduce<C> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        for c in 0..self.channels {
            let mut total = f64::from(C::START);
            for first in (0..self.rows).step_by(BLOCK) {
                // SAFETY: `c < channels`, and the block ends with the channel.
                let block = unsafe { self.block::<S>(self.x.add(c * self.ldx + first), BLOCK.min(self.rows - first)) };
                total = C::scalars(total, f64::from(block));
            }
            // SAFETY: `c < channels`.
            unsafe { *self.acc.add(c) = C::scalars(*self.acc.add(c), total as f32) };
        }
    }
}

impl<C: Combine> Reduce<C> {
    /// Reduces the block of `rows` at `x`.
    ///
    /// # Safety
    /// `x` is valid for `rows` values, and the CPU has the instruction set of `S`.
    #[inline(always)]
    unsafe fn block<S: Simd>(&self, x: *const f32, rows: usize) -> f32 {
        const { assert!(S::LANES == PARTS || 2 * S::LANES == PARTS) };
        let vectors = PARTS / S::LANES;
        let whole = rows / PARTS * PARTS;
        // SAFETY: rows up to `whole` are read in vectors, the rest is copied to a padded array.
        unsafe {
            let mut parts = [S::splat(C::START); 2];
            for row in (0..whole).step_by(PARTS) {
                for j in 0..vectors {
                    parts[j] = C::vectors::<S>(parts[j], S::load(x.add(row + j * S::LANES)));
                }
            }
            if whole < rows {
                let mut tail = [C::START; PARTS];
                std::ptr::copy_nonoverlapping(x.add(whole), tail.as_mut_ptr(), rows - whole);
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
