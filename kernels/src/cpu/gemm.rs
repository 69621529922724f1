//! Matrix product of packed weights with a channel-major tile: `y = bias + W x`.
//!
//! The micro-kernel keeps an `MR` x `NV` block of accumulator vectors, `MR` outputs by `NV` vectors of rows, and per
//! step of the contraction loads `NV` vectors of `x` and broadcasts `MR` weights; the fewer of them are kept in
//! registers while the others pass. Row blocks are the outer loop, so that the slab of `x` that a block reads stays in
//! the L1 cache while the panels stream through.
use super::panels::{PANEL, panel_len};
use super::products::{Channels, Multiply, Pairs, Singles};
use super::simd::{Kernel, Simd, launch};
use super::{Isa, Products, ROW_BLOCK};

/// What happens to a finished output.
#[derive(Clone, Copy, Debug)]
pub enum Epilogue {
    None,
    /// `max(y, 0)`.
    Relu,
    /// `y` where `h > 0`, else 0: the derivative of a rectifier whose output is `h`. `h` may be `y` itself.
    Mask {
        h: *const f32,
        ldh: usize,
    },
}

/// Operands of [`gemm`]: `y[o][r] = epilogue(bias[o] + sum_c w[o][c] x[c][r])`, or `+=` instead of `=`.
#[derive(Clone, Copy, Debug)]
pub struct Gemm {
    /// `[contraction][rows]`, row stride `ldx`.
    pub x: *const f32,
    pub ldx: usize,
    pub contraction: usize,
    /// What is multiplied.
    pub products: Products,
    /// [`gemm_scratch`] lanes, which the kernel may write.
    pub scratch: *mut f32,
    /// Packed by [`super::pack_panels`] for the same products.
    pub panels: *const f32,
    pub outputs: usize,
    /// One value per output, or null for zeros.
    pub bias: *const f32,
    /// Adds the old `y` before the epilogue.
    pub accumulate: bool,
    pub epilogue: Epilogue,
    /// `[outputs][rows]`, row stride `ldy`.
    pub y: *mut f32,
    pub ldy: usize,
    /// A multiple of [`ROW_BLOCK`].
    pub rows: usize,
}

/// Most rows that a kernel multiplies at a time: in pairs, those of 256 channels fill two thirds of an L1 cache of 48 KiB.
pub(super) const MOST_ROWS: usize = 2 * ROW_BLOCK;

/// Lanes of scratch that a product of `contraction` channels takes: blocks of rows of the operand in pairs.
pub fn gemm_scratch(products: Products, contraction: usize) -> usize {
    match products {
        Products::F32 => 0,
        Products::Bf16 => products.weight_stride(contraction) * MOST_ROWS,
    }
}

/// Computes the product.
///
/// # Safety
/// `isa.supported()`. `rows` is a multiple of [`ROW_BLOCK`]; the pointers are valid for the shapes given at the fields;
/// `y` overlaps no operand, except that `h` of the epilogue may equal `y` with `ldh == ldy`.
pub unsafe fn gemm(isa: Isa, args: Gemm) {
    debug_assert_eq!(args.rows % ROW_BLOCK, 0);
    // SAFETY: forwarded contract.
    unsafe {
        #[cfg(target_arch = "x86_64")]
        if (isa, args.products) == (Isa::AmxBf16, Products::Bf16) {
            return super::amx::gemm(&args);
        }
        launch(isa, &args);
    }
}

impl Kernel for Gemm {
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

impl Gemm {
    /// # Safety
    /// As [`gemm`].
    #[inline(always)]
    unsafe fn run_with<S: Simd, P: Multiply<S>>(&self) {
        // SAFETY: forwarded contract. `NV * LANES` divides `ROW_BLOCK`.
        unsafe {
            match S::REGISTERS {
                32.. => self.blocks::<S, P, 8, 2>(),
                16.. => self.blocks::<S, P, 3, 4>(),
                _ => self.blocks::<S, P, 2, 2>(),
            }
        }
    }

