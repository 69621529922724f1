//! The path of the novel-view videos: a small circle about a training camera.
//!
//! `theta_i = 2 pi i / n`; `R = R_y(asin(0.05 cos theta)) R_x(asin(0.05 sin theta))`; the pose is the anchor after a
//! shift of (0, 0, 3.8 s), the turn R, and a shift of (0, 0, -4 s): the camera swings about a point four units ahead.

use super::align::{PoseSetError, check_poses};
use crate::geometry::Pose;
use nalgebra::{Matrix3, Rotation3, Vector3};

/// Frames of the published videos, thirty a second.
pub const FRAMES: usize = 60;

const SWING: f64 = 0.05;
const AHEAD: f64 = 4.0;
const BACK: f64 = 3.8;

/// `frames` poses (world to camera) about `anchor`. `scale` is learned units per reference unit, the inverse of
/// [`Similarity::scale`](super::Similarity), for a run that learned its poses, else one.
pub fn novel_view_path(anchor: &Pose, frames: usize, scale: f64) -> Vec<Pose> {
    let shift = |z: f64| Pose { rotation: Matrix3::identity(), translation: Vector3::new(0.0, 0.0, z * scale) };
    let at = |i: usize| {
        let (sin, cos) = (std::f64::consts::TAU * i as f64 / frames as f64).sin_cos();
        let y = Rotation3::from_axis_angle(&Vector3::y_axis(), (SWING * cos).asin());
        let x = Rotation3::from_axis_angle(&Vector3::x_axis(), (SWING * sin).asin());
        let turn = Pose { rotation: (y * x).into_inner(), translation: Vector3::zeros() };
        anchor.after(&shift(BACK)).after(&turn).after(&shift(-AHEAD))
    };
    (0..frames).map(at).collect()
}

/// The training pose whose translation is nearest to the mean of all: the anchor of the published videos.
///
/// # Errors
/// If there are no poses, or one is none.
pub fn anchor(poses: &[Pose]) -> Result<Pose, PoseSetError> {
    check_poses("training", poses)?;
    let mean = poses.iter().map(|p| p.translation).sum::<Vector3<f64>>() / poses.len() as f64;
    let distance = |p: &Pose| (p.translation - mean).norm();
    let nearest = poses.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.ok_or(PoseSetError::Empty)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_path_swings_about_the_point_ahead() {
        let anchor = Pose::exp(&[0.2, 0.1, -0.3, 0.5, -0.4, 1.0]);
        let path = novel_view_path(&anchor, FRAMES, 0.5);
        assert_eq!(path.len(), 60);
        // What the swing leaves in place: 4 s ahead of the middle of the path.
        let ahead = Vector3::new(0.0, 0.0, 2.0);
        let seen = path[0].apply(&ahead);
        for pose in &path {
            assert!((pose.apply(&ahead) - seen).norm() < 1e-12 && pose.rigidity_error() < 1e-12);
        }
        assert!((path[0].center() - path[30].center()).norm() > 0.1);
        let mut others = vec![anchor; 3];
        others[0].translation.x += 1.0;
        others[2].translation.x -= 3.0;
        assert_eq!(super::anchor(&others).unwrap(), anchor);
        assert_eq!(super::anchor(&[]), Err(PoseSetError::Empty));
    }
}
