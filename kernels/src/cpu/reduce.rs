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

/// Raises `acc[c]` to the maximum of the first `rows` values of channel `c`; NaN if one is.
///
/// # Safety
/// As [`rows_sum`].
pub unsafe fn rows_max(isa: Isa, x: *const f32, ldx: usize, channels: usize, rows: usize, acc: *mut f32) {
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &Reduce::<Max> { x, ldx, channels, rows, acc, op: Max }) }
}

/// Raises the first `len` values of `acc` to those of `x`; NaN where either is.
///
/// # Safety
/// `isa.supported()`; `acc` and `x` are valid for `len` values.
pub unsafe fn raise(isa: Isa, acc: *mut f32, x: *const f32, len: usize) {
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &Raise { acc, x, len }) }
}

/// The larger of two numbers, NaN if either is.
pub fn larger<T: PartialOrd>(a: T, b: T) -> T {
    if a > b || a.partial_cmp(&a).is_none() { a } else { b }
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
        // SAFETY: forwarded contract. Of NaN, the maximum passes on that of `b`.
        unsafe { S::select(S::eq(a, a), S::max(a, b), a) }
    }
    #[inline(always)]
    fn scalars<T: PartialOrd + Add<Output = T>>(a: T, b: T) -> T {
        larger(a, b)
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

struct Raise {
    acc: *mut f32,
    x: *const f32,
    len: usize,
}

impl Kernel for Raise {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        let whole = self.len / S::LANES * S::LANES;
        let rest = self.len - whole;
        // SAFETY: lanes below `len`.
        unsafe {
            for at in (0..whole).step_by(S::LANES) {
                let acc = self.acc.add(at);
                S::store(acc, Max::vectors::<S>(S::load(acc), S::load(self.x.add(at))));
            }
            if rest > 0 {
                let acc = self.acc.add(whole);
                let raised = Max::vectors::<S>(S::load_head(acc, rest), S::load_head(self.x.add(whole), rest));
                S::store_head(acc, rest, raised);
            }
        }
    }
}
