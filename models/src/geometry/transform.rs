//! Transforms of the plane as 3 x 3 matrices, in f64.

use nalgebra::{Matrix3, Vector3};

/// A projective transform of the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform(pub Matrix3<f64>);

impl Transform {
    pub fn identity() -> Transform {
        Transform(Matrix3::identity())
    }
    pub fn translation(t: [f64; 2]) -> Transform {
        Transform(Matrix3::new(1.0, 0.0, t[0], 0.0, 1.0, t[1], 0.0, 0.0, 1.0))
    }
    /// Rotation by `angle` radians, x towards y.
    pub fn rotation(angle: f64) -> Transform {
        let (s, c) = angle.sin_cos();
        Transform(Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0))
    }
    /// Exponential of the traceless matrix [[h5, h3, h1], [h4, -h5 - h6, h2], [h7, h8, h6]].
    pub fn sl3(h: &[f64; 8]) -> Transform {
        let [h1, h2, h3, h4, h5, h6, h7, h8] = *h;
        Transform(Matrix3::new(h5, h3, h1, h4, -h5 - h6, h2, h7, h8, h6).exp())
    }
    /// From nine numbers, row by row.
    pub fn from_rows(m: &[f32]) -> Transform {
        Transform(Matrix3::from_row_iterator(m.iter().take(9).map(|x| f64::from(*x))))
    }
    /// The nine numbers, row by row.
    pub fn to_rows(self) -> [f32; 9] {
        std::array::from_fn(|i| self.0[(i / 3, i % 3)] as f32)
    }
    /// The point after the transform: q = H (x, y, 1), then q_xy / (q_z + 1e-8).
    pub fn apply(&self, p: [f64; 2]) -> [f64; 2] {
        let q = self.0 * Vector3::new(p[0], p[1], 1.0);
        let z = q.z + 1e-8;
        [q.x / z, q.y / z]
    }
}

/// `a * b` applies `b` first.
impl std::ops::Mul for Transform {
    type Output = Transform;
    fn mul(self, other: Transform) -> Transform {
        Transform(self.0 * other.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sl3_exponential() {
        let h = Transform::sl3(&[0.05, -0.02, 0.1, 0.03, 0.04, -0.06, 0.2, -0.1]);
        let expected = [1.047312, 0.100795, 0.048645, 0.028987, 1.022646, -0.018907, 0.197083, -0.088276, 0.947519];
        for (found, expected) in h.to_rows().iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() < 1e-6, "{found} instead of {expected}");
        }
    }
}
