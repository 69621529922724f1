//! raygrad: differentiable rendering.
pub mod config;
pub mod data;
pub mod geometry;
pub mod run;
