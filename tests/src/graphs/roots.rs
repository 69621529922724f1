//! What a random graph computes: a loss, values, gradients of first and second order, and updates.

use super::builder::{Builder, Float, Value};
use crate::total;
use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::reference::Array;
use raygrad_compiler::scalar::DType;
use std::collections::BTreeSet;

/// Terms of the loss are dropped by positions from here on.
pub(super) const FIRST_TERM: usize = 1000;
/// Most parameters that gradients are taken of.
const MAX_WANTED: usize = 6;

impl Builder {
    pub(super) fn roots(&mut self, dropped: &BTreeSet<usize>) -> Step {
        let mut step = Step::default();
        let loss = self.loss(dropped);
        let values: Vec<(usize, Tensor)> = (self.values.iter().enumerate())
            .filter_map(|(i, v)| v.as_ref().map(|v| (i, tensor(v))))
            .filter(|(_, t)| t.input_name().is_none() || t.dtype() == DType::F32)
            .collect();
        for _ in 0..self.rng.below(4) {
            if values.is_empty() {
                break;
            }
            let (at, t) = values[self.rng.below(values.len())].clone();
            let name = format!("value {at}");
            if step.outputs.iter().all(|(n, _)| *n != name) {
                step.outputs.push((name, t));
            }
        }
        let wanted: Vec<Tensor> = self.parameters.iter().take(MAX_WANTED).cloned().collect();
        let wanted: Vec<&Tensor> = wanted.iter().collect();
        let first = grad(&loss, &wanted);
        for (p, g) in wanted.iter().zip(&first) {
            step.outputs.push((format!("grad {}", p.input_name().unwrap_or_default()), g.clone()));
        }
        if self.rng.chance(0.2) {
            let squares = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b);
            let second = squares.map(|s| grad(&s, &wanted)).unwrap_or_default();
            for (p, g) in wanted.iter().zip(second) {
                step.outputs.push((format!("second {}", p.input_name().unwrap_or_default()), g));
            }
        }
        step.outputs.push(("loss".into(), loss.clone()));
        if self.rng.chance(0.7) {
            self.updates(&mut step, &wanted, &first);
        }
        let outputs = step.outputs.len();
        let keep = |at: usize| !dropped.contains(&at);
        step.outputs = step.outputs.into_iter().enumerate().filter(|(i, _)| keep(*i)).map(|(_, o)| o).collect();
        let updates = step.updates.into_iter().enumerate().filter(|(i, _)| keep(outputs + *i));
        step.updates = updates.map(|(_, u)| u).collect();
        step
    }

    /// Some values against random upstream factors.
    fn loss(&mut self, dropped: &BTreeSet<usize>) -> Tensor {
        let mut loss = Tensor::scalar(0.0);
        for part in 0..1 + self.rng.below(4) {
            let Some(Float { t, .. }) = self.float() else { continue };
            let share = (t.shape().lanes() as f64).sqrt().recip();
            let name = format!("upstream {part}");
            let shape = Shape::of(t.axes().clone(), t.channels(), DType::F32);
            let up = Tensor::data(name.clone(), shape.clone());
            self.bindings.insert(name, self.rng.array(&shape, -1.0, 1.0));
            let term = match self.rng.below(3) {
                0 => total(&(&t * &t)),
                1 => total(&(&t * &up)),
                _ => total(&(&t * &up).sin()),
            };
            if !dropped.contains(&(FIRST_TERM + part)) {
                loss = loss + term * share;
            }
        }
        loss
    }

    fn state(&mut self, name: &str, shape: &Shape) -> Tensor {
        let values = self.rng.array(shape, -1.0, 1.0);
        self.bindings.insert(name.into(), values);
        Tensor::input(name, Role::State, shape.clone())
    }

    /// New values of free inputs, all within -1..1, some of them from each other.
    fn updates(&mut self, step: &mut Step, wanted: &[&Tensor], first: &[Tensor]) {
        let free = self.free.clone();
        for p in &free {
            let name = p.input_name().unwrap_or_default().to_string();
            if step.updates.iter().any(|(t, _)| t.id() == p.id()) {
                continue;
            }
            let g = wanted.iter().position(|w| w.id() == p.id()).map(|i| first[i].clone());
            let q = free.iter().find(|q| {
                q.id() != p.id() && q.width() == p.width() && q.axes() == p.axes() && q.channels() == p.channels()
            });
            let used = |step: &Step, q: &Tensor| step.updates.iter().any(|(t, _)| t.id() == q.id());
            match (self.rng.below(13), g) {
                (0..3, Some(g)) => step.updates.push((p.clone(), (p * 0.9 - g).tanh())),
                (3, Some(g)) => {
                    let m = self.state(&format!("{name}.m"), p.shape());
                    let next = &m * 0.9 + g.tanh() * 0.1;
                    step.updates.push((p.clone(), (p - &next * 0.1).sin()));
                    if self.rng.chance(0.5) {
                        step.outputs.push((format!("{name}.m next"), next.clone()));
                    }
                    step.updates.push((m, next));
                }
                (4, _) => {
                    let other = match q.filter(|q| !used(step, q)) {
                        Some(q) => q.clone(),
                        None => self.state(&format!("{name}.other"), p.shape()),
                    };
                    step.updates.extend([(p.clone(), other.clone()), (other, p.clone())]);
                }
                (5, _) => {
                    if let Some(q) = q.filter(|q| !used(step, q)) {
                        step.updates.push((p.clone(), (p + q).tanh()));
                        step.updates.push((q.clone(), (q - p).sin()));
                    }
                }
                (6, _) => {
                    let (axes, width) = (p.axes().clone(), p.width());
                    let fits = |f: &Float| f.t.axes().is_subset(&axes) && f.t.width() == width;
                    if let Some(v) = self.float_where(fits) {
                        step.updates.push((p.clone(), v.t * (1.0 / v.bound.max(1.0))));
                    }
                }
                (7, _) => {
                    let n = p.width();
                    let by = self.rng.below(n);
                    let rotated: Vec<usize> = (0..n).map(|c| (c + by) % n).collect();
                    step.updates.push((p.clone(), p.pick_as(&rotated, p.channels())));
                }
                (8, _) => self.update_along(step, p),
                (9, _) => {
                    // The lanes of another input, in another arrangement.
                    let other = self.state(&format!("{name}.other"), &p.shape().clone().with_channels(p.width()));
                    step.updates.push((p.clone(), other.reshape((p.width(), 1))));
                    step.updates.push((other, p.reshape((1, p.width()))));
                }
                (10, _) => step.outputs.push((format!("{name} itself"), p.clone())),
                (11, _) if self.rng.chance(0.5) => {
                    let count = Tensor::input("count", Role::State, Shape::new(&[], 1).with_dtype(DType::U32));
                    if !step.updates.iter().any(|(t, _)| t.input_name() == Some("count")) {
                        self.bindings.insert("count".into(), Array::integers(count.shape(), vec![3]));
                        step.updates.push((count.clone(), count.wrapping_add(&Tensor::integers(&[1]))));
                        step.outputs.push(("count".into(), count));
                    }
                }
                _ => {}
            }
        }
    }

    /// An update that reads other elements of the input it replaces.
    fn update_along(&mut self, step: &mut Step, p: &Tensor) {
        let axes: Vec<Axis> = p.axes().iter().cloned().collect();
        if axes.is_empty() {
            return;
        }
        let axis = &axes[self.rng.below(axes.len())];
        let share = 1.0 / axis.size() as f64;
        let value = match self.rng.below(4) {
            0 => p.shift(axis, 1),
            1 => p.reverse_cumsum(axis) * share,
            2 => p.mean(&[axis]),
            _ => p - p.sum_over(&Axes::new([axis.clone()])) * (share * 0.5),
        };
        step.updates.push((p.clone(), value));
    }
}

fn tensor(v: &Value) -> Tensor {
    match v {
        Value::Float(f) => f.t.clone(),
        Value::Integer(t) => t.clone(),
    }
}
