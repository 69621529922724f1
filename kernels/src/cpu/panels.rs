//! Weight panels: the order in which the matrix kernel reads a weight matrix.
//!
//! A panel holds [`PANEL`] outputs, `[output / 8][contraction][8]`, so that each step of the contraction reads eight
//! neighbouring floats. The last panel is padded with zeros.

/// Outputs of a panel.
pub const PANEL: usize = 8;

/// Floats that `outputs` packed outputs take.
pub fn panel_len(contraction: usize, outputs: usize) -> usize {
    outputs.div_ceil(PANEL) * PANEL * contraction
}

/// Packs the row-major `[k][n]` matrix `w`.
///
/// Not `transposed`: outputs are columns, for `y[n] = sum_k w[k][n] x[k]`. `transposed`: outputs are rows, for
/// `y[k] = sum_n w[k][n] x[n]`.
///
/// # Panics
/// If `w` or `out` (of [`panel_len`] floats) is too short.
pub fn pack_panels(w: &[f32], k: usize, n: usize, transposed: bool, out: &mut [f32]) {
    let w = &w[..k * n];
    let (contraction, outputs) = if transposed { (n, k) } else { (k, n) };
    let out = &mut out[..panel_len(contraction, outputs)];
    if out.is_empty() {
        return;
    }
    for (panel, first) in out.chunks_exact_mut(PANEL * contraction).zip((0..outputs).step_by(PANEL)) {
        let count = PANEL.min(outputs - first);
        if count < PANEL {
            panel.fill(0.0);
        }
        if transposed {
            for i in 0..count {
                let row = &w[(first + i) * n..][..n];
                for (slot, &value) in panel[i..].iter_mut().step_by(PANEL).zip(row) {
                    *slot = value;
                }
            }
        } else {
            for (slots, row) in panel.chunks_exact_mut(PANEL).zip(w.chunks_exact(n)) {
                slots[..count].copy_from_slice(&row[first..][..count]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packs_both_ways_and_pads_with_zeros() {
        let (k, n) = (11, 9);
        let w: Vec<f32> = (0..k * n).map(|i| i as f32 + 1.0).collect();
        for transposed in [false, true] {
            let (contraction, outputs) = if transposed { (n, k) } else { (k, n) };
            let mut out = vec![f32::NAN; panel_len(contraction, outputs)];
            pack_panels(&w, k, n, transposed, &mut out);
            for o in 0..outputs.next_multiple_of(PANEL) {
                for c in 0..contraction {
                    let packed = out[(o / PANEL * contraction + c) * PANEL + o % PANEL];
                    let (row, column) = if transposed { (o, c) } else { (c, o) };
                    assert_eq!(packed, if o < outputs { w[row * n + column] } else { 0.0 });
                }
            }
        }
    }
}
