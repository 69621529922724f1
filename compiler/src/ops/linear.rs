//! Linear layers: rows of channels times a weight matrix.

use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::graph::{Axis, Channels, Misfit, Shape, Tensor};
use crate::reference::{Array, Lane};
use crate::scalar::DType;

/// `y_o = sum_i x_i W_io` for weights `(in, out)`, or with W transposed `x_i = sum_o y_o W_io`.
///
/// The weights may have axes of their own (one network per frame), which the rows must have too.
#[derive(Clone, Debug)]
pub struct Linear {
    pub transposed: bool,
}

impl Linear {
    fn dims(&self, w: &Shape) -> Option<(usize, usize)> {
        match w.channels {
            Channels::Matrix(i, o) => Some(if self.transposed { (o, i) } else { (i, o) }),
            Channels::Vector(_) => None,
        }
    }
}

impl Op for Linear {
    fn name(&self) -> &'static str {
        if self.transposed { "linear_transposed" } else { "linear" }
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        let (x, w) = (&inputs[0], &inputs[1]);
        expect_dtype(x, DType::F32, 0)?;
        expect_dtype(w, DType::F32, 1)?;
        let Some((contracted, out)) = self.dims(w) else {
            return Err(Misfit::new(
                format!("the weights have {} channels, not a matrix", w.channels),
                format!("weights are (in, out): ({}, out) fits here", x.channels.count()),
            ));
        };
        if x.channels.count() != contracted {
            return Err(Misfit::new(
                format!("{} input channels do not fit weights {}", x.channels, w.channels),
                format!("weights ({}, out) or {contracted} input channels would fit", x.channels.count()),
            ));
        }
        Ok(Shape::of(x.axes.union(&w.axes), Channels::Vector(out), DType::F32))
    }
    fn form(&self) -> Form {
        Form::Linear { transposed: self.transposed }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (x, w) = (inputs[0], inputs[1]);
        let Channels::Matrix(ni, no) = w.shape.channels else { unreachable!("checked by the shape rule") };
        Array::from_fn(out, |e, j| {
            let (xe, we) = (x.element_of(out, e), w.element_of(out, e));
            let term = |i: usize| {
                let (row, column) = if self.transposed { (j, i) } else { (i, j) };
                x.at(xe, i).f() * w.at(we, row * no + column).f()
            };
            Lane::F((0..if self.transposed { no } else { ni }).map(term).sum())
        })
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (x, w) = (&inputs[0], &inputs[1]);
        let dx = Tensor::record(Linear { transposed: !self.transposed }, &[g, w]).reshape(x.channels());
        let dw = if self.transposed { g.outer(x, w.axes()) } else { x.outer(g, w.axes()) };
        vec![Some(dx), Some(dw)]
    }
}

impl Tensor {
    /// `y = x W`: contracts the channels with the rows of `weights`, a matrix `(in, out)`.
    #[track_caller]
    pub fn linear(&self, weights: &Tensor) -> Tensor {
        Tensor::record(Linear { transposed: false }, &[self, weights])
    }
    /// `x = y W^T`: contracts the channels with the columns of `weights`.
    #[track_caller]
    pub fn linear_transposed(&self, weights: &Tensor) -> Tensor {
        Tensor::record(Linear { transposed: true }, &[self, weights])
    }
}

pub fn samples() -> Vec<Sample> {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 5));
    let x = |n: usize| SampleInput::new(Shape::new(&[&frame, &row], n), -1.0, 1.0);
    vec![
        Sample::new("linear", vec![x(3), SampleInput::new(Shape::new(&[], (3, 4)), -1.0, 1.0)], |x| x[0].linear(&x[1])),
        Sample::new("linear_transposed", vec![x(4), SampleInput::new(Shape::new(&[], (3, 4)), -1.0, 1.0)], |x| {
            x[0].linear_transposed(&x[1])
        }),
        Sample::new(
            "linear, a network per frame",
            vec![x(3), SampleInput::new(Shape::new(&[&frame], (3, 2)), -1.0, 1.0)],
            |x| x[0].linear(&x[1]),
        ),
        Sample::new(
            "linear, one row per network",
            vec![
                SampleInput::new(Shape::new(&[&frame], 3), -1.0, 1.0),
                SampleInput::new(Shape::new(&[&frame], (3, 2)), -1.0, 1.0),
            ],
            |x| x[0].linear(&x[1]),
        ),
    ]
}
