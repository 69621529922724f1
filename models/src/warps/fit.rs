//! The closed-form global transform of each frame: the least squares fit of sensor points to field points.
//!
//! | dof | fit |
//! |---|---|
//! | 1 rotation | angle about the origin |
//! | 2 translation | difference of the means |
//! | 3 rigid | rotation and translation about the means |
//! | 8 homography | direct linear transform |
//!
//! The residual of the first three is the very objective that they minimise, so the derivative through the fit is zero
//! (envelope theorem) and it is taken as a constant. A homography minimises an algebraic error instead: there the gradient
//! passes through the solver.

use super::Points;
use crate::config::{Dof, Solver};
use raygrad_compiler::functions::homography::{self, fit_homography};
use raygrad_compiler::functions::rigid_fit::{fit_rigid_2d, fit_rotation_2d, fit_translation};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Axes, Tensor};

/// One `(3, 3)` transform a frame that takes the sensor points `at` to `mapped`. `identity` marks frames whose two point
/// sets are the same: their homography is the identity, and the singular system is not solved.
#[track_caller]
pub fn fit_global(dof: Dof, solver: Solver, at: &Points, mapped: &Tensor, identity: Option<&Tensor>) -> Tensor {
    let over = Axes::new([at.point.clone()]);
    match dof {
        Dof::Rotation => affine(&fit_rotation_2d(&at.xy, mapped, &over), dof).stop_gradient(),
        Dof::Translation => affine(&fit_translation(&at.xy, mapped, &over), dof).stop_gradient(),
        Dof::Rigid => affine(&fit_rigid_2d(&at.xy, mapped, &over), dof).stop_gradient(),
        Dof::Homography => {
            let solver = match solver {
                Solver::InverseIteration => homography::Solver::InverseIteration,
                Solver::Eigen => homography::Solver::Eigen,
            };
            fit_homography(&at.xy, mapped, &over, solver, identity)
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
        Dof::Homography => return part.reshape((3, 3)),
    };
    all.pick_as(&order, (3, 3))
}
