//! The true warps, given: what registration is compared with.

use super::{Points, Warp};
use crate::config::Dof;
use raygrad_compiler::functions::matrix::{apply_homography, identity, join_affine};
use raygrad_compiler::{Axis, Shape, Tensor};

/// Name of the data input that holds the true transforms of patches, `(3, 3)` a frame.
pub const TRUTH: &str = "warp.truth";

/// Maps patches by the transforms in [`TRUTH`], and leaves cameras where they are; nothing is trained.
#[derive(Clone, Copy, Debug)]
pub struct KnownWarp {
    pub dof: Dof,
}

impl Warp for KnownWarp {
    fn map(&self, at: &Points, _: &Tensor) -> Tensor {
        match self.dof {
            Dof::Pose => at.position.clone(),
            _ => apply_homography(&truth(&at.frame), &at.position),
        }
    }
    fn global(&self, frame: &Axis, _: &Tensor) -> Option<Tensor> {
        Some(match self.dof {
            Dof::Pose => join_affine(&identity(3), &Tensor::constant(&[0.0; 3])),
            _ => truth(frame),
        })
    }
    fn dof(&self) -> Dof {
        self.dof
    }
    /// The truth of the first frame is its gauge already.
    fn zero_code_is_identity(&self) -> bool {
        true
    }
}

#[track_caller]
fn truth(frame: &Axis) -> Tensor {
    Tensor::data(TRUTH, Shape::new(&[frame], (3, 3)))
}
