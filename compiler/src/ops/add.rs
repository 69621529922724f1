//! Addition, `a + b`.

use super::{Pointwise, Sample, SampleInput, map};
use crate::graph::{Axis, Shape, Tensor};
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Add;

impl Pointwise for Add {
    fn name(&self) -> &'static str {
        "add"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f() + a[1].f())
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(g.clone()), Some(g.clone())]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Add, a)
    }
}

super::pointwise::operator!(Add, add, Add);

pub fn samples() -> Vec<Sample> {
    let (row, column) = (Axis::new("row", 3), Axis::new("column", 5));
    vec![
        Sample::new(
            "add",
            vec![
                SampleInput::new(Shape::new(&[&row], 4), -1.0, 1.0),
                SampleInput::new(Shape::new(&[&column], 1), -1.0, 1.0),
            ],
            |x| map(Add, &[&x[0], &x[1]]),
        ),
        Sample::new("add to itself", vec![SampleInput::new(Shape::new(&[], 2), -1.0, 1.0)], |x| &x[0] + &x[0]),
    ]
}
