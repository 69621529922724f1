//! Weight panels: the order in which the matrix kernels read a weight matrix.
//!
//! Of single weights a panel holds [`PANEL`] outputs, `[output / 8][step][8]`, so that each step of the contraction reads eight
//! neighbouring lanes. The last panel is padded with zeros. Pairs lie along the contraction, `[output][step]`, as tiles want
//! them ([`super::amx`]), with zeros up to a multiple of 16 steps.
use super::Products;

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
/// If `w` or `out` (of [`panel_len`] lanes) is too short.
pub fn pack_panels(products: Products, w: &[f32], k: usize, n: usize, transposed: bool, out: &mut [f32]) {
    let w = &w[..k * n];
    let (contraction, outputs) = if transposed { (n, k) } else { (k, n) };
    let out = &mut out[..panel_len(products, contraction, outputs)];
    if w.is_empty() {
        return;
    }
    match (products, transposed) {
        (Products::F32, _) => {
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
        (Products::Bf16, true) => {
            for (line, row) in out.chunks_exact_mut(products.weight_stride(contraction)).zip(w.chunks_exact(n)) {
                line.fill(0.0);
                for (slot, pair) in line.iter_mut().zip(row.chunks(2)) {
                    *slot = pair_of(pair[0], pair.get(1).copied().unwrap_or(0.0));
                }
            }
        }
        (Products::Bf16, false) => {
            let ld = products.weight_stride(contraction);
            out.fill(0.0);
            for (step, rows) in w.chunks(2 * n).enumerate() {
                let (row, next) = rows.split_at(n);
                for (o, first) in row.iter().enumerate() {
                    out[o * ld + step] = pair_of(*first, next.get(o).copied().unwrap_or(0.0));
                }
            }
        }
    }
}

/// A lane of two neighbours along the sum, rounded to bfloat16.
fn pair_of(first: f32, second: f32) -> f32 {
    let bits = |x: f32| u32::from(half::bf16::from_f32(x).to_bits());
    f32::from_bits(bits(first) | bits(second) << 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A matrix, and the weight of output `o` for `c`, or 0 beyond them.
    const K: usize = 11;
    const N: usize = 9;

    fn matrix() -> Vec<f32> {
        (0..K * N).map(|i| i as f32 + 1.0).collect()
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
            pack_panels(Products::F32, &matrix(), K, N, transposed, &mut out);
            for o in 0..outputs.next_multiple_of(PANEL) {
                for c in 0..contraction {
                    let expected = if o < outputs { weight(transposed, o, c) } else { 0.0 };
                    assert_eq!(out[(o / PANEL * contraction + c) * PANEL + o % PANEL], expected);
                }
            }
            let mut out = vec![f32::NAN; panel_len(Products::Bf16, contraction, outputs)];
            pack_panels(Products::Bf16, &matrix(), K, N, transposed, &mut out);
            let halves = |x: f32| [x.to_bits() as u16, (x.to_bits() >> 16) as u16].map(|h| half::bf16::from_bits(h).to_f32());
            for (i, lane) in out.iter().enumerate() {
                let (o, step) = (i / 16, i % 16);
                assert_eq!(halves(*lane), [0, 1].map(|c| weight(transposed, o, 2 * step + c)));
            }
        }
    }

    #[test]
    fn a_lane_holds_its_neighbours_rounded_to_nearest_even() {
        let halves = |bits: u32| (bits as u16, (bits >> 16) as u16);
        // 1 + 2^-8 lies between 1 and 1 + 2^-7: to the even one, 1; 1 + 3 * 2^-8 up, to 1 + 2^-6.
        let lane = pair_of(1.0 + 1.0 / 256.0, 1.0 + 3.0 / 256.0).to_bits();
        assert_eq!(halves(lane), (0x3f80, 0x3f82));
        let (first, second) = halves(pair_of(f32::NAN, f32::NEG_INFINITY).to_bits());
        assert!(half::bf16::from_bits(first).is_nan());
        assert_eq!(half::bf16::from_bits(second), half::bf16::NEG_INFINITY);
    }
}
