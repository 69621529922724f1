//! Weight panels: the order in which the matrix kernels read a weight matrix.
//!
//! Of single weights a panel holds [`PANEL`] outputs, `[output / 8][step][8]`, so that each step of the contraction reads eight
//! neighbouring lanes. The last panel is padded with zeros. Pairs lie along the contraction, `[output][step]`, as tiles want
//! them ([`super::amx`]), with zeros up to a multiple of 16 steps.
use super::simd::{Kernel, Simd, launch};
use super::{Isa, Products};

/// Outputs of a panel.
pub const PANEL: usize = 8;

/// Lanes that the packed weights of `outputs` outputs take, with `contraction` values each.
pub fn panel_len(products: Products, contraction: usize, outputs: usize) -> usize {
    match products {
        Products::F32 => outputs.next_multiple_of(PANEL) * contraction,
        Products::Bf16 => outputs * products.weight_stride(contraction),
    }
}

/// Packs the row-major `[k][n]` matrix `w`.
///
/// Not `transposed`: outputs are columns, for `y[n] = sum_k w[k][n] x[k]`. `transposed`: outputs are rows, for
/// `y[k] = sum_n w[k][n] x[n]`.
///
/// # Panics
/// If `w` or `out` (of [`panel_len`] lanes) is too short, or the machine lacks the instruction set.
pub fn pack_panels(isa: Isa, products: Products, w: &[f32], k: usize, n: usize, transposed: bool, out: &mut [f32]) {
    let w = &w[..k * n];
    let (contraction, outputs) = if transposed { (n, k) } else { (k, n) };
    let out = &mut out[..panel_len(products, contraction, outputs)];
    if w.is_empty() {
        return;
    }
    match products {
        Products::F32 => {
            for (panel, first) in out.chunks_exact_mut(PANEL * contraction).zip((0..outputs).step_by(PANEL)) {
                let count = PANEL.min(outputs - first);
                if count < PANEL {
                    panel.fill(0.0);
                }
                if transposed {
                    for i in 0..count {
                        let row = &w[(first + i) * n..][..n];
                        panel[i..].iter_mut().step_by(PANEL).zip(row).for_each(|(slot, x)| *slot = *x);
                    }
                } else {
                    for (slots, row) in panel.chunks_exact_mut(PANEL).zip(w.chunks_exact(n)) {
                        slots[..count].copy_from_slice(&row[first..][..count]);
                    }
                }
            }
        }
        Products::Bf16 => {
            let pairs = PackPairs { w, contraction, outputs, transposed, out: out.as_mut_ptr() };
            assert!(isa.supported(), "{isa} is not supported by this machine");
            // SAFETY: the instruction set is there, and both slices have the lengths that the kernel wants.
            unsafe { launch(isa, &pairs) }
        }
    }
}

/// Packs pairs: a matrix of `contraction * outputs` floats to [`panel_len`] lanes.
struct PackPairs<'a> {
    w: &'a [f32],
    contraction: usize,
    outputs: usize,
    transposed: bool,
    out: *mut f32,
}

impl Kernel for PackPairs<'_> {
    type Out = ();
    const PAIRS: bool = true;

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        // SAFETY: forwarded contract.
        unsafe { if self.transposed { self.rows::<S>() } else { self.columns::<S>() } }
    }
}

