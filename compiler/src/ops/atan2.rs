//! The angle of the vector `(x, y)`, `atan2(y, x)`; operands y, x. The gradient is `(x, -y) / (x^2 + y^2)`, and 0 at
//! the origin.

use super::pointwise::binary;
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Atan2;

impl Pointwise for Atan2 {
    fn name(&self) -> &'static str {
        "atan2"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::F(a[0].f().atan2(a[1].f()))
    }
    fn vjp(&self, x: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (y, x) = (&x[0], &x[1]);
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        // Squares of tiny and of huge numbers are out of range. The scale changes neither the value nor its derivatives.
        let size = x.abs().max(&y.abs()).stop_gradient();
        let origin = size.equal(&zero);
        let size = origin.select(&one, &size);
        let (x, y) = (x / &size, y / &size);
        let square = origin.select(&one, &(&x * &x + &y * &y));
        let scaled = origin.select(&zero, &(g / size / square));
        vec![Some(&scaled * x), Some(-(scaled * y))]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        b.emit(Prim::Atan2, a)
    }
}

impl Tensor {
    /// The angle of the vector `(x, self)`, in `-pi..=pi`.
    #[track_caller]
    pub fn atan2(&self, x: &Tensor) -> Tensor {
        map(Atan2, &[self, x])
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        binary("atan2", (-1.0, 1.0), (0.3, 1.0), |y, x| y.atan2(x)),
        binary("atan2, left half plane", (0.2, 1.0), (-1.0, -0.3), |y, x| y.atan2(x)),
    ]
}
