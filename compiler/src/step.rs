//! What a compiled program computes: named outputs, and new values of inputs that carry over to the next step.

use crate::graph::{RecordError, Shape, Tensor};
use crate::ops::input::{Input, Role};
use std::collections::HashMap;

/// One step: outputs to read back, and updates applied when the step ends.
#[derive(Clone, Debug, Default)]
pub struct Step {
    pub outputs: Vec<(String, Tensor)>,
    /// An input (parameter or state) and its next value, of the same axes and channels.
    pub updates: Vec<(Tensor, Tensor)>,
}

/// A step that cannot be compiled.
#[derive(Debug, thiserror::Error)]
pub enum StepError {
    #[error("{0}")]
    Record(Box<RecordError>),
    #[error("input `{name}` is recorded as {first} and as {second}; one name is one buffer")]
    Conflict { name: String, first: Box<Shape>, second: Box<Shape> },
    #[error("an update must go to a parameter or state input, found {0}")]
    NotAnInput(String),
    #[error("the new value of `{name}` is {found}, expected {expected}")]
    UpdateShape { name: String, expected: Box<Shape>, found: Box<Shape> },
    #[error("two updates of `{0}`")]
    TwoUpdates(String),
    #[error("two outputs are called `{0}`")]
    TwoOutputs(String),
    #[error("the step has neither outputs nor updates")]
    Empty,
}

impl Step {
    /// Every tensor the step computes, outputs first.
    pub fn roots(&self) -> Vec<Tensor> {
        self.outputs.iter().map(|(_, t)| t.clone()).chain(self.updates.iter().map(|(_, t)| t.clone())).collect()
    }

    /// Refuses recording errors, clashing names and updates that do not fit.
    pub fn check(&self) -> Result<(), StepError> {
        if self.outputs.is_empty() && self.updates.is_empty() {
            return Err(StepError::Empty);
        }
        let targets = self.updates.iter().map(|(input, _)| input);
        let roots = self.roots();
        if let Some(e) = roots.iter().chain(targets.clone()).find_map(Tensor::error) {
            return Err(StepError::Record(Box::new(e.clone())));
        }
        let mut names: HashMap<&str, &Input> = HashMap::new();
        let all = crate::graph::topological(self.roots().into_iter().chain(targets.cloned()));
        for input in all.iter().filter_map(|t| t.op_as::<Input>()) {
            match names.get(&*input.name) {
                Some(first) if first.shape != input.shape => {
                    let (first, second) = (Box::new(first.shape.clone()), Box::new(input.shape.clone()));
                    return Err(StepError::Conflict { name: input.name.clone(), first, second });
                }
                _ => names.insert(&input.name, input),
            };
        }
        let mut updated = std::collections::HashSet::new();
        for (target, value) in &self.updates {
            let Some(input) = target.op_as::<Input>().filter(|i| matches!(i.role, Role::Parameter | Role::State))
            else {
                return Err(StepError::NotAnInput(format!("{target:?}")));
            };
            if !updated.insert(&input.name) {
                return Err(StepError::TwoUpdates(input.name.clone()));
            }
            let fits = value.shape().axes.is_subset(&input.shape.axes)
                && value.width() == input.shape.channels.count()
                && value.dtype() == input.shape.dtype;
            if !fits {
                let (expected, found) = (Box::new(input.shape.clone()), Box::new(value.shape().clone()));
                return Err(StepError::UpdateShape { name: input.name.clone(), expected, found });
            }
        }
        let mut outputs = std::collections::HashSet::new();
        for (name, _) in &self.outputs {
            if !outputs.insert(name) {
                return Err(StepError::TwoOutputs(name.clone()));
            }
        }
        Ok(())
    }
}
