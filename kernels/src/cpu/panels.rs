//! Weight panels: the order in which the matrix kernel reads a weight matrix.
//!
//! A panel holds [`PANEL`] outputs, `[output / 8][step][8]`, so that each step of the contraction reads eight
//! neighbouring lanes: of one weight each, or of the two of a pair. The last panel is padded with zeros.
use super::Products;

/// Outputs of a panel.
pub const PANEL: usize = 8;

/// Lanes that `outputs` packed outputs take, with `steps` steps of the contraction ([`Products::lanes`]).
pub fn panel_len(steps: usize, outputs: usize) -> usize {
    outputs.div_ceil(PANEL) * PANEL * steps
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
    let steps = products.lanes(contraction);
    let out = &mut out[..panel_len(steps, outputs)];
    if out.is_empty() {
        return;
    }
    let values = products.values();
    for (panel, first) in out.chunks_exact_mut(PANEL * steps).zip((0..outputs).step_by(PANEL)) {
        let count = PANEL.min(outputs - first);
        if count < PANEL {
            panel.fill(0.0);
        }
        if transposed {
            for i in 0..count {
                let row = &w[(first + i) * n..][..n];
                for (slot, pair) in panel[i..].iter_mut().step_by(PANEL).zip(row.chunks(values)) {
                    *slot = products.lane(pair[0], pair.get(1).copied().unwrap_or(0.0));
                }
            }
        } else {
            for (slots, rows) in panel.chunks_exact_mut(PANEL).zip(w.chunks(n * values)) {
                if products == Products::F32 {
                    slots[..count].copy_from_slice(&rows[first..][..count]);
                    continue;
                }
                let (row, next) = rows.split_at(n);
                for (i, slot) in slots[..count].iter_mut().enumerate() {
                    *slot = products.lane(row[first + i], next.get(first + i).copied().unwrap_or(0.0));
                }
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
        for (transposed, products) in [false, true].into_iter().flat_map(|t| [(t, Products::F32), (t, Products::Bf16)])
        {
            let (contraction, outputs) = if transposed { (n, k) } else { (k, n) };
            let weight = |o: usize, c: usize| {
                let (row, column) = if transposed { (o, c) } else { (c, o) };
                if o < outputs && c < contraction { w[row * n + column] } else { 0.0 }
            };
            let steps = products.lanes(contraction);
            let mut out = vec![f32::NAN; panel_len(steps, outputs)];
            pack_panels(products, &w, k, n, transposed, &mut out);
            for o in 0..outputs.next_multiple_of(PANEL) {
                for step in 0..steps {
                    let first = step * products.values();
                    let expected = products.lane(weight(o, first), weight(o, first + 1));
                    assert_eq!(out[(o / PANEL * steps + step) * PANEL + o % PANEL].to_bits(), expected.to_bits());
                }
            }
        }
    }
}
