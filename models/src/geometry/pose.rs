//! Camera poses on the host, in f64: rigid motions from world to camera.
//!
//! Camera axes are x right, y down, z forward. A pose takes a world point x to the camera point `R x + t`; the camera's
//! centre is `-R^T t`.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// World to camera, `[R | t]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    pub fn identity() -> Pose {
        Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// From twelve numbers, `[R | t]` row by row.
    ///
    /// # Panics
    /// If there are fewer.
    pub fn from_rows<T: Copy + Into<f64>>(rows: &[T]) -> Pose {
        let at = |row: usize, column: usize| rows[4 * row + column].into();
        Pose { rotation: Matrix3::from_fn(at), translation: Vector3::from_fn(|row, _| at(row, 3)) }
    }

    /// Twelve numbers, `[R | t]` row by row.
    pub fn to_rows(self) -> [f64; 12] {
        std::array::from_fn(|i| match i % 4 {
            3 => self.translation[i / 4],
            column => self.rotation[(i / 4, column)],
        })
    }

    /// The exponential of a twist, rotation vector first, then translation (bundle adjustment papers' se(3)).
    pub fn exp(twist: &[f64; 6]) -> Pose {
        let [w1, w2, w3, u1, u2, u3] = *twist;
        let (w, u) = (Vector3::new(w1, w2, w3), Vector3::new(u1, u2, u3));
        let theta2 = w.norm_squared();
        let theta = theta2.sqrt();
        // (1 - cos) / theta^2 and (theta - sin) / theta^3; their series where the quotients lose all digits.
        let (b, c) = if theta < 1e-4 {
            (0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0)
        } else {
            ((1.0 - theta.cos()) / theta2, (theta - theta.sin()) / (theta2 * theta))
        };
        let hat = w.cross_matrix();
        let v = Matrix3::identity() + hat * b + hat * hat * c;
        Pose { rotation: Rotation3::new(w).into_inner(), translation: v * u }
    }

    /// `self` after `inner`.
    pub fn after(&self, inner: &Pose) -> Pose {
        let rotation = self.rotation * inner.rotation;
        Pose { rotation, translation: self.rotation * inner.translation + self.translation }
    }

    /// Camera to world, by the transpose.
    pub fn inverse(&self) -> Pose {
        let rotation = self.rotation.transpose();
        Pose { rotation, translation: -(rotation * self.translation) }
    }

    pub fn apply(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * x + self.translation
    }

    /// The camera's centre in the world.
    pub fn center(&self) -> Vector3<f64> {
        -(self.rotation.transpose() * self.translation)
    }

    /// How far the rotation is from a proper one: the largest entry of `|R R^T - I|`, or infinity for a reflection or
    /// anything that is no number.
    pub fn rigidity_error(&self) -> f64 {
        let error = (self.rotation * self.rotation.transpose() - Matrix3::identity()).abs().max();
        let finite = self.to_rows().iter().all(|x| x.is_finite());
        if finite && self.rotation.determinant() > 0.0 { error } else { f64::INFINITY }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check of the bundle adjustment papers' exponential.
    #[test]
    fn exponential_of_a_twist() {
        let pose = Pose::exp(&[0.1, -0.2, 0.3, 0.4, 0.5, -0.6]);
        let expected = Vector3::new(0.371_933_875, 0.585_313_802, -0.533_768_757);
        assert!((pose.translation - expected).norm() < 1e-8, "{pose:?}");
        assert!((pose.rotation[(0, 1)] + 0.302_932_713).abs() < 1e-8);
        let small = Pose::exp(&[1e-5, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert!((small.translation - Vector3::new(0.0, 1.0, 5e-6)).norm() < 1e-9);
    }

    #[test]
    fn a_pose_and_its_inverse() {
        let (a, b) = (Pose::exp(&[0.3, 0.1, -0.2, 1.0, 2.0, 3.0]), Pose::exp(&[-0.1, 0.4, 0.2, 0.5, 0.0, -1.0]));
        let x = Vector3::new(0.3, -0.7, 2.0);
        assert!((a.after(&b).apply(&x) - a.apply(&b.apply(&x))).norm() < 1e-12);
        assert!((a.inverse().apply(&a.apply(&x)) - x).norm() < 1e-12);
        assert!(a.apply(&a.center()).norm() < 1e-12);
        assert_eq!(Pose::from_rows(&a.to_rows()), a);
        assert!(a.rigidity_error() < 1e-12);
        assert_eq!(Pose { rotation: -a.rotation, ..a }.rigidity_error(), f64::INFINITY);
    }
}
