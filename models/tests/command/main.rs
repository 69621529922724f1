//! The command `raygrad`, from outside.

mod bad_input;
mod evaluation;
mod results;
mod sweep;
mod workplace;
