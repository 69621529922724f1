//! Reductions and scans along axes.

use super::builder::{Builder, Value};
use raygrad_compiler::graph::{Axes, Axis, Tensor};
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
