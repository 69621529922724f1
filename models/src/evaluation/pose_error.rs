//! Errors of camera poses, after alignment.
//!
//! Rotation: `acos(clamp((tr(R R_ref^T) - 1) / 2))`, the argument kept 1e-7 from either end as the published programs
//! do, so no error below 0.0256 degrees is ever reported. Translation: the distance of the world-to-camera vectors,
//! which holds the rotation error times the camera's distance as well, and the distance of camera centres beside it.
//! Lengths are in units of the reference; papers print them times 100.

use super::align::{PoseSetError, check_pairs};
use crate::geometry::Pose;
use crate::scene::nearest_rotation;
use nalgebra::Matrix3;

/// Errors per camera, in the order of the cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseErrors {
    /// Angles in radians.
    pub rotation: Vec<f64>,
    /// Distances of the world-to-camera translation vectors (BARF, L2G-NeRF; INN on LLFF and Blender).
    pub translation: Vec<f64>,
    /// Distances of the camera centres (INN on DTU).
    pub center: Vec<f64>,
}

impl PoseErrors {
    pub fn rotation_deg(&self) -> Vec<f64> {
        self.rotation.iter().map(|a| a.to_degrees()).collect()
    }
    pub fn mean_rotation_deg(&self) -> f64 {
        mean(&self.rotation).to_degrees()
    }
    pub fn mean_translation(&self) -> f64 {
        mean(&self.translation)
    }
    pub fn mean_center(&self) -> f64 {
        mean(&self.center)
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Angle in radians of the rotation between `a` and `b`, with the published clamp.
pub fn rotation_angle(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    const EDGE: f64 = 1.0 - 1e-7;
    (((a * b.transpose()).trace() - 1.0) / 2.0).clamp(-EDGE, EDGE).acos()
}

/// Errors of poses that are in the frame of the reference already, see [`Similarity::align`](super::Similarity::align).
///
/// # Errors
/// If the lists differ in length, are empty, or hold something that is no pose.
pub fn pose_errors(aligned: &[Pose], reference: &[Pose]) -> Result<PoseErrors, PoseSetError> {
    check_pairs(aligned, reference)?;
    let per_view = |f: fn(&Pose, &Pose) -> f64| aligned.iter().zip(reference).map(|(a, b)| f(a, b)).collect();
    Ok(PoseErrors {
        rotation: per_view(|a, b| rotation_angle(&a.rotation, &b.rotation)),
        translation: per_view(|a, b| (a.translation - b.translation).norm()),
        center: per_view(|a, b| (a.center() - b.center()).norm()),
    })
}

/// Angle in radians, with the published clamp, of the turn that all cameras share: by which orientations differ from those of
/// the reference on the whole (their chordal mean) once the centres are aligned.
///
/// # Errors
/// As of [`pose_errors`].
pub fn common_turn(aligned: &[Pose], reference: &[Pose]) -> Result<f64, PoseSetError> {
    check_pairs(aligned, reference)?;
    let turns = aligned.iter().zip(reference).map(|(a, b)| a.rotation.transpose() * b.rotation);
    Ok(rotation_angle(&nearest_rotation(&turns.sum()), &Matrix3::identity()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn errors_of_a_known_difference() {
        let reference = Pose::exp(&[0.2, -0.4, 0.1, 1.0, 2.0, 3.0]);
        let turned = Pose::exp(&[0.0, 0.0, 0.5, 0.0, 0.0, 0.0]).after(&reference);
        let shifted = Pose { translation: reference.translation + Vector3::new(0.3, 0.0, 0.4), ..reference };
        let errors = pose_errors(&[turned, shifted], &[reference; 2]).unwrap();
        assert!((errors.rotation[0] - 0.5).abs() < 1e-9);
        // A camera turned about its own centre: the centre stays, the vector does not.
        assert!(errors.center[0] < 1e-12 && errors.translation[0] > 0.1);
        assert!((errors.translation[1] - 0.5).abs() < 1e-12 && (errors.center[1] - 0.5).abs() < 1e-12);
        // The floor of the clamp.
        assert!((errors.rotation_deg()[1] - 0.025_623).abs() < 1e-5);
        assert!((errors.mean_rotation_deg() - (0.5f64.to_degrees() + 0.025_623) / 2.0).abs() < 1e-5);
        assert!(pose_errors(&[turned], &[reference; 2]).is_err());
    }

    /// Cameras that look different ways, turned about one axis of the world and a little each for itself.
    #[test]
    fn what_cameras_turn_by_together() {
        let reference: Vec<Pose> =
            (0..6).map(|i| Pose::exp(&[0.5 * f64::from(i), 0.3, -0.2 * f64::from(i), 1.0, 2.0, 3.0])).collect();
        let turned = |by: f64, own: f64| -> Vec<Pose> {
            let world = Pose::exp(&[0.0, by, 0.0, 0.0, 0.0, 0.0]);
            let own = |i: usize| Pose::exp(&[if i.is_multiple_of(2) { own } else { -own }, 0.0, 0.0, 0.0, 0.0, 0.0]);
            reference.iter().enumerate().map(|(i, pose)| pose.after(&world).after(&own(i))).collect()
        };
        for (by, own) in [(0.1, 0.0), (0.1, 0.05), (-0.02, 0.05)] {
            let found = common_turn(&turned(by, own), &reference).unwrap();
            assert!((found - by.abs()).abs() < 1e-4, "{found} instead of {by}");
        }
        assert!(common_turn(&turned(0.0, 0.05), &reference).unwrap() < 5e-4);
        assert!(common_turn(&reference[..5], &reference).is_err());
    }
}
