//! A world of a known size and place for captures whose own world is arbitrary.
//!
//! Cameras around something: the point nearest to all optical axes becomes the origin, and the mean distance to it 4, as in
//! NeRF's synthetic scenes. Cameras that all look the same way: the average camera becomes the identity, as for LLFF.

use super::frame::WorldFrame;
use super::llff::average_camera;
use crate::geometry::Pose;
use nalgebra::{Matrix3, Vector3};

/// Mean distance of cameras around something.
const DISTANCE: f64 = 4.0;
/// Forward-facing: the optical axes determine no point, this being the least eigenvalue of the mean of I - d d^T.
const PARALLEL: f64 = 0.02;
/// Root mean square distance between the centres of forward-facing cameras and their mean, where no depth is known: in
/// LLFF's scenes, whose nearest depth is 4/3, it is about this.
const SPREAD: f64 = 0.3;

/// Centres that spread less than this share of their distance from the origin are one, but for rounding.
const ROUNDING: f64 = 1e-9;

/// How cameras stand to each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Arrangement {
    /// Around the point `focus`; distances to it.
    Around {
        focus: Vector3<f64>,
        mean_distance: f64,
        least_distance: f64,
    },
    Forward,
}

/// Root mean square distance of the cameras from their mean; 0 where only rounding tells them apart.
fn spread(poses: &[Pose]) -> f64 {
    let n = poses.len().max(1) as f64;
    let mean = poses.iter().map(Pose::center).sum::<Vector3<f64>>() / n;
    let spread = (poses.iter().map(|p| (p.center() - mean).norm_squared()).sum::<f64>() / n).sqrt();
    if spread > ROUNDING * mean.norm() { spread } else { 0.0 }
}

impl Arrangement {
    pub fn of(poses: &[Pose]) -> Arrangement {
        if spread(poses) == 0.0 {
            return Arrangement::Forward;
        }
        let n = poses.len().max(1) as f64;
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for p in poses {
            let d: Vector3<f64> = p.rotation.row(2).transpose();
            let across = Matrix3::identity() - d * d.transpose();
            normal += across / n;
            right += across * p.center() / n;
        }
        let least = normal.symmetric_eigenvalues().min();
        let Some(focus) = normal.lu().solve(&right).filter(|_| least > PARALLEL) else {
            return Arrangement::Forward;
        };
        let in_front = poses.iter().filter(|p| p.apply(&focus).z > 0.0).count();
        let distances: Vec<f64> = poses.iter().map(|p| (p.center() - focus).norm()).collect();
        let mean_distance = distances.iter().sum::<f64>() / n;
        let least_distance = distances.iter().copied().fold(f64::INFINITY, f64::min);
        // Cameras that look outwards meet behind themselves.
        if 2 * in_front <= poses.len() || mean_distance <= 0.0 {
            return Arrangement::Forward;
        }
        Arrangement::Around { focus, mean_distance, least_distance }
    }
}

/// The world for these cameras, and its near plane. `nearest` is the least depth of anything seen, where known.
pub(super) fn normalise(poses: &[Pose], nearest: Option<f64>) -> (WorldFrame, f64) {
    match Arrangement::of(poses) {
        Arrangement::Around { focus, mean_distance, least_distance } => {
            let scale = DISTANCE / mean_distance;
            let frame = WorldFrame { linear: Matrix3::identity(), scale, offset: -scale * focus };
            (frame, scale * nearest.map_or(0.5 * least_distance, |z| 0.75 * z))
        }
        Arrangement::Forward => {
            let scale = match (nearest, spread(poses)) {
                (Some(z), _) => 1.0 / (0.75 * z),
                (None, 0.0) => 1.0,
                (None, spread) => SPREAD / spread,
            };
            (average_camera(poses, scale, false), 1.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at `center` that looks along `forward`.
    fn looking(center: Vector3<f64>, forward: Vector3<f64>) -> Pose {
        let z = forward.normalize();
        let x = z.cross(&Vector3::new(0.0, 0.3, 1.0)).normalize();
        let rotation = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
        Pose { rotation, translation: -(rotation * center) }
    }

    #[test]
    fn cameras_around_a_point_and_in_front_of_a_wall() {
        let point = Vector3::new(5.0, -3.0, 1.0);
        let ring = |i: i32| {
            let a = f64::from(i) * 0.4;
            let center = point + 9.0 * Vector3::new(a.cos(), a.sin(), 0.5).normalize();
            looking(center, point - center)
        };
        let poses: Vec<Pose> = (0..15).map(ring).collect();
        let (frame, near) = normalise(&poses, None);
        assert!((near - 2.0).abs() < 1e-9);
        assert!(poses.iter().all(|p| (frame.load(p).center().norm() - 4.0).abs() < 1e-9));

        let wall: Vec<Pose> = (0..12)
            .map(|i| {
                looking(
                    Vector3::new(f64::from(i % 4), f64::from(i / 4), 0.0),
                    Vector3::new(0.01 * f64::from(i), 1.0, 0.0),
                )
            })
            .collect();
        let (frame, near) = normalise(&wall, Some(8.0));
        assert_eq!((near, frame.scale), (1.0, 1.0 / 6.0));
        let mean = wall.iter().map(|p| frame.load(p).center()).sum::<Vector3<f64>>() / 12.0;
        assert!(mean.norm() < 1e-9);
        assert!(wall.iter().all(|p| frame.load(p).rotation.trace() > 2.9));
    }

    /// Cameras that only turn have no scale, whatever rounding makes of their centres.
    #[test]
    fn cameras_in_one_place() {
        let place = Vector3::new(11.3, -7.1, 3.7);
        for turn in [0.02, 0.5] {
            let turned = |i: i32| {
                let a = f64::from(i) * turn;
                looking(place, Vector3::new(a.cos(), a.sin(), 0.1))
            };
            let poses: Vec<Pose> = (0..12).map(turned).collect();
            assert!(poses.iter().any(|p| p.center() != poses[0].center()));
            let (frame, near) = normalise(&poses, None);
            assert_eq!((frame.scale, near), (1.0, 1.0), "{turn}");
        }
    }
}