    /// All blocks of `MR` outputs and `NV` vectors, fewer outputs where a panel or the outputs end.
    ///
    /// # Safety
    /// As [`gemm`], and `NV * S::LANES` divides `rows`.
    #[inline(always)]
    unsafe fn blocks<S: Simd, P: Multiply<S>, const MR: usize, const NV: usize>(&self) {
        let panel_size = panel_len(P::PRODUCTS, self.contraction, PANEL);
        let ld = P::PRODUCTS.weight_stride(self.contraction);
        let mut row = 0;
        while row < self.rows {
            // SAFETY: every channel has a block of rows here, and the scratch has room for one.
            let x = unsafe {
                let channels = Channels { at: self.x.add(row), ld: self.ldx, count: self.contraction };
                P::over_channels::<NV>(channels, self.scratch)
            };
            let mut output = 0;
            while output < self.outputs {
                let count = MR.min(self.outputs - output).min(PANEL - output % PANEL);
                // SAFETY: `output < outputs`, so that its panel exists; each block has `count` outputs left, and
                // `row + NV * LANES <= rows` since the block height divides `rows`.
                unsafe {
                    let panel = self.panels.add(output / PANEL * panel_size + P::weight(output % PANEL, ld));
                    match count {
                        1 => self.block::<S, P, 1, NV>(x, panel, ld, output, row),
                        2 => self.block::<S, P, 2, NV>(x, panel, ld, output, row),
                        3 => self.block::<S, P, 3, NV>(x, panel, ld, output, row),
                        // Guarded, so that narrow kernels do not compile blocks that they never need.
                        4 if MR > 4 => self.block::<S, P, 4, NV>(x, panel, ld, output, row),
                        5 if MR > 4 => self.block::<S, P, 5, NV>(x, panel, ld, output, row),
                        6 if MR > 4 => self.block::<S, P, 6, NV>(x, panel, ld, output, row),
                        7 if MR > 4 => self.block::<S, P, 7, NV>(x, panel, ld, output, row),
                        _ => self.block::<S, P, MR, NV>(x, panel, ld, output, row),
                    }
                }
                output += count;
            }
            row += NV * S::LANES;
        }
    }

    /// One block: outputs `output..output + MR` of rows `row..row + NV * S::LANES`.
    ///
    /// # Safety
    /// As [`gemm`]; the block lies inside `y`, and `panel` points to the weights of its first output.
    #[inline(always)]
    unsafe fn block<S: Simd, P: Multiply<S>, const MR: usize, const NV: usize>(
        &self,
        x: Channels,
        panel: *const f32,
        ld_weights: usize,
        output: usize,
        row: usize,
    ) {
        // SAFETY: every access is step `< count` of `x`, or output `output + i` of `bias`, `y` and `h`, at
        // vector `j` of the block's rows: inside by the contract. Weights stay in the panel because
        // `output % PANEL + MR <= PANEL`.
        unsafe {
            let zero = S::splat(0.0);
            let mut acc = [[zero; NV]; MR];
            if !self.bias.is_null() {
                for i in 0..MR {
                    acc[i] = [S::splat(*self.bias.add(output + i)); NV];
                }
            }
            let Channels { mut at, ld, count } = x;
            let mut weights = panel;
            for _ in 0..count {
                if NV > MR {
                    let mut ws = [zero; MR];
                    for i in 0..MR {
                        ws[i] = S::splat(*weights.add(P::weight(i, ld_weights)));
                    }
                    for j in 0..NV {
                        let v = S::load(at.add(j * S::LANES));
                        for i in 0..MR {
                            acc[i][j] = P::multiply_add(ws[i], v, acc[i][j]);
                        }
                    }
                } else {
                    let mut xs = [zero; NV];
                    for j in 0..NV {
                        xs[j] = S::load(at.add(j * S::LANES));
                    }
                    for i in 0..MR {
                        let w = S::splat(*weights.add(P::weight(i, ld_weights)));
                        for j in 0..NV {
                            acc[i][j] = P::multiply_add(w, xs[j], acc[i][j]);
                        }
                    }
                }
                // `wrapping_add`: after the last step the pointer may lie beyond the end of the tile.
                at = at.wrapping_add(ld);
                weights = weights.wrapping_add(P::WEIGHT_STEP);
            }
            self.finish::<S, MR, NV>(&mut acc, output, row);
        }
    }

    /// Applies the old `y` and the epilogue to the accumulators of a block, and stores them. One loop per case, because the
    /// compiler keeps accumulators in registers only in loops simple enough to be unrolled.
    ///
    /// # Safety
    /// As [`gemm`]; the block lies inside `y`.
    #[inline(always)]
    pub(super) unsafe fn finish<S: Simd, const MR: usize, const NV: usize>(
        &self,
        acc: &mut [[S::V; NV]; MR],
        output: usize,
        row: usize,
    ) {
        // SAFETY: the block lies inside `y` and `h`.
        unsafe {
            if self.accumulate {
                for i in 0..MR {
                    for j in 0..NV {
                        let y = self.y.add((output + i) * self.ldy + row + j * S::LANES);
                        acc[i][j] = S::add(S::load(y), acc[i][j]);
                    }
                }
            }
            let zero = S::splat(0.0);
            match self.epilogue {
                Epilogue::None => {}
                Epilogue::Relu => {
                    for i in 0..MR {
                        for j in 0..NV {
                            acc[i][j] = S::max(zero, acc[i][j]);
                        }
                    }
                }
                Epilogue::Mask { h, ldh } => {
                    for i in 0..MR {
                        for j in 0..NV {
                            let active = S::lt(zero, S::load(h.add((output + i) * ldh + row + j * S::LANES)));
                            acc[i][j] = S::select(active, acc[i][j], zero);
                        }
                    }
                }
            }
            for i in 0..MR {
                for j in 0..NV {
                    S::store(self.y.add((output + i) * self.ldy + row + j * S::LANES), acc[i][j]);
                }
            }
        }
    }
}
