//! raygrad: differentiable rendering.
pub mod config;
pub mod data;
pub mod fields;
pub mod geometry;
pub mod planar;
pub mod run;
pub mod warps;
