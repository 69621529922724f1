//! Sums of outer products: the gradient of a linear layer's weights.

use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::graph::{Axes, Axis, Channels, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

/// `W_io = sum x_i d_o` over all axes of the operands but `keep`.
#[derive(Clone, Debug)]
pub struct Outer {
    pub keep: Axes,
}

impl Op for Outer {
    fn name(&self) -> &'static str {
        "outer"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        expect_dtype(&inputs[1], DType::F32, 1)?;
        let axes = inputs[0].axes.union(&inputs[1].axes);
        if !self.keep.is_subset(&axes) {
            return Err(Misfit::new(format!("no operand has all of {}", self.keep), format!("axes here: {axes}")));
        }
        let channels = Channels::Matrix(inputs[0].channels.count(), inputs[1].channels.count());
        Ok(Shape::of(self.keep.clone(), channels, DType::F32))
    }
    fn form(&self) -> Form {
        Form::Outer
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let (x, d) = (inputs[0], inputs[1]);
        let (ni, no) = (x.shape.channels.count(), d.shape.channels.count());
        let domain = out.clone().with_axes(x.shape.axes.union(&d.shape.axes));
        let mut w = Array::zeros(out);
        for e in 0..domain.axes.elements() {
            let (xe, de, we) = (x.element_of(&domain, e), d.element_of(&domain, e), w.element_of(&domain, e));
            for i in 0..ni {
                for o in 0..no {
                    w.f_mut()[we * ni * no + i * no + o] += x.at(xe, i).f() * d.at(de, o).f();
                }
            }
        }
        w
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (x, d) = (&inputs[0], &inputs[1]);
        let dx = d.linear_transposed(g).reshape(x.channels());
        let dd = x.linear(g).reshape(d.channels());
        vec![Some(dx), Some(dd)]
    }
}

impl Tensor {
    /// `W_io = sum x_i d_o` over all axes of `self` (x) and `d` but `keep`.
    #[track_caller]
    pub fn outer(&self, d: &Tensor, keep: &Axes) -> Tensor {
        Tensor::record(Outer { keep: keep.clone() }, &[self, d])
    }
}

pub fn samples() -> Vec<Sample> {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 5));
    let inputs = || {
        vec![
            SampleInput::new(Shape::new(&[&frame, &row], 3), -1.0, 1.0),
            SampleInput::new(Shape::new(&[&frame, &row], 2), -1.0, 1.0),
        ]
    };
    let keep_frame = Axes::new([frame.clone()]);
    vec![
        Sample::new("outer", inputs(), |x| x[0].outer(&x[1], &Axes::none())),
        Sample::new("outer, per frame", inputs(), move |x| x[0].outer(&x[1], &keep_frame)),
        Sample::new(
            "outer, nothing summed",
            vec![
                SampleInput::new(Shape::new(&[&row], 3), -1.0, 1.0),
                SampleInput::new(Shape::new(&[&row], 2), -1.0, 1.0),
            ],
            |x| x[0].outer(&x[1], x[0].axes()),
        ),
        Sample::new(
            "outer, an operand without the axis",
            vec![
                SampleInput::new(Shape::new(&[&frame], 3), -1.0, 1.0),
                SampleInput::new(Shape::new(&[&row], 2), -1.0, 1.0),
            ],
            |x| x[0].outer(&x[1], &Axes::none()),
        ),
    ]
}
