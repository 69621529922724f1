//! Sum of outer products of two channel-major tiles, `g[k][n] += sum_r x[k][r] d[n][r]`: the gradient of weights.
//!
//! One operand is transposed, [`PANEL`] channels at a time, so that its channels lie along vectors. The rest is the
//! micro-kernel of [`super::gemm()`]: `MR` channels of the other operand, each broadcast, times `NV` vectors, summed over
//! rows in registers. Sums start at zero and are added to `g` last, because `g` often has to come from far away.
//!
//! `g` lies in panels too, `[vectors / 32][others][32]`. The operand along vectors is the one that costs less
//! ([`x_along_vectors`]); every sum over rows runs in order, with fused multiply-adds where there are any.
use super::products::{Channels, Multiply, Pairs, Singles, over_rows_len};
use super::simd::{Kernel, Simd, launch};
use super::{Isa, Products};
use std::mem::MaybeUninit;

/// Channels of a panel.
pub const PANEL: usize = 32;
/// Row counts are multiples of this.
pub const ROWS: usize = 8;
/// Lanes along the sum that are transposed, and multiplied, at a time: half of `ROWS`, which are in pairs at most.
const STEPS: usize = 4;
/// Most rows (or pairs) of a transposed panel: 24 KiB, which stay in the L1 cache while the other operand passes by.
const PANEL_ROWS: usize = 192;
/// Transposing a value takes about as long as this many multiply-adds.
const TRANSPOSITION: usize = 6;

/// Operands of [`outer`].
#[derive(Clone, Copy, Debug)]
pub struct Outer {
    /// What is multiplied.
    pub products: Products,
    /// [`outer_scratch`] lanes, which the kernel may write.
    pub scratch: *mut f32,
    /// `[k][rows]`, row stride `ldx`: the channels from `first` on of an operand that has `channels` of them.
    pub x: *const f32,
    pub ldx: usize,
    pub k: usize,
    /// A multiple of [`PANEL`] if `x` lies along vectors, and then `k` is one too, except for the last channels.
    pub first: usize,
    pub channels: usize,
    /// `[n][rows]`, row stride `ldd`.
    pub d: *const f32,
    pub ldd: usize,
    pub n: usize,
    /// A multiple of [`ROWS`]; all of them count. Both operands have whole blocks of [`super::ROW_BLOCK`] rows.
    pub rows: usize,
    /// Accumulator of [`outer_len`]`(channels, n)` floats, in panels.
    pub g: *mut f32,
}

/// Whether the rows of a `k` by `n` accumulator, and so the channels of `x`, lie along vectors. Otherwise those of `d` do.
pub fn x_along_vectors(k: usize, n: usize) -> bool {
    let cost = |vectors: usize, others: usize| vectors.next_multiple_of(16) * (others + TRANSPOSITION);
    cost(k, n) < cost(n, k)
}

/// Floats of a `k` by `n` accumulator in panels.
pub fn outer_len(k: usize, n: usize) -> usize {
    if x_along_vectors(k, n) { k.next_multiple_of(PANEL) * n } else { k * n.next_multiple_of(PANEL) }
}

/// Lanes of scratch that the sum over `rows` rows of operands of `k` and `n` channels takes: both in pairs.
pub fn outer_scratch(products: Products, k: usize, n: usize, rows: usize) -> usize {
    let (vectors, others) = if x_along_vectors(k, n) { (k, n) } else { (n, k) };
    let rows = rows.min(PANEL_ROWS * products.values());
    over_rows_len(products, others, rows) + over_rows_len(products, vectors.min(PANEL), rows)
}

/// Adds the outer products of all rows to `g`. What the padding of its last panel holds afterwards means nothing.
///
/// # Safety
/// `isa.supported()`. `rows` is a multiple of [`ROWS`]; the pointers are valid for the shapes given at the fields; `g`
/// overlaps neither `x` nor `d`.
pub unsafe fn outer(isa: Isa, args: Outer) {
    debug_assert!(args.rows.is_multiple_of(ROWS));
    debug_assert!(args.first + args.k <= args.channels);
    debug_assert!(args.first.is_multiple_of(PANEL) || !x_along_vectors(args.channels, args.n));
    // SAFETY: forwarded contract.
    unsafe {
        #[cfg(target_arch = "x86_64")]
        if (isa, args.products) == (Isa::AmxBf16, Products::Bf16) {
            return super::amx::outer(&args);
        }
        launch(isa, &args);
    }
}

/// Copies (or adds) an accumulator in panels to the row-major `[k][n]` matrix `out`.
///
/// # Panics
/// If `g` (of [`outer_len`] floats) or `out` is too short.
pub fn unblock(g: &[f32], k: usize, n: usize, out: &mut [f32], add: bool) {
    let g = &g[..outer_len(k, n)];
    let x_along_vectors = x_along_vectors(k, n);
    for (i, row) in out[..k * n].chunks_exact_mut(n.max(1)).enumerate() {
        for (p, out) in row.chunks_mut(PANEL).enumerate() {
            let (from, step) = if x_along_vectors {
                (&g[(i / PANEL * n + p * PANEL) * PANEL + i % PANEL..], PANEL)
            } else {
                (&g[(p * k + i) * PANEL..], 1)
            };
            for (out, &value) in out.iter_mut().zip(from.iter().step_by(step)) {
                *out = if add { *out + value } else { value };
            }
        }
    }
}

