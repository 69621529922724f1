//! Scatter-add: the adjoint of gathering.

use super::take::index_shape;
use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::cost::Work;
use crate::graph::{Axes, Axis, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

/// `y[k, index] += x` over all axes of x and the index but `keep`; the result has `keep` and `axis`.
#[derive(Clone, Debug)]
pub struct Scatter {
    pub axis: Axis,
    pub keep: Axes,
}

impl Op for Scatter {
    fn name(&self) -> &'static str {
        "scatter_add"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        index_shape(&inputs[1], &self.axis)?;
        let axes = inputs[0].axes.union(&inputs[1].axes);
        if !self.keep.is_subset(&axes) || axes.contains(&self.axis) {
            return Err(Misfit::new(
                format!("cannot scatter {axes} into {} and `{}`", self.keep, self.axis),
                "keep a subset of the operands' axes, and scatter into an axis they lack",
            ));
        }
        Ok(inputs[0].clone().with_axes(self.keep.union(&Axes::new([self.axis.clone()]))))
    }
    fn form(&self) -> Form {
        Form::Scatter { axis: self.axis.clone() }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (x, index) = (inputs[0], inputs[1]);
        let domain = x.shape.clone().with_axes(x.shape.axes.union(&index.shape.axes));
        let stride = super::cumsum::axis_stride(out, &self.axis);
        let n = out.channels.count();
        let mut y = Array::zeros(out);
        for e in 0..domain.axes.elements() {
            let slot = (index.lane(&domain, e, 0).u() as usize).min(self.axis.size() - 1);
            let at = y.element_of(&domain, e) + slot * stride;
            for c in 0..n {
                y.f_mut()[at * n + c] += x.lane(&domain, e, c).f();
            }
        }
        y
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.take(&inputs[1], &self.axis)), None]
    }
    fn work(&self, _: &[Shape], out: &Shape) -> Work {
        Work::others(out.channels.count() as u64)
    }
}

impl Tensor {
    /// Adds every element into the slot of a new `axis` that `index` names, keeping the axes `keep`.
    #[track_caller]
    pub fn scatter(&self, index: &Tensor, axis: &Axis, keep: &Axes) -> Tensor {
        Tensor::record(Scatter { axis: axis.clone(), keep: keep.clone() }, &[self, index])
    }
}

pub fn samples() -> Vec<Sample> {
    let (frame, slot, row) = (Axis::new("frame", 2), Axis::new("slot", 4), Axis::new("row", 7));
    let keep = Axes::new([frame.clone()]);
    vec![Sample::new("scatter", vec![SampleInput::new(Shape::new(&[&frame, &row], 3), -1.0, 1.0)], move |x| {
        let r = Tensor::index(&row);
        x[0].scatter(&r.wrapping_mul(&r).bit_and(&Tensor::integers(&[3])), &slot, &keep)
    })]
}
