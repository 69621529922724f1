//! Errors at recording time.
//!
//! An op that does not fit its operands gives a tensor that carries the error; whatever is computed from it carries the
//! same error on, and compiling or evaluating the graph returns it. So model code needs no `?` and never panics.

use super::shape::Shape;
use std::fmt;
use std::panic::Location;

/// An op whose operands do not fit.
#[derive(Clone, Debug)]
pub struct RecordError {
    /// Name of the op, as in [`crate::ops::Op::name`], or of the function that records it.
    pub op: String,
    /// Shapes of the operands, in order, with the source line that made each.
    pub operands: Vec<(Shape, &'static Location<'static>)>,
    /// What is wrong.
    pub problem: String,
    /// What would have fitted.
    pub hint: String,
    /// The user's source line.
    pub source: &'static Location<'static>,
}

impl fmt::Display for RecordError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: {} at {}:{}", self.op, self.problem, self.source.file(), self.source.line())?;
        for (i, (shape, at)) in self.operands.iter().enumerate() {
            write!(f, "\n  operand {}: {shape}, from {}:{}", i + 1, at.file(), at.line())?;
        }
        if self.hint.is_empty() { Ok(()) } else { write!(f, "\n  hint: {}", self.hint) }
    }
}
impl std::error::Error for RecordError {}

/// A shape rule's refusal: the problem and what would have fitted. The recorder adds operands and source.
#[derive(Clone, Debug)]
pub struct Misfit {
    pub problem: String,
    pub hint: String,
}

impl Misfit {
    pub fn new(problem: impl Into<String>, hint: impl Into<String>) -> Misfit {
        Misfit { problem: problem.into(), hint: hint.into() }
    }
}
