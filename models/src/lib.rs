//! raygrad: differentiable rendering. Models as tensor graphs, differentiated, fused and run on CPU or GPU.
//!
//! An [`Experiment`] trains; [`warps::Warp`] is what a registration method implements; everything else serves those two.
//!
//! A warp of one's own is a map of points; pose extraction, alignment loss, pictures, checkpoints and tests follow:
//!
//! ```
//! use raygrad::prelude::*;
//!
//! #[derive(Debug)]
//! struct Shear(Mlp);
//!
//! impl Warp for Shear {
//!     fn map(&self, at: &Points, code: &Tensor) -> Tensor {
//!         let k = self.0.apply(&concat([&at.xy, code]));
//!         &at.xy + concat([&(k.ch(0) * at.y()), &(k.ch(1) * at.x())])
//!     }
//!     fn code_width(&self) -> usize {
//!         16
//!     }
//!     fn parameters(&self) -> Vec<Parameter> {
//!         self.0.parameters.clone()
//!     }
//! }
//!
//! let shear = Shear(Mlp::new(MlpSpec::new("shear", &[2 + 16, 32, 2])));
//! raygrad::testing::check_gradients(&shear)?;
//! let experiment = Experiment::preset("planar-l2g-small")?.warp(shear);
//! # drop(experiment);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
pub mod config;
pub mod data;
mod error;
mod estimate;
pub mod evaluation;
mod experiment;
pub mod fields;
pub mod geometry;
pub mod pictures;
pub mod planar;
pub mod radiance;
pub mod report;
pub mod run;
pub mod scene;
pub mod sweep;
pub mod testing;
pub mod training;
pub mod warps;

pub use error::Error;
pub use estimate::{Estimate, Trial};
pub use experiment::{Experiment, Observer, Outcome, Quiet, open_device};
pub use raygrad_compiler as compiler;
pub use raygrad_runtime as runtime;
pub use raygrad_runtime::Device;

/// The README's example compiles.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;

/// The program of `docs/new_warp.md` runs.
#[cfg(doctest)]
#[doc = include_str!("../../docs/new_warp.md")]
struct NewWarp;

/// The program of `docs/own_graph.md` runs.
#[cfg(doctest)]
#[doc = include_str!("../../docs/own_graph.md")]
struct OwnGraph;

/// What defining and training a warp takes. Ops are methods of [`Tensor`](prelude::Tensor), functions of them are listed in
/// [`raygrad_compiler::functions`].
pub mod prelude {
    pub use crate::config::Dof;
    pub use crate::warps::{Points, Warp};
    pub use crate::{Device, Experiment};
    pub use raygrad_compiler::functions::along::{concat_along, slice_along};
    pub use raygrad_compiler::functions::inverse::{determinant, inverse, solve};
    pub use raygrad_compiler::functions::lie::{cross, se2_exp, se3_exp, sl3_exp, so2_exp, so3_exp};
    pub use raygrad_compiler::functions::loss::{charbonnier, mean_absolute_error, mean_squared_error};
    pub use raygrad_compiler::functions::matrix::{apply, apply_affine, apply_homography, matmul};
    pub use raygrad_compiler::functions::mlp::{Activation, Init, Mlp, MlpSpec, Parameter};
    pub use raygrad_compiler::functions::posenc::positional_encoding;
    pub use raygrad_compiler::functions::vector::{dot, norm, normalize};
    pub use raygrad_compiler::ops::pick::concat;
    pub use raygrad_compiler::{Axes, Axis, Shape, Tensor};
}
