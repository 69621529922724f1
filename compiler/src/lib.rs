//! raygrad's compiler: record a model as a tensor graph, differentiate it, simplify it, fuse it into regions and plan them.
//!
//! | stage | module | takes -> gives |
//! |---|---|---|
//! | record | [`graph`], [`ops`], [`functions`] | Rust calls -> checked tensors |
//! | differentiate | [`autodiff`] | tensors, loss, wanted -> tensors |
//! | simplify | [`simplify`] | step -> smaller step |
//! | fuse | [`fuse`] | step -> regions and the cuts between them |
//! | plan | [`plan`] | regions -> [`Program`] |
//!
//! [`cost`] says what work takes on a device. [`reference`](mod@reference) evaluates any graph in f64 and is the oracle of all tests; [`scalar`] is what kernels see of pointwise ops.
pub mod autodiff;
pub mod cost;
pub mod functions;
pub mod fuse;
pub mod graph;
pub mod ops;
pub mod plan;
pub mod reference;
pub mod scalar;
pub mod simplify;
pub mod step;

pub use fuse::Target;
pub use graph::{Axes, Axis, Channels, RecordError, Shape, Tensor};
pub use plan::{Program, compile};
pub use step::{Step, StepError};
