//! Planar registration: patches of one photo, distorted by unknown warps, are aligned while a neural image is learned
//! from them.

pub mod data;
pub mod model;
pub mod trainer;

pub use data::{DataError, PERTURBATION, PlanarData};
pub use model::{PlanarModel, weights};
pub use trainer::{Evaluation, Trainer};
