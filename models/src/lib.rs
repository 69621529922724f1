//! raygrad: differentiable rendering. Models as tensor graphs, differentiated, fused and run on CPU or GPU.
//!
//! An [`Experiment`] trains; [`warps::Warp`] is what a registration method implements; everything else serves those two.
pub mod config;
pub mod data;
mod error;
mod experiment;
pub mod fields;
pub mod geometry;
pub mod pictures;
pub mod planar;
pub mod report;
pub mod run;
pub mod warps;

pub use error::Error;
pub use experiment::{Experiment, Observer, Outcome, Quiet, open_device};
pub use raygrad_runtime::Device;

/// The README's example compiles.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
