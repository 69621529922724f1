//! The closed-form global transform of each frame: the least squares fit of sensor points to field points.
//!
//! | dof | fit |
//! |---|---|
//! | 1 rotation | angle about the origin |
//! | 2 translation | difference of the means |
//! | 3 rigid | rotation and translation about the means |
//! | 6 pose | rotation and translation of space about the means |
//! | 8 homography | direct linear transform |
//!
//! The residual of all but the last is the very objective that they minimise, so its derivative through the fit is zero
//! (envelope theorem): the gradient leaves that path out. Its own derivative is not zero, and second derivatives take it.
//! A homography minimises an algebraic error instead: there the gradient passes through the solver.

use super::Points;
use crate::config::{Dof, Solver};
use raygrad_compiler::functions::homography::{self, fit_homography};
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::matrix::{apply, apply_affine, apply_homography, invert_pose, split_pose};
use raygrad_compiler::functions::rigid_fit::{fit_rigid_2d, fit_rigid_3d, fit_rotation_2d, fit_translation};
use raygrad_compiler::ops::custom::custom_adjoint;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Axes, Tensor};

/// One transform a frame that takes points to what they are `mapped` to, or in 3D the pose back. Only 3D fits take more
/// than one set of points. `identity` marks frames whose two point sets are the same: their homography is the identity, and
/// the singular system is not solved.
#[track_caller]
pub fn fit_global(dof: Dof, solver: Solver, pairs: &[(&Points, &Tensor)], identity: Option<&Tensor>) -> Tensor {
    let [(at, mapped), ..] = pairs else {
        return Tensor::misfit("fit_global", &[], "no points", "give at least one set of points");
    };
    let (over, from) = (Axes::new([at.point.clone()]), &at.position);
    match dof {
        Dof::Rotation => affine(&fit_rotation_2d(from, mapped, &over), dof),
        Dof::Translation => affine(&fit_translation(from, mapped, &over), dof),
        Dof::Rigid => affine(&fit_rigid_2d(from, mapped, &over), dof),
        Dof::Pose => {
            let back: Vec<(&Tensor, &Tensor)> = pairs.iter().map(|(at, mapped)| (*mapped, &at.position)).collect();
            fit_rigid_3d(&back, &over)
        }
        Dof::Homography => {
            let solver = match solver {
                Solver::InverseIteration => homography::Solver::InverseIteration,
                Solver::Eigen => homography::Solver::Eigen,
            };
            fit_homography(from, mapped, &over, solver, identity)
        }
    }
}

/// A rotation `(2, 2)`, a translation of two channels or a rigid motion `(2, 3)` as a `(3, 3)` matrix.
#[track_caller]
pub(super) fn affine(part: &Tensor, dof: Dof) -> Tensor {
    let width = part.width();
    let all = concat([part, &Tensor::constant(&[0.0, 1.0])]);
    let (zero, one) = (width, width + 1);
    let order = match dof {
        Dof::Rotation => [0, 1, zero, 2, 3, zero, zero, zero, one],
        Dof::Translation => [one, zero, 0, zero, one, 1, zero, zero, one],
        Dof::Rigid => [0, 1, 2, 3, 4, 5, zero, zero, one],
        Dof::Pose => return part.reshape((3, 4)),
        Dof::Homography => return part.reshape((3, 3)),
    };
    all.pick_as(&order, (3, 3))
}

/// Sensor points under a global transform.
#[track_caller]
pub(crate) fn move_by(dof: Dof, transform: &Tensor, points: &Tensor) -> Tensor {
    match dof {
        Dof::Pose => apply_affine(&invert_pose(transform), points),
        _ => apply_homography(transform, points),
    }
}

/// Mean of `(local - global)^2` over frames, points and coordinates, with `global` the points `at` under the fitted transform.
#[track_caller]
pub(super) fn residual(dof: Dof, transform: &Tensor, at: &Points, local: &Tensor, global: &Tensor) -> Tensor {
    let value = mean_squared_error(local, global);
    let linear = match dof {
        Dof::Homography => return value,
        Dof::Pose => split_pose(&invert_pose(transform)).0,
        _ => transform.pick_as(&[0, 1, 3, 4], (2, 2)),
    };
    let share = 2.0 / (local.axes().union(global.axes()).elements() * local.width()) as f64;
    let apart = (local - global) * share;
    custom_adjoint(&value, &[local, &at.position], move |_, upstream| {
        vec![Some(&apart * upstream), Some(-apply(&linear.transpose(), &apart) * upstream)]
    })
}
