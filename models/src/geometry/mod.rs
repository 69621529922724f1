//! Host-side geometry in f64: grids, transforms, errors. What runs inside a step is a graph instead, see `warps`.

pub mod grid;
mod pose;
pub mod transform;

pub use grid::Grid;
pub use pose::Pose;
pub use transform::Transform;
