//! The map from the world of a scene's files to the loaded world, and poses in both.
//!
//! x_loaded = scale L x_file + offset, with L a rotation (nearly, for the published LLFF recentring). Camera coordinates
//! are scaled along with the world.

use crate::geometry::Pose;
use nalgebra::{Matrix3, Vector3};

/// x_loaded = `scale` `linear` x_file + `offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldFrame {
    pub linear: Matrix3<f64>,
    pub scale: f64,
    pub offset: Vector3<f64>,
}

impl WorldFrame {
    pub fn identity() -> WorldFrame {
        WorldFrame { linear: Matrix3::identity(), scale: 1.0, offset: Vector3::zeros() }
    }

    /// A world-to-camera pose of the file's world in the loaded one.
    pub fn load(&self, pose: &Pose) -> Pose {
        let rotation = pose.rotation * self.linear.transpose();
        // -R' (s L c + offset) with R c = -t taken out: files with rounded rotations keep their t exactly where L is one.
        let bent = Matrix3::identity() - self.linear.transpose() * self.linear;
        let translation = self.scale * (pose.translation + pose.rotation * (bent * pose.center()));
        Pose { rotation, translation: translation - rotation * self.offset }
    }

    /// A world-to-camera pose of the loaded world in the file's one, its rotation made exact.
    pub fn unload(&self, pose: &Pose) -> Pose {
        let rotation = nearest_rotation(&(pose.rotation * self.inverse().transpose()));
        Pose { rotation, translation: -(rotation * self.unload_point(&pose.center())) }
    }

    /// A point of the loaded world in the file's one.
    pub fn unload_point(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.inverse() * (point - self.offset) / self.scale
    }

    /// Of `linear`, which is a rotation or nearly one, hence invertible.
    fn inverse(&self) -> Matrix3<f64> {
        self.linear.try_inverse().unwrap_or_else(|| self.linear.transpose())
    }
}

/// The rotation nearest to a matrix (polar decomposition by SVD).
pub(crate) fn nearest_rotation(m: &Matrix3<f64>) -> Matrix3<f64> {
    let svd = m.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => {
            let sign = (u.determinant() * v_t.determinant()).signum();
            u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t
        }
        _ => *m,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back() {
        let turn = Pose::exp(&[0.3, -1.0, 0.2, 0.0, 0.0, 0.0]).rotation;
        let frame = WorldFrame { linear: turn, scale: 0.3, offset: Vector3::new(1.0, -2.0, 0.5) };
        let pose = Pose::exp(&[0.1, 0.2, -0.7, 3.0, 1.0, 2.0]);
        let (x, loaded) = (Vector3::new(0.4, 1.5, -0.2), frame.load(&pose));
        let moved = frame.scale * (turn * x) + frame.offset;
        assert!((loaded.apply(&moved) - frame.scale * pose.apply(&x)).norm() < 1e-12);
        assert!((frame.unload_point(&moved) - x).norm() < 1e-12);
        let back = frame.unload(&loaded);
        assert!((back.rotation - pose.rotation).norm() < 1e-12 && (back.translation - pose.translation).norm() < 1e-12);
    }
}
