//! Neighbours along an axis.

use super::cumsum::{along, axis_stride};
use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::graph::{Axis, Misfit, Shape, Tensor};
use crate::reference::{Array, Lane};
use crate::scalar::DType;

/// `y[i] = x[i - by]`, 0 outside.
#[derive(Clone, Debug)]
pub struct Shift {
    pub axis: Axis,
    pub by: i64,
}

impl Op for Shift {
    fn name(&self) -> &'static str {
        "shift"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        along(&inputs[0], &self.axis)?;
        Ok(inputs[0].clone())
    }
    fn form(&self) -> Form {
        Form::Shift { axis: self.axis.clone(), by: self.by }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (stride, size) = (axis_stride(out, &self.axis), self.axis.size() as i64);
        Array::from_fn(out, |e, c| {
            let from = (e / stride) as i64 % size - self.by;
            let inside = (0..size).contains(&from);
            if inside { inputs[0].at((e as i64 - self.by * stride as i64) as usize, c) } else { Lane::F(0.0) }
        })
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.shift(&self.axis, -self.by))]
    }
}

impl Tensor {
    /// The element `by` places earlier along `axis` (later if negative), 0 where there is none.
    #[track_caller]
    pub fn shift(&self, axis: &Axis, by: i64) -> Tensor {
        let size = axis.size() as i64;
        Tensor::record(Shift { axis: axis.clone(), by: by.clamp(-size, size) }, &[self])
    }
}

pub fn samples() -> Vec<Sample> {
    let (ray, sample) = (Axis::new("ray", 3), Axis::new("sample", 6));
    let x = || vec![SampleInput::new(Shape::new(&[&ray, &sample], 2), -1.0, 1.0)];
    let (r, s) = (ray.clone(), sample.clone());
    vec![
        Sample::new("shift", x(), move |x| x[0].shift(&s, 2)),
        Sample::new("shift beyond the end", x(), {
            let s = sample.clone();
            move |x| x[0].shift(&s, i64::MIN) + x[0].shift(&s, (1 << 33) + 1) + x[0].shift(&s, i64::MAX) + &x[0]
        }),
        Sample::new("shift back, outer axis", x(), move |x| x[0].shift(&r, -1)),
    ]
}
