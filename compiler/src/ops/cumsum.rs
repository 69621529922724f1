//! Cumulative sums; exclusive ones give the transmittance along a ray.

use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::cost::Work;
use crate::graph::{Axis, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

/// `y_i = sum_{j<i} x_j`, or `sum_{j>i} x_j` if reversed.
#[derive(Clone, Debug)]
pub struct CumSum {
    pub axis: Axis,
    pub reverse: bool,
}

impl Op for CumSum {
    fn name(&self) -> &'static str {
        if self.reverse { "reverse_cumsum" } else { "cumsum" }
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        along(&inputs[0], &self.axis)?;
        Ok(inputs[0].clone())
    }
    fn form(&self) -> Form {
        Form::CumSum { axis: self.axis.clone(), reverse: self.reverse }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (x, mut y) = (inputs[0], Array::zeros(out));
        let (stride, size, n) = (axis_stride(out, &self.axis), self.axis.size(), out.channels.count());
        for e in 0..out.axes.elements() {
            let position = e / stride % size;
            let start = e - position * stride;
            let range = if self.reverse { position + 1..size } else { 0..position };
            for c in 0..n {
                y.f_mut()[e * n + c] = range.clone().map(|p| x.at(start + p * stride, c).f()).sum();
            }
        }
        y
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(Tensor::record(CumSum { axis: self.axis.clone(), reverse: !self.reverse }, &[g]))]
    }
    fn work(&self, _: &[Shape], out: &Shape) -> Work {
        Work::others(out.channels.count() as u64)
    }
}

/// Refuses an axis that `shape` lacks.
pub(crate) fn along(shape: &Shape, axis: &Axis) -> Result<(), Misfit> {
    if shape.axes.contains(axis) {
        return Ok(());
    }
    Err(Misfit::new(format!("{shape} has no axis `{axis}`"), format!("axes here: {}", shape.axes)))
}

/// Elements between neighbours along `axis`.
pub(crate) fn axis_stride(shape: &Shape, axis: &Axis) -> usize {
    shape.axes.iter().skip_while(|a| *a != axis).skip(1).map(Axis::size).product()
}

impl Tensor {
    /// Exclusive cumulative sum along `axis`: the first element is 0.
    #[track_caller]
    pub fn cumsum(&self, axis: &Axis) -> Tensor {
        Tensor::record(CumSum { axis: axis.clone(), reverse: false }, &[self])
    }
    /// Inclusive cumulative sum along `axis`: the last element is the sum of all.
    #[track_caller]
    pub fn inclusive_cumsum(&self, axis: &Axis) -> Tensor {
        self.cumsum(axis) + self
    }
    /// Exclusive cumulative sum from the end: the last element is 0.
    #[track_caller]
    pub fn reverse_cumsum(&self, axis: &Axis) -> Tensor {
        Tensor::record(CumSum { axis: axis.clone(), reverse: true }, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    let (ray, sample) = (Axis::new("ray", 3), Axis::new("sample", 6));
    let x = || vec![SampleInput::new(Shape::new(&[&ray, &sample], 2), -1.0, 1.0)];
    let (s, s2) = (sample.clone(), sample.clone());
    vec![
        Sample::new("cumsum", x(), move |x| x[0].cumsum(&s)),
        Sample::new("inclusive_cumsum", x(), move |x| x[0].inclusive_cumsum(&s2)),
        Sample::new("reverse_cumsum along the outer axis", x(), move |x| x[0].reverse_cumsum(&ray)),
    ]
}
