//! Derived operations: plain functions of ops, with no rules of their own.
//!
//! | module | what |
//! |---|---|
//! | [`matrix`] | small matrices in channels: products, application to points, rigid poses, linear solve |
//! | [`inverse`](mod@inverse) | determinants, inverses, and solutions of up to four unknowns |
//! | [`vector`] | inner products, lengths, directions |
//! | [`along`] | parts of an axis, and axes one after the other |
//! | [`lie`] | exponentials of rotations, rigid motions and homographies |
//! | [`posenc`] | positional encoding and its coarse-to-fine weights |
//! | [`mlp`] | multi-layer perceptrons |
//! | [`weight_norm`] | a layer with lengths and directions of its weights apart |
//! | [`rigid_fit`] | closed-form rotation, translation and rigid motion between point sets |
//! | [`homography`] | direct linear transform |
//! | [`image`] | bilinear lookup |
//! | [`composite`] | depth samples and volume rendering |
//! | [`hierarchical`] | more depth samples where a first pass found weight |
//! | [`loss`], [`adam`] | mean squared and absolute errors, Charbonnier; the Adam update |
pub mod adam;
pub mod along;
pub mod composite;
pub mod hierarchical;
pub mod homography;
pub mod image;
pub mod inverse;
pub mod lie;
pub mod loss;
pub mod matrix;
pub mod mlp;
pub mod posenc;
pub mod rigid_fit;
pub mod vector;
pub mod weight_norm;

use crate::graph::{Called, Tensor};

/// `t` if it has `n` channels, else what [`Called::misfit`] gives.
#[track_caller]
pub(crate) fn expect_width(called: &Called, what: &str, t: &Tensor, n: usize) -> Result<(), Tensor> {
    if t.width() == n || t.error().is_some() {
        return Ok(());
    }
    let problem = format!("{what} have {} channels, not {n}", t.channels());
    Err(called.misfit(&[t], problem, format!("{what} have {n} channels")))
}
