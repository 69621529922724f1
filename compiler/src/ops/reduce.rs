//! Sum and maximum over axes. The maximum is NaN if a value is.

use super::{Form, Op, Reduction, Sample, SampleInput, expect_dtype};
use crate::cost::Work;
use crate::graph::{Axes, Axis, Misfit, Shape, Tensor, function};
use crate::reference::Array;
use crate::scalar::DType;

/// Positions that single precision can count.
const MOST_POSITIONS: usize = 1 << 24;

/// Reduction over `over`.
#[derive(Clone, Debug)]
pub struct Reduce {
    pub kind: Reduction,
    pub over: Axes,
}

impl Op for Reduce {
    fn name(&self) -> &'static str {
        match self.kind {
            Reduction::Sum => "sum",
            Reduction::Max => "max_over",
        }
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        if !self.over.is_subset(&inputs[0].axes) {
            return Err(Misfit::new(
                format!("{} has no axes {} to reduce", inputs[0], self.over),
                format!("axes here: {}", inputs[0].axes),
            ));
        }
        Ok(inputs[0].clone().with_axes(inputs[0].axes.minus(&self.over)))
    }
    fn form(&self) -> Form {
        Form::Reduce(self.kind)
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let x = inputs[0];
        let n = out.channels.count();
        let mut y = Array::zeros(out);
        if self.kind == Reduction::Max {
            y.f_mut().fill(f64::NEG_INFINITY);
        }
        for e in 0..x.shape.axes.elements() {
            let at = y.element_of(&x.shape, e);
            for c in 0..n {
                let v = x.at(e, c).f();
                let slot = &mut y.f_mut()[at * n + c];
                *slot = match self.kind {
                    Reduction::Sum => *slot + v,
                    Reduction::Max => larger(*slot, v),
                };
            }
        }
        y
    }
    fn vjp(&self, inputs: &[Tensor], output: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let x = &inputs[0];
        let grad = match self.kind {
            // Broadcasting back is implicit, but the rows must carry the axes that were summed.
            Reduction::Sum => g.broadcast_to(x.axes()),
            Reduction::Max => {
                let hit = x.equal(output).to_f32();
                // At least one: NaN equals nothing.
                let ties = hit.sum_over(&self.over).max(&Tensor::scalar(1.0));
                hit * (g / ties)
            }
        };
        vec![Some(grad)]
    }
    fn work(&self, _: &[Shape], out: &Shape) -> Work {
        Work::others(out.channels.count() as u64)
    }
}

/// The larger of two numbers, NaN if either is.
pub(crate) fn larger(a: f64, b: f64) -> f64 {
    if a > b || a.is_nan() { a } else { b }
}

/// The same values, NaN and what is less than all finite numbers being the least of those.
#[track_caller]
pub(crate) fn without_nan(x: &Tensor) -> Tensor {
    let least = Tensor::scalar(f64::from(f32::MIN));
    x.max(&least).equal(x).select(x, &least)
}

