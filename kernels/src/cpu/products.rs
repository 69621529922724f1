//! What the matrix kernels multiply: floats, or pairs of bfloat16 values whose products are summed in single precision.
//!
//! With [`Products::Bf16`] a lane holds two neighbours along the sum, the first one in its low half. Instructions multiply
//! tiles of them ([`Isa::AmxBf16`](super::Isa), in [`super::amx`]) or add both products to a lane of the sum
//! ([`Isa::Avx512Bf16`](super::Isa)). Elsewhere the same numbers are computed from the halves of a lane, slower than in
//! single precision. Operands are rounded (to nearest, ties to even) where a kernel reads them; nothing is stored so.
use super::ROW_BLOCK;
use super::panels::PANEL;
use super::simd::Simd;

/// What matrix products multiply. Sums are in single precision.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Products {
    #[default]
    F32,
    /// Operands rounded to bfloat16: 8 bits of mantissa, the exponents of `f32`.
    Bf16,
}

impl Products {
    /// Values of an operand that share a lane.
    pub fn values(self) -> usize {
        match self {
            Products::F32 => 1,
            Products::Bf16 => 2,
        }
    }

    /// Lanes that `values` values of an operand take along the sum.
    pub fn lanes(self, values: usize) -> usize {
        values.div_ceil(self.values())
    }

    /// Lanes from the weights of one output to those of the next, where neighbours along the sum lie side by side.
    pub(super) fn weight_stride(self, contraction: usize) -> usize {
        self.lanes(contraction).next_multiple_of(16)
    }
}

/// Some channels of a tile, `ld` lanes apart.
#[derive(Clone, Copy)]
pub(super) struct Channels {
    pub at: *const f32,
    pub ld: usize,
    pub count: usize,
}

/// How the vectors of `S` hold and multiply operands.
///
/// # Safety
/// As [`Simd`].
pub(super) trait Multiply<S: Simd> {
    const PRODUCTS: Products;
    /// Lanes from a weight to the next one along the sum, see [`super::panels`].
    const WEIGHT_STEP: usize;

    /// Lanes from the weight of an output to that of the `i`-th one after it in the same panel, for lines of `ld` lanes.
    fn weight(i: usize, ld: usize) -> usize;

    /// `c` plus the products of what `a` and `b` hold.
    unsafe fn multiply_add(a: S::V, b: S::V, c: S::V) -> S::V;

    /// Channels as an operand whose sum runs over them: `NV` vectors of rows of each. They are written to `to`, of
    /// [`Products::lanes`] times `NV * LANES` lanes, unless they can stay where they are.
    unsafe fn over_channels<const NV: usize>(from: Channels, to: *mut f32) -> Channels;

    /// Channels as an operand whose sum runs over `rows` rows. They are written to `to`, of [`over_rows_len`] lanes,
    /// unless they can stay where they are, with zeros after the last row up to a multiple of 16 lanes.
    unsafe fn over_rows(from: Channels, rows: usize, to: *mut f32) -> Channels;
}

/// Lanes between channels of rows in pairs: an odd number of cache lines, see [`super::row_stride`].
fn paired_stride(rows: usize) -> usize {
    16 * (rows.next_multiple_of(ROW_BLOCK).div_ceil(ROW_BLOCK) | 1)
}

/// Lanes that [`Multiply::over_rows`] writes.
pub(super) fn over_rows_len(products: Products, channels: usize, rows: usize) -> usize {
    match products {
        Products::F32 => 0,
        Products::Bf16 => channels * paired_stride(rows),
    }
}

/// Multiply-adds in single precision.
pub(super) struct Singles;

impl<S: Simd> Multiply<S> for Singles {
    const PRODUCTS: Products = Products::F32;
    const WEIGHT_STEP: usize = PANEL;

    #[inline(always)]
    fn weight(i: usize, _: usize) -> usize {
        i
    }

    #[inline(always)]
    unsafe fn multiply_add(a: S::V, b: S::V, c: S::V) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::fma(a, b, c) }
    }

    #[inline(always)]
    unsafe fn over_channels<const NV: usize>(from: Channels, _: *mut f32) -> Channels {
        from
    }

    #[inline(always)]
    unsafe fn over_rows(from: Channels, _: usize, _: *mut f32) -> Channels {
        from
    }
}

/// Dot products of pairs.
pub(super) struct Pairs;

impl<S: Simd> Multiply<S> for Pairs {
    const PRODUCTS: Products = Products::Bf16;
    const WEIGHT_STEP: usize = 1;

    #[inline(always)]
    fn weight(i: usize, ld: usize) -> usize {
        i * ld
    }

    #[inline(always)]
    unsafe fn multiply_add(a: S::V, b: S::V, c: S::V) -> S::V {
        // SAFETY: forwarded contract.
        unsafe { S::dot(a, b, c) }
    }

    #[inline(always)]
    unsafe fn over_channels<const NV: usize>(from: Channels, to: *mut f32) -> Channels {
        let ld = NV * S::LANES;
        let steps = Products::Bf16.lanes(from.count);
        for step in 0..steps {
            // SAFETY: channels below `count`, each with `NV` vectors of rows; as many vectors for each step in `to`.
            unsafe {
                let even = from.at.add(2 * step * from.ld);
                for j in 0..NV {
                    let first = S::load(even.add(j * S::LANES));
                    let second = if 2 * step + 1 < from.count {
                        S::load(even.add(from.ld + j * S::LANES))
                    } else {
                        S::splat(0.0)
                    };
                    S::store(to.add(step * ld + j * S::LANES), S::pair(first, second));
                }
            }
        }
        Channels { at: to, ld, count: steps }
    }

    #[inline(always)]
    unsafe fn over_rows(from: Channels, rows: usize, to: *mut f32) -> Channels {
        let ld = paired_stride(rows);
        for channel in 0..from.count {
            let mut row = 0;
            while row < rows {
                // SAFETY: channels have whole blocks of rows, and `2 * LANES` divides a block; so do those in `to`.
                unsafe {
                    let pairs = S::load_pairs(from.at.add(channel * from.ld + row));
                    S::store(to.add(channel * ld + row / 2), pairs);
                }
                row += 2 * S::LANES;
            }
            // Rows that do not count hold anything.
            let steps = Products::Bf16.lanes(rows);
            // SAFETY: the stride is a multiple of 16 lanes, and these follow those of the rows.
            unsafe { to.add(channel * ld + steps).write_bytes(0, steps.next_multiple_of(16) - steps) };
        }
        Channels { at: to, ld, count: from.count }
    }
}