/// A transposed panel, `[row][PANEL]`.
#[repr(align(64))]
struct Panel(MaybeUninit<[f32; PANEL_ROWS * PANEL]>);

impl Kernel for Outer {
    type Out = ();
    const PAIRS: bool = true;

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        // SAFETY: forwarded contract.
        unsafe {
            match self.products {
                Products::F32 => self.run_with::<S, Singles>(),
                Products::Bf16 => self.run_with::<S, Pairs>(),
            }
        }
    }
}

impl Outer {
    /// # Safety
    /// As [`outer`].
    #[inline(always)]
    unsafe fn run_with<S: Simd, P: Multiply<S>>(&self) {
        // SAFETY: forwarded contract. `NV` is twice `HALF`, and `NV * LANES` divides `PANEL`.
        unsafe {
            match S::REGISTERS {
                32.. => self.panels::<S, P, 8, 2, 1, false>(),
                16.. => self.panels::<S, P, 3, 4, 2, false>(),
                _ => self.panels::<S, P, 2, 2, 1, false>(),
            }
        }
    }

    /// All panels, in blocks of `MR` channels and `NV` vectors, or `HALF` as many at the end of the last panel; or `IN_TILES`
    /// (see [`super::amx`]).
    ///
    /// # Safety
    /// As [`outer`], `NV` is twice `HALF`, and `NV * S::LANES` divides [`PANEL`].
    #[inline(always)]
    pub(super) unsafe fn panels<
        S: Simd,
        P: Multiply<S>,
        const MR: usize,
        const NV: usize,
        const HALF: usize,
        const IN_TILES: bool,
    >(
        &self,
    ) {
        let x = Channels { at: self.x, ld: self.ldx, count: self.k };
        let d = Channels { at: self.d, ld: self.ldd, count: self.n };
        let (vectors, others, height, first) = if x_along_vectors(self.channels, self.n) {
            (x, d, self.n, self.first * self.n)
        } else {
            (d, x, self.channels, self.first * PANEL)
        };
        let mut panel = Panel(MaybeUninit::uninit());
        let panel: *mut f32 = panel.0.as_mut_ptr().cast();
        let mut row = 0;
        while row < self.rows {
            let rows = (PANEL_ROWS * P::PRODUCTS.values()).min(self.rows - row);
            let mut steps = P::PRODUCTS.lanes(rows);
            if IN_TILES {
                // Zeros fill the last tile.
                steps = steps.next_multiple_of(16);
            }
            // SAFETY: `rows` rows from `row` on of every channel, in whole blocks, and the scratch has room for them.
            let (others, strip) = unsafe {
                let others = Channels { at: others.at.add(row), ..others };
                let strip = self.scratch.wrapping_add(over_rows_len(P::PRODUCTS, others.count, rows));
                (P::over_rows(others, rows, self.scratch), strip)
            };
            let mut channel = 0;
            while channel < vectors.count {
                let count = PANEL.min(vectors.count - channel);
                // SAFETY: `count` channels from `channel` on and `rows` rows from `row` on lie inside the operand, and
                // the panel has room for them, up to whole vectors: all those that are multiplied. Panel `channel / PANEL` of
                // `g` has `height` lines of `PANEL` floats.
                unsafe {
                    let from = Channels { at: vectors.at.add(channel * vectors.ld + row), count, ..vectors };
                    let width = count.next_multiple_of(HALF * S::LANES);
                    transpose::<S>(P::over_rows(from, rows, strip), width, steps, panel);
                    let g = self.g.add(first + channel * height);
                    match IN_TILES {
                        #[cfg(target_arch = "x86_64")]
                        true => super::amx::blocks::<S>(panel, count, others, steps, g),
                        _ => columns::<S, P, MR, NV, HALF>(panel, count, others, steps, g),
                    }
                }
                channel += PANEL;
            }
            row += rows;
        }
    }
}

/// Writes `rows` lanes of `width` channels to `panel`; channels beyond the last one repeat it.
///
/// # Safety
/// As [`outer`]: the channels have `rows` rows, and `panel` has room for as many lines of [`PANEL`] floats. `width` is at most
/// [`PANEL`], in whole vectors.
#[inline(always)]
unsafe fn transpose<S: Simd>(from: Channels, width: usize, rows: usize, panel: *mut f32) {
    let mut channel = 0;
    while channel < width {
        let mut at = [from.at; 16];
        for (i, at) in at.iter_mut().enumerate() {
            *at = from.at.wrapping_add((channel + i).min(from.count - 1) * from.ld);
        }
        let mut row = 0;
        while row < rows {
            // SAFETY: four rows of existing channels, and four lines of the panel; `LANES` divides `PANEL`.
            unsafe { S::transpose_rows(&at, row, panel.add(row * PANEL + channel), PANEL) };
            row += STEPS;
        }
        channel += S::LANES;
    }
}

