//! Choice lane by lane, `if c != 0 { a } else { b }`.
//!
//! The gradient is a choice too, not a product with a mask: the branch not taken gets exact zeros. What it makes of them is its
//! own: `x log x` at 0 multiplies its zero with an infinity, and the sum of both branches' gradients is NaN. Choose its operands,
//! too, where it is not finite. A NaN that is not chosen ends here.

use super::{Pointwise, Sample, SampleInput, map};
use crate::graph::{Axis, Shape, Tensor};
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Select;

impl Pointwise for Select {
    fn name(&self) -> &'static str {
        "select"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::U32), None, None]
    }
    fn result(&self) -> Option<DType> {
        None
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        if a[0].u() != 0 { a[1] } else { a[2] }
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        if x[1].dtype() == DType::U32 {
            return vec![None; 3];
        }
        let zero = Tensor::scalar(0.0);
        vec![None, Some(x[0].select(g, &zero)), Some(x[0].select(&zero, g))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Select, a)
    }
}

impl Tensor {
    /// `a` where this (`u32`) is not 0, `b` elsewhere.
    #[track_caller]
    pub fn select(&self, a: &Tensor, b: &Tensor) -> Tensor {
        if self.dtype() == DType::F32 && self.error().is_none() {
            let problem = format!("operand 1 must be u32, found {}", self.shape());
            return Tensor::misfit("select", &[self, a, b], problem, "a comparison gives one: x.greater_than(&y)");
        }
        map(Select, &[self, a, b])
    }
}

pub fn samples() -> Vec<Sample> {
    let (row, column) = (Axis::new("row", 3), Axis::new("column", 5));
    let inputs = || {
        vec![
            SampleInput::new(Shape::new(&[&row, &column], 1), -1.0, 1.0),
            SampleInput::new(Shape::new(&[&row], 3), -1.0, 1.0),
            SampleInput::new(Shape::new(&[], 3), -1.0, 1.0),
        ]
    };
    let zero = || Tensor::scalar(0.0);
    vec![
        Sample::new("select", inputs(), move |x| x[0].less_than(&zero()).select(&x[1], &x[2])),
        Sample::new("select of integers", inputs(), move |x| {
            let (a, b) = (Tensor::integers(&[1, 2, 3]), Tensor::integers(&[7]));
            x[0].less_than(&zero()).select(&a, &b).to_f32() * &x[1]
        }),
    ]
}
