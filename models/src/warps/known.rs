//! The true warps, given: what registration is compared with.

use super::{Points, Warp};
use raygrad_compiler::functions::matrix::apply_homography;
use raygrad_compiler::{Axis, Shape, Tensor};

/// Name of the data input that holds the true transforms, `(3, 3)` a frame.
pub const TRUTH: &str = "warp.truth";

/// Maps by the transforms in [`TRUTH`]; nothing is trained.
#[derive(Clone, Copy, Debug)]
pub struct KnownWarp;

impl Warp for KnownWarp {
    fn map(&self, at: &Points, _: &Tensor) -> Tensor {
        apply_homography(&truth(&at.frame), &at.position)
    }
    fn global(&self, frame: &Axis, _: &Tensor) -> Option<Tensor> {
        Some(truth(frame))
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
