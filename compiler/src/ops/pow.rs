//! Powers of positive numbers, `x^p = e^(p log x)`, operands x, p: 1 where p is 0, else NaN where x is negative.
//!
//! The gradient is `(p x^(p - 1), y log x)`, and 0 where `x <= 0`. In single precision `x^p` is off by about `|p log x|` times the
//! rounding of a number. Whole powers are products instead ([`Tensor::powi`]): exact in sign, and defined for every base.

use super::pointwise::{binary, unary};
use super::{Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Debug)]
pub struct Pow;

impl Pointwise for Pow {
    fn name(&self) -> &'static str {
        "pow"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32), Some(DType::F32)]
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let (x, p) = (a[0].f(), a[1].f());
        Lane::F(if p == 0.0 { 1.0 } else { (p * x.ln()).exp() })
    }
    fn vjp(&self, inputs: &[Tensor], y: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let (x, p) = (&inputs[0], &inputs[1]);
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        let positive = x.greater_than(&zero);
        let x = positive.select(x, &one);
        let dx = positive.select(&(g * p * x.pow(&(p - 1.0))), &zero);
        let dp = p.as_constant().is_none().then(|| positive.select(&(g * y * x.log()), &zero));
        vec![Some(dx), dp]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let log = b.emit(Prim::Log, &[a[0]]);
        let z = b.emit(Prim::Mul, &[a[1], log]);
        let power = b.emit(Prim::Exp, &[z]);
        // Drivers take e^(2 log x) for x^2; the logarithm alone stays what it is.
        let defined = b.emit(Prim::Le, &[b.f(0.0), a[0]]);
        let power = b.emit(Prim::Select, &[defined, power, log]);
        let none = b.emit(Prim::Eq, &[a[1], b.f(0.0)]);
        b.emit(Prim::Select, &[none, b.f(1.0), power])
    }
}

impl Tensor {
    /// `self^exponent` for a base that is not negative; NaN where it is.
    #[track_caller]
    pub fn pow(&self, exponent: &Tensor) -> Tensor {
        map(Pow, &[self, exponent])
    }
    /// [`Tensor::pow`] with a number.
    #[track_caller]
    pub fn powf(&self, exponent: f64) -> Tensor {
        self.pow(&Tensor::scalar(exponent))
    }
    /// `self^exponent` by repeated products, for any base.
    #[track_caller]
    pub fn powi(&self, exponent: i32) -> Tensor {
        let mut square = self.clone();
        let mut power: Option<Tensor> = None;
        let mut rest = exponent.unsigned_abs();
        while rest > 0 {
            if rest % 2 == 1 {
                power = Some(match power {
                    Some(power) => power * &square,
                    None => square.clone(),
                });
            }
            rest /= 2;
            if rest > 0 {
                square = &square * &square;
            }
        }
        match power {
            Some(power) if exponent < 0 => 1.0 / power,
            Some(power) => power,
            None => self * 0.0 + 1.0,
        }
    }
}

pub fn samples() -> Vec<Sample> {
    vec![
        binary("pow", (0.5, 2.0), (-2.0, 2.0), |x, p| x.pow(p)),
        unary("powf", 0.2, 1.5, |x| x.powf(2.4)),
        unary("powi", -1.5, 1.5, |x| x.powi(5)),
        unary("powi, reciprocal", 0.5, 1.5, |x| x.powi(-3)),
        unary("powi of 0", -1.5, 1.5, |x| x.powi(0) * x),
    ]
}
