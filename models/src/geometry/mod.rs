//! Host-side geometry in f64: grids, transforms, errors. What runs inside a step is a graph instead, see `warps`.

pub mod grid;
pub mod transform;

pub use grid::Grid;
pub use transform::Transform;
