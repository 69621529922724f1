//! Recording: named axes, shapes, tensors and the errors of ops that do not fit.
pub mod axis;
pub mod error;
pub mod shape;
pub mod tensor;

pub use axis::{Axes, Axis};
pub use error::{Misfit, RecordError};
pub use shape::{Channels, Shape};
pub use tensor::{Called, Tensor, function, topological, with_source};
