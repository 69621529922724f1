//! Multiplication, `a b`.

use super::{Pointwise, Sample, SampleInput, map};
use crate::graph::{Axis, Shape, Tensor};
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Mul;

impl Pointwise for Mul {
    fn name(&self) -> &'static str {
        "mul"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f() * a[1].f())
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g * &x[1]), Some(g * &x[0])]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Mul, a)
    }
}

super::pointwise::operator!(Mul, mul, Mul);

pub fn samples() -> Vec<Sample> {
    let (row, column) = (Axis::new("row", 3), Axis::new("column", 5));
    vec![Sample::new(
        "mul",
        vec![
            SampleInput::new(Shape::new(&[&row, &column], 4), -1.0, 1.0),
            SampleInput::new(Shape::new(&[&column], 1), -1.0, 1.0),
        ],
        |x| map(Mul, &[&x[0], &x[1]]),
    )]
}