impl Tensor {
    /// Sum over the given axes.
    #[track_caller]
    pub fn sum(&self, over: &[&Axis]) -> Tensor {
        self.sum_over(&Axes::new(over.iter().map(|a| (*a).clone())))
    }
    #[track_caller]
    pub fn sum_over(&self, over: &Axes) -> Tensor {
        if over.is_empty() {
            return self.clone();
        }
        Tensor::record(Reduce { kind: Reduction::Sum, over: over.clone() }, &[self])
    }
    /// Mean over the given axes.
    #[track_caller]
    pub fn mean(&self, over: &[&Axis]) -> Tensor {
        let _called = function("mean");
        let over = Axes::new(over.iter().map(|a| (*a).clone()));
        self.sum_over(&over) * (1.0 / over.elements() as f64)
    }
    /// Mean over all axes and channels.
    #[track_caller]
    pub fn mean_all(&self) -> Tensor {
        let _called = function("mean_all");
        let n = self.shape().lanes();
        self.sum_channels().sum_over(self.axes()) * (1.0 / n as f64)
    }
    /// Maximum over the given axes. Its gradient is shared equally between ties.
    #[track_caller]
    pub fn max_over(&self, over: &[&Axis]) -> Tensor {
        let over = Axes::new(over.iter().map(|a| (*a).clone()));
        Tensor::record(Reduce { kind: Reduction::Max, over }, &[self])
    }
    /// Minimum over the given axes, likewise.
    #[track_caller]
    pub fn min_over(&self, over: &[&Axis]) -> Tensor {
        let _called = function("min_over");
        -(-self).max_over(over)
    }
    /// The position along `axis` of the largest value as `u32`, of equal ones the first; for every channel. NaN is larger than
    /// nothing.
    #[track_caller]
    pub fn argmax_over(&self, axis: &Axis) -> Tensor {
        let called = function("argmax_over");
        if axis.size() > MOST_POSITIONS {
            let problem = format!("`{axis}` has more than {MOST_POSITIONS} elements");
            return called.misfit(&[self], problem, "cut it into shorter ones");
        }
        let number = without_nan(self);
        let largest = number.equal(&number.max_over(&[axis]));
        let position = largest.select(&Tensor::index(axis).to_f32(), &Tensor::scalar(MOST_POSITIONS as f64));
        position.min_over(&[axis]).to_u32()
    }
    /// The position of the smallest value, likewise.
    #[track_caller]
    pub fn argmin_over(&self, axis: &Axis) -> Tensor {
        let _called = function("argmin_over");
        (-self).argmax_over(axis)
    }
    /// The same values with all of `axes`: repeated along those this tensor lacks.
    #[track_caller]
    pub fn broadcast_to(&self, axes: &Axes) -> Tensor {
        if axes.is_subset(self.axes()) { self.clone() } else { Tensor::record(Broadcast(axes.clone()), &[self]) }
    }
}

/// The operand, with more axes. Recorded only by rules: elementwise ops broadcast by themselves.
#[derive(Clone, Debug)]
pub struct Broadcast(pub Axes);

impl Op for Broadcast {
    fn name(&self) -> &'static str {
        "broadcast"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        Ok(inputs[0].clone().with_axes(inputs[0].axes.union(&self.0)))
    }
    fn form(&self) -> Form {
        Form::Identity
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        Array::from_fn(out, |e, c| inputs[0].lane(out, e, c))
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.clone())]
    }
}

pub fn samples() -> Vec<Sample> {
    let (frame, row) = (Axis::new("frame", 3), Axis::new("row", 4));
    let x = || vec![SampleInput::new(Shape::new(&[&frame, &row], 2), -1.0, 1.0)];
    let (f, f2, f3, f4) = (frame.clone(), frame.clone(), frame.clone(), frame.clone());
    let (r, r2, r3, r4) = (row.clone(), row.clone(), row.clone(), row.clone());
    vec![
        Sample::new("sum over the inner axis", x(), move |x| x[0].sum(&[&r])),
        Sample::new("sum over the outer axis", x(), move |x| x[0].sum(&[&f])),
        Sample::new("sum over all axes", x(), move |x| x[0].sum(&[&f2, &r2])),
        Sample::new("mean_all", x(), |x| x[0].mean_all()),
        Sample::new("max_over", x(), move |x| x[0].max_over(&[&r3])),
        Sample::new("min_over", x(), move |x| x[0].min_over(&[&f3])),
        Sample::new("argmax_over", x(), move |x| x[0].argmax_over(&r4).to_f32()).not_differentiable(),
        Sample::new("argmin_over", x(), move |x| x[0].argmin_over(&f4).to_f32()).not_differentiable(),
        Sample::new("broadcast", vec![SampleInput::new(Shape::new(&[&frame], 2), -1.0, 1.0)], move |x| {
            x[0].broadcast_to(&Axes::new([frame.clone(), row.clone()]))
        }),
    ]
}
