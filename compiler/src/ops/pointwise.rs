//! What all pointwise ops share: broadcasting by name, evaluation lane by lane, lowering to a scalar program.

use super::{Form, Op, Sample, SampleInput, common_channels, expect_dtype};
use crate::graph::{Axis, Misfit, Shape, Tensor};
use crate::reference::{Array, Lane};
use crate::scalar::{DType, ScalarBuilder, ScalarProgram, Val};
use std::fmt::Debug;
use std::sync::Arc;

/// Most operands of a pointwise op.
const MAX_OPERANDS: usize = 3;

/// An op that works lane by lane. Implementing this gives an [`Op`] through [`map`].
pub trait Pointwise: Debug + Clone + Send + Sync + 'static {
    fn name(&self) -> &'static str;
    /// Lane types of the operands. `None` accepts either, the same for all such operands, and gives the result its type.
    fn operands(&self) -> &'static [Option<DType>];
    /// Lane type of the result; `None` is that of the operands declared `None`.
    fn result(&self) -> Option<DType> {
        Some(DType::F32)
    }
    /// The f64 reference on one lane.
    fn eval(&self, args: &[Lane]) -> Lane;
    /// Gradients of the operands as IR.
    fn vjp(&self, inputs: &[Tensor], output: &Tensor, grad: &Tensor) -> Vec<Option<Tensor>>;
    /// Emits the op as scalar primitives; the result must be the last instruction.
    fn lower(&self, b: &mut ScalarBuilder, args: &[Val]) -> Val;
}

/// Wrapper that makes a [`Pointwise`] an [`Op`].
#[derive(Clone)]
pub struct Map<P>(pub P);

impl<P: Pointwise> Debug for Map<P> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Records a pointwise op.
#[track_caller]
pub fn map(op: impl Pointwise, inputs: &[&Tensor]) -> Tensor {
    Tensor::record(Map(op), inputs)
}

impl<P: Pointwise> Op for Map<P> {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        let want = self.0.operands();
        if want.len() != inputs.len() || want.len() > MAX_OPERANDS {
            return Err(Misfit::new(
                format!("{} operands for an op of {}", inputs.len(), want.len()),
                format!("give one tensor an operand; pointwise ops have at most {MAX_OPERANDS}"),
            ));
        }
        let mut axes = inputs[0].axes.clone();
        let mut channels = inputs[0].channels;
        let mut free: Option<DType> = None;
        for (i, (shape, want)) in inputs.iter().zip(want).enumerate() {
            axes = axes.union(&shape.axes);
            channels = common_channels(channels, shape.channels)?;
            match want {
                Some(dtype) => expect_dtype(shape, *dtype, i)?,
                None => match free {
                    Some(dtype) => expect_dtype(shape, dtype, i)?,
                    None => free = Some(shape.dtype),
                },
            }
        }
        Ok(Shape::of(axes, channels, self.0.result().or(free).unwrap_or(DType::F32)))
    }

    fn form(&self) -> Form {
        let args: Vec<Val> = (0..self.0.operands().len()).map(|i| Val::Input(i as u8)).collect();
        Form::Pointwise(Arc::new(ScalarProgram::build(|b| self.0.lower(b, &args))))
    }

    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        Array::from_fn(out, |element, channel| {
            let mut args = [Lane::U(0); MAX_OPERANDS];
            for (arg, a) in args.iter_mut().zip(inputs) {
                *arg = a.lane(out, element, channel);
            }
            self.0.eval(&args[..inputs.len()])
        })
    }

    fn vjp(&self, inputs: &[Tensor], output: &Tensor, grad: &Tensor) -> Vec<Option<Tensor>> {
        self.0.vjp(inputs, output, grad)
    }
}

/// The sample of a function of one tensor, with arguments from `low..high`.
pub(crate) fn unary(
    name: impl Into<String>,
    low: f64,
    high: f64,
    f: impl Fn(&Tensor) -> Tensor + Send + Sync + 'static,
) -> Sample {
    let row = Axis::new("row", 5);
    Sample::new(name, vec![SampleInput::new(Shape::new(&[&row], 3), low, high)], move |x| f(&x[0]))
}

/// The sample of a function of two tensors that have one axis in common and one each of their own.
pub(crate) fn binary(
    name: impl Into<String>,
    (low, high): (f64, f64),
    (low2, high2): (f64, f64),
    f: impl Fn(&Tensor, &Tensor) -> Tensor + Send + Sync + 'static,
) -> Sample {
    let (frame, row, column) = (Axis::new("frame", 2), Axis::new("row", 3), Axis::new("column", 4));
    let inputs = vec![
        SampleInput::new(Shape::new(&[&frame, &row], 3), low, high),
        SampleInput::new(Shape::new(&[&frame, &column], 1), low2, high2),
    ];
    Sample::new(name, inputs, move |x| f(&x[0], &x[1]))
}

/// The `std::ops` operator of a pointwise op, between tensors by value or by reference and with numbers on either side.
macro_rules! operator {
    ($trait:ident, $method:ident, $op:expr) => {
        super::pointwise::operator!(@tensor $trait, $method, $op, Tensor, Tensor);
        super::pointwise::operator!(@tensor $trait, $method, $op, Tensor, &Tensor);
        super::pointwise::operator!(@tensor $trait, $method, $op, &Tensor, Tensor);
        super::pointwise::operator!(@tensor $trait, $method, $op, &Tensor, &Tensor);
        impl std::ops::$trait<f64> for &Tensor {
            type Output = Tensor;
            #[track_caller]
            fn $method(self, other: f64) -> Tensor {
                map($op, &[self, &Tensor::scalar(other)])
            }
        }
        impl std::ops::$trait<f64> for Tensor {
            type Output = Tensor;
            #[track_caller]
            fn $method(self, other: f64) -> Tensor {
                map($op, &[&self, &Tensor::scalar(other)])
            }
        }
        impl std::ops::$trait<&Tensor> for f64 {
            type Output = Tensor;
            #[track_caller]
            fn $method(self, other: &Tensor) -> Tensor {
                map($op, &[&Tensor::scalar(self), other])
            }
        }
        impl std::ops::$trait<Tensor> for f64 {
            type Output = Tensor;
            #[track_caller]
            fn $method(self, other: Tensor) -> Tensor {
                map($op, &[&Tensor::scalar(self), &other])
            }
        }
    };
    (@tensor $trait:ident, $method:ident, $op:expr, $left:ty, $right:ty) => {
        impl std::ops::$trait<$right> for $left {
            type Output = Tensor;
            #[track_caller]
            fn $method(self, other: $right) -> Tensor {
                map($op, &[std::borrow::Borrow::borrow(&self), std::borrow::Borrow::borrow(&other)])
            }
        }
    };
}
pub(crate) use operator;
