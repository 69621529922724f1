//! The command `raygrad`, from outside.

mod bad_input;
mod results;
mod workplace;
