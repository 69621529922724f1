//! Linear layers with weights of all kinds, biases and activations.

use super::builder::{Builder, Float, Value, scaled};
use raygrad_compiler::graph::Axis;

impl Builder {
    pub(super) fn layer(&mut self) -> Option<Value> {
        let x = self.float_where(|f| f.t.width() <= 70)?;
        let k = x.t.width();
        if self.rng.chance(0.15) {
            return self.computed_weights(&x);
        }
        let out = [1, 2, 3, 4, 5, 8, 16, 17, 32, 64][self.rng.below(10)];
        // A network for every row of some axes, the innermost included; usually one for all.
        let own: Vec<Axis> = x.t.axes().iter().filter(|_| self.rng.chance(0.5)).cloned().collect();
        let mut axes = if self.rng.chance(0.7) { vec![] } else { own };
        if self.rng.chance(0.05) {
            axes.push(self.axes[self.rng.below(self.axes.len())].clone());
        }
        let elements: usize = axes.iter().map(Axis::size).product();
        if elements * k * out > 20_000 {
            return None;
        }
        let exact = x.unit.is_some() && self.rng.chance(0.7);
        let transposed = self.rng.chance(0.25);
        let shape = if transposed { (out, k) } else { (k, out) };
        let name = format!("{}.weight", self.next);
        let w = self.input(&name, &axes, shape, exact);
        let y = if transposed { x.t.linear_transposed(&w.t) } else { x.t.linear(&w.t) };
        let unit = x.unit.zip(w.unit).map(|u| u.0 * u.1);
        let unit = unit.filter(|u| x.bound * k as f64 / u < 262_144.0);
        let y = Float { t: y, bound: x.bound * k as f64, unit };
        let y = if self.rng.chance(0.6) { self.with_bias(y) } else { y };
        let (t, bound, unit) = match (self.rng.below(6), y.unit) {
            (0..3, Some(unit)) => ((&y.t + unit / 2.0).relu(), y.bound + unit, Some(unit / 2.0)),
            (3, _) => (scaled(y).t.tanh(), 1.0, None),
            (4, _) => {
                let y = scaled(y);
                (y.t.softplus(1.0), y.bound + 0.7, None)
            }
            _ => (y.t, y.bound, y.unit),
        };
        self.result(t, bound, unit)
    }

    /// A bias that moves exact values off zero, so that no activation meets its kink.
    fn with_bias(&mut self, y: Float) -> Float {
        let name = format!("{}.bias", self.next);
        let mut b = self.input(&name, &[], y.t.width(), y.unit.is_some());
        if self.rng.chance(0.5) {
            b.t = -b.t;
        }
        let t = if self.rng.chance(0.5) { &y.t + &b.t } else { &b.t + &y.t };
        Float { t, bound: y.bound + 1.0, unit: y.unit.zip(b.unit).map(|u| u.0.min(u.1)) }
    }

    /// Weights that the graph computes.
    fn computed_weights(&mut self, x: &Float) -> Option<Value> {
        let k = x.t.width();
        let w = self.float_where(|f| f.t.width().is_multiple_of(k) && f.t.width() / k <= 40)?;
        let out = w.t.width() / k;
        let y = if self.rng.chance(0.7) {
            x.t.linear(&w.t.reshape((k, out)))
        } else {
            x.t.linear_transposed(&w.t.reshape((out, k)))
        };
        let unit = x.unit.zip(w.unit).map(|u| u.0 * u.1);
        let bound = x.bound * w.bound * k as f64;
        self.result(y, bound, unit.filter(|u| bound / u < 262_144.0))
    }
}
