//! One transform a frame, its Lie-algebra coordinates trained directly (BARF, ICCV 2021; naive without its window).
//!
//! | dof | code | transform |
//! |---|---|---|
//! | 1 | angle | rotation about the origin |
//! | 2 | (t_x, t_y) | translation |
//! | 3 | (u_x, u_y, angle) | SE(2) exponential |
//! | 6 | twist, rotation first | SE(3) exponential, from field to sensor |
//! | 8 | h1 .. h8 | SL(3) exponential |

use super::fit::affine;
use super::{Points, Warp};
use crate::config::Dof;
use raygrad_compiler::functions::lie::{se2_exp, se3_exp, sl3_exp, so2_exp};
use raygrad_compiler::functions::matrix::{apply, apply_affine, apply_homography, invert_pose};
use raygrad_compiler::functions::mlp::Init;
use raygrad_compiler::{Axis, Tensor};

/// A transform of `dof` degrees of freedom a frame.
#[derive(Clone, Copy, Debug)]
pub struct GlobalWarp {
    pub dof: Dof,
}

impl Warp for GlobalWarp {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        move_points(self.dof, code, &at.position)
    }
    fn code_width(&self) -> usize {
        self.dof.count()
    }
    fn code_init(&self) -> Init {
        Init::Zero
    }
    fn global(&self, _: &Axis, code: &Tensor) -> Option<Tensor> {
        let part = match self.dof {
            Dof::Rotation => so2_exp(code),
            Dof::Translation => code.clone(),
            Dof::Rigid => se2_exp(code),
            Dof::Pose => se3_exp(code),
            Dof::Homography => sl3_exp(code),
        };
        Some(affine(&part, self.dof))
    }
    fn dof(&self) -> Dof {
        self.dof
    }
    fn zero_code_is_identity(&self) -> bool {
        true
    }
}

/// Sensor `points` in the field, under the transform whose coordinates are the channels of `code`.
#[track_caller]
pub(super) fn move_points(dof: Dof, code: &Tensor, points: &Tensor) -> Tensor {
    match dof {
        Dof::Rotation => apply(&so2_exp(code), points),
        Dof::Translation => points + code,
        Dof::Rigid => apply_affine(&se2_exp(code), points),
        Dof::Pose => apply_affine(&invert_pose(&se3_exp(code)), points),
        Dof::Homography => apply_homography(&sl3_exp(code), points),
    }
}

/// Coordinates of a motion with their rotations and translations multiplied by the two factors of `scale`.
#[track_caller]
pub(super) fn scaled(dof: Dof, code: &Tensor, [rotation, translation]: [f64; 2]) -> Tensor {
    let (r, t) = (rotation, translation);
    let factors: &[f64] = match dof {
        _ if (r, t) == (1.0, 1.0) => return code.clone(),
        Dof::Rotation => &[r],
        Dof::Translation => &[t, t],
        Dof::Rigid => &[t, t, r],
        Dof::Pose => &[r, r, r, t, t, t],
        // Components 1 and 2 shift.
        Dof::Homography => &[t, t, r, r, r, r, r, r],
    };
    code * Tensor::constant(factors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_compiler::reference::{Bindings, Data, evaluate};

    #[test]
    fn rotations_and_translations_have_their_factors() {
        let of = |dof: Dof, scale| {
            let code: Vec<f64> = (1..=dof.count()).map(|i| i as f64).collect();
            let found = evaluate(&[scaled(dof, &Tensor::constant(&code), scale)], &Bindings::new()).unwrap().remove(0);
            let Data::F(found) = found.data else { panic!("motions are floats") };
            found
        };
        let scale = [10.0, 100.0];
        assert_eq!(of(Dof::Rotation, scale), [10.0]);
        assert_eq!(of(Dof::Translation, scale), [100.0, 200.0]);
        assert_eq!(of(Dof::Rigid, scale), [100.0, 200.0, 30.0]);
        assert_eq!(of(Dof::Pose, scale), [10.0, 20.0, 30.0, 400.0, 500.0, 600.0]);
        assert_eq!(of(Dof::Homography, scale), [100.0, 200.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0]);
        assert_eq!(of(Dof::Pose, [1.0, 1.0]), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }
}
