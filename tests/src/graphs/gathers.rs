//! Gathers and scatters.

use super::builder::{Builder, Value};
use raygrad_compiler::graph::{Axis, Channels, Shape, Tensor};
use raygrad_compiler::reference::Array;
use raygrad_compiler::scalar::DType;

impl Builder {
    pub(super) fn gather(&mut self) -> Option<Value> {
        if self.rng.chance(0.35) {
            return self.scattered();
        }
        let x = self.float_where(|f| !f.t.axes().is_empty())?;
        let axes: Vec<Axis> = x.t.axes().iter().cloned().collect();
        let axis = axes[self.rng.below(axes.len())].clone();
        let index = self.index(&axis)?;
        self.result(x.t.take(&index, &axis), x.bound, x.unit)
    }

    fn scattered(&mut self) -> Option<Value> {
        let slot = self.slot.clone();
        let x = self.float_where(|f| !f.t.axes().contains(&slot) && !f.t.axes().is_empty())?;
        let index = self.index(&slot)?;
        let axes = x.t.axes().union(index.axes());
        let keep = self.subset(&axes);
        let bound = x.bound * axes.minus(&keep).elements() as f64;
        self.result(x.t.scatter(&index, &slot, &keep), bound, x.unit.filter(|u| bound / u < 262_144.0))
    }

    /// One integer channel without the axis it points along; some point past the end.
    fn index(&mut self, axis: &Axis) -> Option<Tensor> {
        let fits = |t: &Tensor| t.channels() == Channels::Vector(1) && !t.axes().contains(axis);
        let known = if self.rng.chance(0.6) { self.integer_where(fits) } else { None };
        if let Some(known) = known {
            return Some(known);
        }
        let own: Vec<Axis> = self.axes.iter().filter(|a| *a != axis).cloned().collect();
        let axes: Vec<&Axis> = own.iter().filter(|_| self.rng.chance(0.7)).collect();
        let shape = Shape::new(&axes, 1).with_dtype(DType::U32);
        let name = format!("{}.index", self.next);
        let most = axis.size() + axis.size() / 4 + 1;
        let values = (0..shape.lanes()).map(|_| self.rng.below(most) as u32).collect();
        self.bindings.insert(name.clone(), Array::integers(&shape, values));
        Some(Tensor::data(name, shape))
    }
}
