//! What a compiled program computes: named outputs, and new values of inputs that carry over to the next step.

use crate::graph::{Axes, RecordError, Shape, Tensor};
use crate::ops::input::{Input, Role};
use std::collections::HashMap;
use std::panic::Location;

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
    #[error(
        "input `{name}` is recorded as {first} at {} and as {second} at {}; one name is one buffer",
        line(.at[0]), line(.at[1])
    )]
    Conflict { name: String, first: String, second: String, at: [&'static Location<'static>; 2] },
    #[error("an update must go to a parameter or state input, found `{op}` of {}", line(.at))]
    NotAnInput { op: String, at: &'static Location<'static> },
    #[error("the new value of `{name}`, from {}, is {found}, expected {expected}", line(.at))]
    UpdateShape { name: String, expected: Box<Shape>, found: Box<Shape>, at: &'static Location<'static> },
    #[error(
        "two updates of `{name}`: of {} by {}, and of {} by {}; one name is one buffer, so a parameter is listed once, and two \
         networks have two prefixes",
        line(.of[0]), line(.by[0]), line(.of[1]), line(.by[1])
    )]
    TwoUpdates { name: String, of: [&'static Location<'static>; 2], by: [&'static Location<'static>; 2] },
    #[error("`{op}` of {} goes over {domain}; a GPU counts to {} elements", line(.at), u32::MAX)]
    TooManyElements { op: String, domain: Axes, at: &'static Location<'static> },
    #[error("two outputs are called `{0}`")]
    TwoOutputs(String),
    #[error("the step has neither outputs nor updates")]
    Empty,
}

/// File and line.
fn line(at: &Location) -> String {
    format!("{}:{}", at.file(), at.line())
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
        let mut names: HashMap<&str, (&Input, &'static Location)> = HashMap::new();
        let all = crate::graph::topological(self.roots().into_iter().chain(targets.cloned()));
        for (input, at) in all.iter().filter_map(|t| Some((t.op_as::<Input>()?, t.source()))) {
            match names.get(&*input.name) {
                Some((first, before)) if *first != input => {
                    let [first, mut second] = [first, input].map(|i| format!("{:?} {}", i.role, i.shape));
                    if first == second {
                        second += ", along other axes of the same names";
                    }
                    return Err(StepError::Conflict { name: input.name.clone(), first, second, at: [before, at] });
                }
                _ => names.insert(&input.name, (input, at)),
            };
        }
        let mut updated: HashMap<&str, [&'static Location; 2]> = HashMap::new();
        for (target, value) in &self.updates {
            let Some(input) = target.op_as::<Input>().filter(|i| matches!(i.role, Role::Parameter | Role::State))
            else {
                return Err(StepError::NotAnInput { op: target.op().name().into(), at: target.source() });
            };
            let [of, by] = [target.source(), value.source()];
            if let Some(before) = updated.insert(&input.name, [of, by]) {
                let (of, by) = ([before[0], of], [before[1], by]);
                return Err(StepError::TwoUpdates { name: input.name.clone(), of, by });
            }
            let fits = value.shape().axes.is_subset(&input.shape.axes)
                && value.width() == input.shape.channels.count()
                && value.dtype() == input.shape.dtype;
            if !fits {
                let (expected, found) = (Box::new(input.shape.clone()), Box::new(value.shape().clone()));
                return Err(StepError::UpdateShape { name: input.name.clone(), expected, found, at: value.source() });
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
