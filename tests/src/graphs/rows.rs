//! Reductions and scans along axes.

use super::builder::{Builder, Float, Value, scaled};
use raygrad_compiler::graph::{Axes, Axis, Channels, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::Array;

impl Builder {
    /// Some of `axes`, possibly none or all.
    pub(super) fn subset(&mut self, axes: &Axes) -> Axes {
        let share = [0.3, 0.5, 0.8][self.rng.below(3)];
        Axes::new(axes.iter().filter(|_| self.rng.chance(share)).cloned())
    }

    pub(super) fn reduction(&mut self) -> Option<Value> {
        let x = self.float_where(|f| !f.t.axes().is_empty())?;
        let mut over = self.subset(x.t.axes());
        if over.is_empty() {
            over = Axes::new(x.t.axes().last().cloned());
        }
        let n = over.elements() as f64;
        match self.rng.below(5) {
            0..3 => {
                let bound = x.bound * n;
                self.result(x.t.sum_over(&over), bound, x.unit.filter(|u| bound / u < 262_144.0))
            }
            3 => {
                let list: Vec<Axis> = over.iter().cloned().collect();
                self.result(x.t.mean(&list.iter().collect::<Vec<_>>()), x.bound, None)
            }
            _ => self.maximum(&x.t, x.bound, &over),
        }
    }

    /// A maximum over axes: distinct numbers along them keep the largest apart from the others.
    fn maximum(&mut self, x: &Tensor, bound: f64, over: &Axes) -> Option<Value> {
        let n = over.elements();
        let name = format!("{}.ramp", self.next);
        let mut ramp: Vec<f64> = (0..n).map(|i| i as f64 / n as f64).collect();
        for i in (1..n).rev() {
            ramp.swap(i, self.rng.below(i + 1));
        }
        let shape = raygrad_compiler::Shape::of(over.clone(), 1, raygrad_compiler::scalar::DType::F32);
        self.bindings.insert(name.clone(), Array::floats(&shape, ramp));
        let ramp = Tensor::data(name, shape);
        let list: Vec<Axis> = over.iter().cloned().collect();
        let list: Vec<&Axis> = list.iter().collect();
        let t = (x * (0.25 / n as f64 / bound.max(1e-3)) + ramp).max_over(&list);
        self.result(t, 1.5, None)
    }

    /// A layer, a sum or maximum of it along its innermost axis, and elements along that axis that use both.
    pub(super) fn line(&mut self) -> Option<Value> {
        let x = match if self.rng.chance(0.7) { self.layer() } else { None } {
            Some(Value::Float(x)) if !x.t.axes().is_empty() => x,
            _ => self.float_where(|f| !f.t.axes().is_empty())?,
        };
        let inner = x.t.axes().last()?.clone();
        let bound = x.bound * inner.size() as f64;
        let total = match self.rng.below(5) {
            0..3 => Float { t: x.t.sum(&[&inner]), bound, unit: x.unit.filter(|u| bound / u < 262_144.0) },
            3 => Float { t: x.t.mean(&[&inner]), bound: x.bound, unit: None },
            _ => match self.maximum(&x.t, x.bound, &Axes::new([inner]))? {
                Value::Float(largest) => largest,
                Value::Integer(_) => return None,
            },
        };
        let mut total = scaled(total);
        match self.rng.below(6) {
            0 => total = Float { t: total.t.tanh(), bound: 1.0, unit: None },
            1 => total = Float { t: total.t.sum_channels() * (1.0 / total.t.width() as f64), unit: None, ..total },
            2..4 => {
                let axes = total.t.axes().clone();
                let other = self.matching(&total.t).filter(|f| f.t.axes().is_subset(&axes));
                if let Some(other) = other {
                    let unit = total.unit.zip(other.unit).map(|u| u.0 * u.1);
                    total = scaled(Float { t: &total.t * other.t, bound: total.bound * other.bound, unit });
                }
            }
            _ => {}
        }
        let (own, one) = (x.t.channels(), Channels::Vector(1));
        let fits = own == total.t.channels() || [own, total.t.channels()].contains(&one);
        let back = if fits { x.t } else { x.t.mean_channels() };
        match self.rng.below(3) {
            0 => self.result(back.tanh() * &total.t, total.bound, None),
            1 => self.result(back.sin() + &total.t, total.bound + 1.0, None),
            _ => self.result(concat([&back, &total.t]), x.bound.max(total.bound), None),
        }
    }

    pub(super) fn scan(&mut self) -> Option<Value> {
        let x = self.float_where(|f| !f.t.axes().is_empty())?;
        let axes: Vec<Axis> = x.t.axes().iter().cloned().collect();
        let axis = &axes[self.rng.below(axes.len())];
        let (size, bound) = (axis.size() as f64, x.bound * axis.size() as f64);
        let unit = x.unit.filter(|u| bound / u < 262_144.0);
        match self.rng.below(4) {
            0 => self.result(x.t.cumsum(axis), bound, unit),
            1 => self.result(x.t.reverse_cumsum(axis), bound, unit),
            _ => {
                let far = [1.0, 2.0, 3.0, size / 2.0, size + 1.0][self.rng.below(5)].floor() as i64;
                let by = if self.rng.chance(0.5) { far } else { -far };
                self.result(x.t.shift(axis, by), x.bound, x.unit)
            }
        }
    }
}
