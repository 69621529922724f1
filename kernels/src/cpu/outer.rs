//! Sum of outer products of two channel-major tiles, `g[k][n] += sum_r x[k][r] d[n][r]`: the gradient of weights.
//!
//! The sum over rows runs inside vectors, so a 4x4 block of `g` takes 16 accumulator vectors, which a transposing tree
//! reduces to the 16 sums at the end. `g` therefore lives in **blocks**, `[k / 4][n / 4][4][4]`: one cache line each.
//! Accumulators start at zero and are added to `g` last, because `g` often has to come from far away.
use super::Isa;
use super::simd::{Kernel, Simd, launch};

/// Side of a block of the accumulator.
pub const BLOCK: usize = 4;
/// Floats of a block.
const BLOCK_LEN: usize = BLOCK * BLOCK;
/// Floats of `d` that stay in the L1 cache while all strips of `x` pass by: half of a small cache.
const RESIDENT: usize = 4096;

/// Operands of [`outer`].
#[derive(Clone, Copy, Debug)]
pub struct Outer {
    /// `[k][rows]`, row stride `ldx`.
    pub x: *const f32,
    pub ldx: usize,
    pub k: usize,
    /// `[n][rows]`, row stride `ldd`.
    pub d: *const f32,
    pub ldd: usize,
    pub n: usize,
    /// A multiple of 16; all of them count.
    pub rows: usize,
    /// Blocked accumulator of [`outer_len`] floats.
    pub g: *mut f32,
}

/// Floats of a blocked `k` by `n` accumulator.
pub fn outer_len(k: usize, n: usize) -> usize {
    k.div_ceil(BLOCK) * n.div_ceil(BLOCK) * BLOCK_LEN
}

/// Adds the outer products of all rows to `g`; the padding of edge blocks is left alone.
///
/// # Safety
/// `isa.supported()`. `rows` is a multiple of 16; the pointers are valid for the shapes given at the fields; `g`
/// overlaps neither `x` nor `d`.
pub unsafe fn outer(isa: Isa, args: Outer) {
    debug_assert_eq!(args.rows % 16, 0);
    // SAFETY: forwarded contract.
    unsafe { launch(isa, &args) }
}

/// Copies (or adds) a blocked accumulator to the row-major `[k][n]` matrix `out`.
///
/// # Panics
/// If `g` (of [`outer_len`] floats) or `out` is too short.
pub fn unblock(g: &[f32], k: usize, n: usize, out: &mut [f32], add: bool) {
    let g = &g[..outer_len(k, n)];
    let row_len = n.div_ceil(BLOCK) * BLOCK_LEN;
    for (i, row) in out[..k * n].chunks_exact_mut(n.max(1)).enumerate() {
        let blocks = g[i / BLOCK * row_len..][..row_len].chunks_exact(BLOCK_LEN);
        for (out, block) in row.chunks_mut(BLOCK).zip(blocks) {
            let block = &block[i % BLOCK * BLOCK..][..BLOCK];
            for (out, &value) in out.iter_mut().zip(block) {
                *out = if add { *out + value } else { value };
            }
        }
    }
}

impl Kernel for Outer {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        // SAFETY: forwarded contract.
        unsafe {
            match S::REGISTERS {
                32.. => self.blocks::<S, 4>(),
                16.. => self.blocks::<S, 2>(),
                _ => self.blocks::<S, 1>(),
            }
        }
    }
}

impl Outer {
    /// All blocks, `N` columns of a block at a time.
    ///
    /// # Safety
    /// As [`outer`], and `N` divides [`BLOCK`].
    #[inline(always)]
    unsafe fn blocks<S: Simd, const N: usize>(&self) {
        let (row_blocks, column_blocks) = (self.k.div_ceil(BLOCK), self.n.div_ceil(BLOCK));
        let group = (RESIDENT / (BLOCK * self.rows.max(1))).max(2);
        let mut first = 0;
        while first < column_blocks {
            let last = column_blocks.min(first + group);
            for kb in 0..row_blocks {
                for nb in first..last {
                    // SAFETY: block (kb, nb) lies inside `g`. An edge block goes to a zeroed copy first.
                    unsafe {
                        let g = self.g.add((kb * column_blocks + nb) * BLOCK_LEN);
                        if (kb + 1) * BLOCK <= self.k && (nb + 1) * BLOCK <= self.n {
                            self.block::<S, N>(kb, nb, g);
                        } else {
                            let mut sums = [0.0; BLOCK_LEN];
                            self.block::<S, N>(kb, nb, sums.as_mut_ptr());
                            for i in 0..BLOCK.min(self.k - kb * BLOCK) {
                                for j in 0..BLOCK.min(self.n - nb * BLOCK) {
                                    *g.add(i * BLOCK + j) += sums[i * BLOCK + j];
                                }
                            }
                        }
                    }
                }
            }
            first = last;
        }
    }

    /// Adds block (kb, nb) of the result to the block at `g`. Channels beyond the last one read the last one.
    ///
    /// # Safety
    /// As [`outer`]; `kb` and `nb` are block indices in range, and `g` is valid for a block.
    #[inline(always)]
    unsafe fn block<S: Simd, const N: usize>(&self, kb: usize, nb: usize, g: *mut f32) {
        // SAFETY: channel indices are clamped to `k - 1` and `n - 1`, rows stay below `rows`, which `LANES` divides.
        unsafe {
            S::prefetch(g);
            let mut xs = [self.x; BLOCK];
            for i in 0..BLOCK {
                xs[i] = self.x.add((kb * BLOCK + i).min(self.k - 1) * self.ldx);
            }
            for part in 0..BLOCK / N {
                let mut ds = [self.d; N];
                for j in 0..N {
                    ds[j] = self.d.add((nb * BLOCK + part * N + j).min(self.n - 1) * self.ldd);
                }
                let mut acc = [[S::splat(0.0); N]; BLOCK];
                let mut row = 0;
                while row < self.rows {
                    let mut dv = [S::splat(0.0); N];
                    for j in 0..N {
                        dv[j] = S::load(ds[j].add(row));
                    }
                    for i in 0..BLOCK {
                        let xv = S::load(xs[i].add(row));
                        for j in 0..N {
                            acc[i][j] = S::fma(xv, dv[j], acc[i][j]);
                        }
                    }
                    row += S::LANES;
                }
                S::add_lane_sums::<N>(&acc, g.add(part * N));
            }
        }
    }
}
