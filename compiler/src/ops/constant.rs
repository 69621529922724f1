//! Constants: channels without axes.

use super::{Form, Op, Sample};
use crate::graph::{Axes, Channels, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

/// Constant channels. Floats are kept in f64 for the reference and rounded to f32 in kernels.
#[derive(Clone, Debug, PartialEq)]
pub enum Constant {
    F(Vec<f64>, Channels),
    U(Vec<u32>),
}

impl Op for Constant {
    fn name(&self) -> &'static str {
        "constant"
    }
    fn shape(&self, _: &[Shape]) -> Result<Shape, Misfit> {
        let (len, channels, dtype) = match self {
            Constant::F(v, c) => (v.len(), *c, DType::F32),
            Constant::U(v) => (v.len(), Channels::Vector(v.len()), DType::U32),
        };
        if len != channels.count() {
            return Err(Misfit::new(format!("{len} values for {channels} channels"), "give one value a channel"));
        }
        Ok(Shape::of(Axes::none(), channels, dtype))
    }
    fn form(&self) -> Form {
        Form::Const(match self {
            Constant::F(v, _) => v.iter().map(|x| (*x as f32).to_bits()).collect(),
            Constant::U(v) => v.iter().copied().collect(),
        })
    }
    fn eval(&self, _: &[&Array], out: &Shape) -> Array {
        match self {
            Constant::F(v, _) => Array::floats(out, v.clone()),
            Constant::U(v) => Array::integers(out, v.clone()),
        }
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![]
    }
}

impl Tensor {
    /// Constant channels, broadcast over every axis.
    #[track_caller]
    pub fn constant(values: &[f64]) -> Tensor {
        Tensor::record(Constant::F(values.to_vec(), Channels::Vector(values.len())), &[])
    }
    /// A constant small matrix, row by row.
    #[track_caller]
    pub fn constant_matrix(rows: usize, columns: usize, values: &[f64]) -> Tensor {
        Tensor::record(Constant::F(values.to_vec(), Channels::Matrix(rows, columns)), &[])
    }
    /// One constant channel.
    #[track_caller]
    pub fn scalar(value: f64) -> Tensor {
        Tensor::constant(&[value])
    }
    /// Constant integer channels.
    #[track_caller]
    pub fn integers(values: &[u32]) -> Tensor {
        Tensor::record(Constant::U(values.to_vec()), &[])
    }
    /// The values if this is a float constant.
    pub fn as_constant(&self) -> Option<&[f64]> {
        match self.op_as::<Constant>() {
            Some(Constant::F(v, _)) => Some(v),
            _ => None,
        }
    }
    /// Whether every channel is the constant `value`.
    pub fn is_constant(&self, value: f64) -> bool {
        self.as_constant().is_some_and(|v| v.iter().all(|x| *x == value))
    }
}

pub fn samples() -> Vec<Sample> {
    vec![Sample::new("constant", vec![], |_| Tensor::constant(&[1.0, -2.5, 1e-3]))]
}