/// All sums of a panel: the first `count` of its columns by all of `others`.
///
/// # Safety
/// As [`Outer::panels`]: `g` has a line of the panel for each of `others`. Up to the next multiple of `HALF` vectors, the panel's
/// columns are written.
#[inline(always)]
unsafe fn columns<S: Simd, P: Multiply<S>, const MR: usize, const NV: usize, const HALF: usize>(
    panel: *const f32,
    count: usize,
    others: Channels,
    steps: usize,
    g: *mut f32,
) {
    for column in (0..count).step_by(NV * S::LANES) {
        // SAFETY: `NV` vectors of the panel and of each line, or the `HALF` that hold the last columns.
        unsafe {
            let (panel, g) = (panel.add(column), g.add(column));
            if count - column > HALF * S::LANES {
                blocks::<S, P, MR, NV>(panel, others, steps, g);
            } else {
                blocks::<S, P, MR, HALF>(panel, others, steps, g);
            }
        }
    }
}

/// All blocks of `NV` vectors: `MR` channels of `others` each, or a little fewer if that divides them evenly.
///
/// # Safety
/// As [`Outer::panels`]: `panel` and `g` point to the first of `NV` vectors, `g` has a line for each of `others`.
#[inline(always)]
unsafe fn blocks<S: Simd, P: Multiply<S>, const MR: usize, const NV: usize>(
    panel: *const f32,
    others: Channels,
    steps: usize,
    g: *mut f32,
) {
    let mut channel = 0;
    while channel < others.count {
        let rest = others.count - channel;
        let count = rest.div_ceil(rest.div_ceil(MR));
        // SAFETY: `count <= rest` channels and lines are left.
        unsafe {
            let (from, g) = (Channels { at: others.at.add(channel * others.ld), ..others }, g.add(channel * PANEL));
            match count {
                1 => block::<S, P, 1, NV>(panel, from, steps, g),
                2 => block::<S, P, 2, NV>(panel, from, steps, g),
                3 => block::<S, P, 3, NV>(panel, from, steps, g),
                // Guarded, so that narrow kernels do not compile blocks that they never need.
                4 if MR > 4 => block::<S, P, 4, NV>(panel, from, steps, g),
                5 if MR > 4 => block::<S, P, 5, NV>(panel, from, steps, g),
                6 if MR > 4 => block::<S, P, 6, NV>(panel, from, steps, g),
                7 if MR > 4 => block::<S, P, 7, NV>(panel, from, steps, g),
                _ => block::<S, P, MR, NV>(panel, from, steps, g),
            }
        }
        channel += count;
    }
}

/// Adds one block to `g`: the first `MR` channels of `others` by `NV` vectors of the panel.
///
/// # Safety
/// As [`blocks`], and `others` has `MR` channels left.
#[inline(always)]
unsafe fn block<S: Simd, P: Multiply<S>, const MR: usize, const NV: usize>(
    panel: *const f32,
    others: Channels,
    steps: usize,
    g: *mut f32,
) {
    // SAFETY: steps stay below `steps`, a multiple of `STEPS`; vectors and lines are those that the caller vouches for.
    unsafe {
        for i in 0..MR {
            for j in 0..NV {
                S::prefetch(g.add(i * PANEL + j * S::LANES));
            }
        }
        let zero = S::splat(0.0);
        let mut acc = [[zero; NV]; MR];
        let mut xs = [others.at; MR];
        for i in 0..MR {
            xs[i] = others.at.add(i * others.ld);
        }
        let mut step = 0;
        while step < steps {
            for r in step..step + STEPS {
                let line = panel.add(r * PANEL);
                if NV > MR {
                    let mut ws = [zero; MR];
                    for i in 0..MR {
                        ws[i] = S::splat(*xs[i].add(r));
                    }
                    for j in 0..NV {
                        let v = S::load(line.add(j * S::LANES));
                        for i in 0..MR {
                            acc[i][j] = P::multiply_add(ws[i], v, acc[i][j]);
                        }
                    }
                } else {
                    let mut vs = [zero; NV];
                    for j in 0..NV {
                        vs[j] = S::load(line.add(j * S::LANES));
                    }
                    for i in 0..MR {
                        let w = S::splat(*xs[i].add(r));
                        for j in 0..NV {
                            acc[i][j] = P::multiply_add(w, vs[j], acc[i][j]);
                        }
                    }
                }
            }
            step += STEPS;
        }
        for i in 0..MR {
            for j in 0..NV {
                let g = g.add(i * PANEL + j * S::LANES);
                S::store(g, S::add(S::load(g), acc[i][j]));
            }
        }
    }
}
