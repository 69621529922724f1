//! Channels: concatenation, picks, sums, maxima.

use super::builder::{Builder, Value, scaled};
use raygrad_compiler::graph::{Channels, Tensor};
use raygrad_compiler::ops::pick::concat;

impl Builder {
    pub(super) fn channels(&mut self) -> Option<Value> {
        let x = self.float()?;
        let n = x.t.width();
        match self.rng.below(10) {
            0..3 => {
                let mut parts = vec![x];
                for _ in 0..1 + self.rng.below(2) {
                    parts.push(self.float()?);
                }
                let t = concat(parts.iter().map(|p| &p.t));
                if t.width() > 600 {
                    return None;
                }
                let bound = parts.iter().fold(0.0f64, |b, p| b.max(p.bound));
                let unit = parts.iter().map(|p| p.unit).try_fold(1.0f64, |a, u| u.map(|u| a.min(u)));
                self.result(t, bound, unit)
            }
            3 => {
                let channels: Vec<usize> = (0..1 + self.rng.below(6)).map(|_| self.rng.below(n)).collect();
                self.result(x.t.pick(&channels), x.bound, x.unit)
            }
            4 => {
                // Rotated: pieces of a wide vector, neighbours of a narrow one.
                let by = self.rng.below(n);
                let channels: Vec<usize> = (0..n).map(|c| (c + by) % n).collect();
                self.result(x.t.pick(&channels), x.bound, x.unit)
            }
            5 => {
                let start = self.rng.below(n);
                let end = start + 1 + self.rng.below(n - start);
                self.result(x.t.slice(start..end), x.bound, x.unit)
            }
            6 => match x.t.channels() {
                Channels::Matrix(..) => self.result(x.t.transpose(), x.bound, x.unit),
                Channels::Vector(_) => self.result(x.t.mean_channels(), x.bound, None),
            },
            7 => self.result(x.t.sum_channels(), x.bound * n as f64, x.unit),
            8 => {
                let groups = (0..1 + self.rng.below(4)).map(|_| {
                    let len = self.rng.below(4);
                    (0..len).map(|_| self.rng.below(n) as u32).collect::<Vec<u32>>()
                });
                let groups: Vec<Vec<u32>> = groups.collect();
                let most = groups.iter().map(Vec::len).max().unwrap_or(0).max(1);
                self.result(x.t.channel_groups(groups), x.bound * most as f64, x.unit)
            }
            _ => {
                // Distinct constants keep the largest channel apart from the others.
                if n > 40 {
                    return None;
                }
                let ramp: Vec<f64> = (0..n).map(|c| (c * 7 % n) as f64 / n as f64 * 2.0).collect();
                let ramp = Tensor::constant(&ramp).reshape(x.t.channels());
                let t = (&x.t * (0.5 / n as f64 / x.bound.max(1e-3)) + ramp).max_channels();
                self.result(t, 3.0, None)
            }
        }
    }

    /// Eigenvalues and eigenvectors of a matrix whose eigenvalues are well apart.
    pub(super) fn eigen(&mut self) -> Option<Value> {
        let x = self.float_where(|f| f.t.axes().elements() <= 600)?;
        let n = 2 + self.rng.below(3);
        let channels: Vec<usize> = (0..n * n).map(|_| self.rng.below(x.t.width())).collect();
        let spread: Vec<f64> = (0..n * n).map(|i| if i / n == i % n { (i / n) as f64 * 1.5 } else { 0.0 }).collect();
        let small = x.t.pick_as(&channels, (n, n)) * (0.2 / x.bound.max(1e-3));
        let (values, vectors) = (small + Tensor::constant_matrix(n, n, &spread)).sym_eig();
        match self.rng.below(3) {
            0 => self.result(values, 6.0, None),
            1 => self.result(vectors, 1.0, None),
            _ => self.result(concat([&values, &vectors]), 6.0, None),
        }
    }

    /// Sums of outer products.
    pub(super) fn product(&mut self) -> Option<Value> {
        let x = self.float_where(|f| f.t.width() <= 40)?;
        let y = self.float_where(|f| f.t.width() <= 40)?;
        let axes = x.t.axes().union(y.t.axes());
        let keep = self.subset(&axes);
        if keep.elements() * x.t.width() * y.t.width() > 20_000 {
            return None;
        }
        let rows = axes.minus(&keep).elements() as f64;
        let t = x.t.outer(&y.t, &keep);
        let unit = x.unit.zip(y.unit).map(|u| u.0 * u.1);
        let unit = unit.filter(|u| x.bound * y.bound * rows / u < 262_144.0);
        let float = scaled(super::builder::Float { t, bound: x.bound * y.bound * rows, unit });
        let t = if self.rng.chance(0.5) { float.t.reshape(float.t.width()) } else { float.t };
        self.result(t, float.bound, float.unit)
    }
}
