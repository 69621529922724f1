//! The f64 reference interpreter: the one oracle. Slow, simple, no fusion.

mod array;
mod check;
mod interpret;

pub use array::{Array, Data, Lane};
pub use check::{Direction, central_difference};
pub use interpret::{Bindings, EvalError, evaluate};
