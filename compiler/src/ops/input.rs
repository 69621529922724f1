//! Inputs: named buffers that the host or an earlier step fills.

use super::{Form, Op, Sample};
use crate::graph::{Misfit, Shape, Tensor};
use crate::reference::Array;

/// Who writes an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// Trained: a step updates it, a checkpoint holds it.
    Parameter,
    /// Carried from step to step (Adam moments); a checkpoint holds it.
    State,
    /// Set by the host before the first step.
    Data,
    /// Set by the host before every step, without recompiling: learning rates, annealing weights, the step number.
    PerStep,
}

/// A named buffer.
#[derive(Clone, PartialEq)]
pub struct Input {
    pub name: String,
    pub role: Role,
    pub shape: Shape,
}

impl std::fmt::Debug for Input {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(f, "{:?} `{}`", self.role, self.name)
    }
}

impl Op for Input {
    fn name(&self) -> &'static str {
        "input"
    }
    fn shape(&self, _: &[Shape]) -> Result<Shape, Misfit> {
        Ok(self.shape.clone())
    }
    fn form(&self) -> Form {
        Form::Input
    }
    fn eval(&self, _: &[&Array], _: &Shape) -> Array {
        unreachable!("inputs are bound by the interpreter")
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![]
    }
}

/// The op of a tensor that only carries an error, see [`Tensor::misfit`].
#[derive(Debug)]
pub(crate) struct Refused {
    pub name: &'static str,
    pub misfit: Misfit,
}

impl Op for Refused {
    fn name(&self) -> &'static str {
        self.name
    }
    fn shape(&self, _: &[Shape]) -> Result<Shape, Misfit> {
        Err(self.misfit.clone())
    }
    fn form(&self) -> Form {
        Form::Identity
    }
    fn eval(&self, _: &[&Array], out: &Shape) -> Array {
        Array::zeros(out)
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None; inputs.len()]
    }
}

impl Tensor {
    #[track_caller]
    pub fn input(name: impl Into<String>, role: Role, shape: Shape) -> Tensor {
        Tensor::record(Input { name: name.into(), role, shape }, &[])
    }
    /// A trained parameter.
    #[track_caller]
    pub fn parameter(name: impl Into<String>, shape: Shape) -> Tensor {
        Tensor::input(name, Role::Parameter, shape)
    }
    /// A buffer the host sets before the first step.
    #[track_caller]
    pub fn data(name: impl Into<String>, shape: Shape) -> Tensor {
        Tensor::input(name, Role::Data, shape)
    }
    /// A value the host sets before every step.
    #[track_caller]
    pub fn per_step(name: impl Into<String>, shape: Shape) -> Tensor {
        Tensor::input(name, Role::PerStep, shape)
    }
}

pub fn samples() -> Vec<Sample> {
    vec![]
}
