//! raygrad's compiler: record a model as a tensor graph, differentiate it, simplify it, fuse it into regions and plan them.
//!
//! | stage | module |
//! |---|---|
//! | record | [`graph`], [`ops`], [`functions`] |
//! | differentiate | [`autodiff`] |
//! | evaluate in f64 | [`reference`] |
//! | what kernels see of pointwise ops | [`scalar`] |
pub mod autodiff;
pub mod functions;
pub mod graph;
pub mod ops;
pub mod reference;
pub mod scalar;

pub use graph::{Axes, Axis, Channels, RecordError, Shape, Tensor};
