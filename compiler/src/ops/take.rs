//! Gather along an axis.

use super::cumsum::along;
use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::graph::{Axis, Channels, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

/// `y = table[.., index, ..]`: the table's `axis` is replaced by the axes of the index. Indices past the end read the
/// last slot.
#[derive(Clone, Debug)]
pub struct Take {
    pub axis: Axis,
}

impl Op for Take {
    fn name(&self) -> &'static str {
        "take"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        along(&inputs[0], &self.axis)?;
        index_shape(&inputs[1], &self.axis)?;
        let axes = inputs[0].axes.without(&self.axis).union(&inputs[1].axes);
        Ok(inputs[0].clone().with_axes(axes))
    }
    fn form(&self) -> Form {
        Form::Take { axis: self.axis.clone() }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (table, index) = (inputs[0], inputs[1]);
        let stride = super::cumsum::axis_stride(&table.shape, &self.axis);
        Array::from_fn(out, |e, c| {
            let slot = (index.lane(out, e, 0).u() as usize).min(self.axis.size() - 1);
            table.at(table.element_of(out, e) + slot * stride, c)
        })
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (table, index) = (&inputs[0], &inputs[1]);
        if table.dtype() == DType::U32 {
            return vec![None, None];
        }
        let keep = table.axes().without(&self.axis);
        vec![Some(g.scatter(index, &self.axis, &keep).reshape(table.channels())), None]
    }
}

/// An index is one `u32` channel and does not have the axis it points along.
pub(crate) fn index_shape(index: &Shape, axis: &Axis) -> Result<(), Misfit> {
    expect_dtype(index, DType::U32, 1)?;
    if index.channels.count() != 1 || index.channels != Channels::Vector(1) {
        return Err(Misfit::new(format!("an index has 1 channel, not {}", index.channels), "take one channel of it"));
    }
    if index.axes.contains(axis) {
        return Err(Misfit::new(
            format!("the index has the axis `{axis}` that it points along"),
            "index along another axis of the same size",
        ));
    }
    Ok(())
}

impl Tensor {
    /// Gathers along `axis` of this table: `index` is one `u32` channel whose axes replace it.
    #[track_caller]
    pub fn take(&self, index: &Tensor, axis: &Axis) -> Tensor {
        Tensor::record(Take { axis: axis.clone() }, &[self, index])
    }
}

pub fn samples() -> Vec<Sample> {
    let (frame, slot, row) = (Axis::new("frame", 2), Axis::new("slot", 4), Axis::new("row", 7));
    let index = |row: &Axis| {
        let r = Tensor::index(row);
        r.wrapping_mul(&r).bit_and(&Tensor::integers(&[3]))
    };
    let (s1, s2, r2) = (slot.clone(), slot.clone(), row.clone());
    vec![
        Sample::new("take", vec![SampleInput::new(Shape::new(&[&slot], 3), -1.0, 1.0)], move |x| {
            x[0].take(&index(&row), &s1)
        }),
        Sample::new("take per frame", vec![SampleInput::new(Shape::new(&[&frame, &slot], 2), -1.0, 1.0)], move |x| {
            x[0].take(&index(&r2), &s2)
        }),
    ]
}