impl PackPairs<'_> {
    /// Outputs are rows, whose neighbours are pairs as they lie there.
    ///
    /// # Safety
    /// As [`launch`].
    #[inline(always)]
    unsafe fn rows<S: Simd>(&self) {
        let ld = Products::Bf16.weight_stride(self.contraction);
        for (o, row) in self.w.chunks_exact(self.contraction).enumerate() {
            for step in (0..ld).step_by(S::LANES) {
                let rest = &row[(2 * step).min(row.len())..];
                let mut last = [0.0; 32];
                let from = if rest.len() < 2 * S::LANES {
                    last[..rest.len()].copy_from_slice(rest);
                    &last
                } else {
                    rest
                };
                // SAFETY: `2 * LANES` floats, and a vector inside the line: `LANES` divides `ld`.
                unsafe { S::store(self.out.add(o * ld + step), S::load_pairs(from.as_ptr())) };
            }
        }
    }

    /// Outputs are columns: two rows make a step of all of them, and blocks of steps are transposed.
    ///
    /// # Safety
    /// As [`launch`].
    #[inline(always)]
    unsafe fn columns<S: Simd>(&self) {
        let ld = Products::Bf16.weight_stride(self.contraction);
        let n = self.outputs;
        // Steps by outputs.
        let mut block = [[0.0f32; 16]; 16];
        for first in (0..n).step_by(S::LANES) {
            let width = S::LANES.min(n - first);
            for step in (0..ld).step_by(S::LANES) {
                for (i, line) in block[..S::LANES].iter_mut().enumerate() {
                    let channel = 2 * (step + i);
                    // SAFETY: `width` outputs of existing channels, and a whole line.
                    unsafe {
                        let of = |channel: usize| {
                            let at = self.w.as_ptr().wrapping_add(channel * n + first);
                            match channel < self.contraction {
                                true if width == S::LANES => S::load(at),
                                true => S::load_head(at, width),
                                false => S::splat(0.0),
                            }
                        };
                        S::store(line.as_mut_ptr(), S::pair(of(channel), of(channel + 1)));
                    }
                }
                let from = block.each_ref().map(|line| line.as_ptr());
                for o in (0..width).step_by(4) {
                    let to = self.out.wrapping_add((first + o) * ld + step);
                    if width - o >= 4 {
                        // SAFETY: four outputs, a vector of steps each.
                        unsafe { S::transpose_rows(&from, o, to, ld) };
                        continue;
                    }
                    for i in 0..width - o {
                        for (s, line) in block[..S::LANES].iter().enumerate() {
                            // SAFETY: as above, for the outputs that are left.
                            unsafe { *to.add(i * ld + s) = line[o + i] };
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A matrix, and the weight of output `o` for `c`, or 0 beyond them.
    const K: usize = 37;
    const N: usize = 43;

    fn matrix() -> Vec<f32> {
        // Integers that bfloat16 holds.
        (0..K * N).map(|i| (i % 251) as f32 + 1.0).collect()
    }

    fn weight(transposed: bool, o: usize, c: usize) -> f32 {
        let (row, column) = if transposed { (o, c) } else { (c, o) };
        if row < K && column < N { matrix()[row * N + column] } else { 0.0 }
    }

    #[test]
    fn packs_both_ways_and_pads_with_zeros() {
        for transposed in [false, true] {
            let (contraction, outputs) = if transposed { (N, K) } else { (K, N) };
            let mut out = vec![f32::NAN; panel_len(Products::F32, contraction, outputs)];
            pack_panels(Isa::Portable, Products::F32, &matrix(), K, N, transposed, &mut out);
            for o in 0..outputs.next_multiple_of(PANEL) {
                for c in 0..contraction {
                    let expected = if o < outputs { weight(transposed, o, c) } else { 0.0 };
                    assert_eq!(out[(o / PANEL * contraction + c) * PANEL + o % PANEL], expected);
                }
            }
            for isa in Isa::available() {
                let mut out = vec![f32::NAN; panel_len(Products::Bf16, contraction, outputs)];
                pack_panels(isa, Products::Bf16, &matrix(), K, N, transposed, &mut out);
                let ld = Products::Bf16.weight_stride(contraction);
                for (i, lane) in out.iter().enumerate() {
                    let expected = [0, 1].map(|c| weight(transposed, i / ld, 2 * (i % ld) + c));
                    assert_eq!(halves(*lane), expected, "{isa}: lane {i}");
                }
            }
        }
    }

    /// The values of a lane.
    fn halves(lane: f32) -> [f32; 2] {
        let bits = lane.to_bits();
        [bits as u16, (bits >> 16) as u16].map(|half| half::bf16::from_bits(half).to_f32())
    }

    #[test]
    fn values_are_rounded_to_nearest_even() {
        for isa in Isa::available() {
            let mut out = vec![0.0; panel_len(Products::Bf16, 4, 1)];
            // 1 + 2^-8 lies between 1 and 1 + 2^-7: to the even one, 1; 1 + 3 * 2^-8 up, to 1 + 2^-6.
            let w = [1.0 + 1.0 / 256.0, 1.0 + 3.0 / 256.0, f32::NAN, f32::NEG_INFINITY];
            pack_panels(isa, Products::Bf16, &w, 4, 1, false, &mut out);
            assert_eq!(halves(out[0]), [1.0, 1.0 + 1.0 / 64.0]);
            let [nan, infinity] = halves(out[1]);
            assert!(nan.is_nan() && infinity == f32::NEG_INFINITY);
        }
    }
}
