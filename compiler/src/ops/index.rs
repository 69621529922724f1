//! Position along an axis.

use super::{Form, Op, Sample};
use crate::graph::{Axes, Axis, Misfit, Shape, Tensor};
use crate::reference::{Array, Lane};
use crate::scalar::DType;

/// `0..size` along `axis`, as `u32`.
#[derive(Clone, Debug)]
pub struct Index {
    pub axis: Axis,
}

impl Op for Index {
    fn name(&self) -> &'static str {
        "index"
    }
    fn shape(&self, _: &[Shape]) -> Result<Shape, Misfit> {
        Ok(Shape::of(Axes::new([self.axis.clone()]), 1, DType::U32))
    }
    fn form(&self) -> Form {
        Form::Index { axis: self.axis.clone() }
    }
    fn eval(&self, _: &[&Array], out: &Shape) -> Array {
        Array::from_fn(out, |e, _| Lane::U(e as u32))
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![]
    }
}

impl Tensor {
    /// Position along `axis`: 0, 1, ..., as `u32`.
    #[track_caller]
    pub fn index(axis: &Axis) -> Tensor {
        Tensor::record(Index { axis: axis.clone() }, &[])
    }
}

pub fn samples() -> Vec<Sample> {
    let row = Axis::new("row", 5);
    vec![Sample::new("index", vec![], move |_| Tensor::index(&row).to_f32())]
}
