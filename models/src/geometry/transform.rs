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
    /// The `h` of which this is [`Transform::sl3`], as a map: matrices that differ by a factor are one. None where there is none,
    /// as for reflections, or more than one, as for half turns.
    pub fn sl3_log(&self) -> Option<[f64; 8]> {
        const HALVINGS: usize = 40;
        let whole = self.0 / self.0.determinant().cbrt();
        // Square roots until the matrix is near the identity.
        let (mut root, mut halvings) = (whole, 0);
        while (root - Matrix3::identity()).norm() > 0.2 {
            if halvings == HALVINGS {
                return None;
            }
            root = square_root(root)?;
            halvings += 1;
        }
        // log M = 2 artanh((M - I) (M + I)^-1)
        let z = (root - Matrix3::identity()) * (root + Matrix3::identity()).try_inverse()?;
        let (mut power, mut log) = (z, z);
        for k in 1..12 {
            power = power * z * z;
            log += power / f64::from(2 * k + 1);
        }
        let a = log * 2f64.powi(1 + halvings as i32);
        let h = [a[(0, 2)], a[(1, 2)], a[(0, 1)], a[(1, 0)], a[(0, 0)], a[(2, 2)], a[(2, 0)], a[(2, 1)]];
        // Whatever went wrong above, in numbers that are not finite or a root that is not one, shows here.
        let back = Transform::sl3(&h).0;
        ((back - whole).norm() < 1e-6 * whole.norm()).then_some(h)
    }
    /// Distance between two transforms' [`Transform::sl3_log`] (BARF's warp error), where both have one.
    pub fn sl3_distance(&self, other: &Transform) -> Option<f64> {
        let (a, b) = (self.sl3_log()?, other.sl3_log()?);
        Some(a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt())
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

/// The principal square root, by Denman and Beavers' iteration, or what that comes to where there is none.
fn square_root(m: Matrix3<f64>) -> Option<Matrix3<f64>> {
    let (mut root, mut inverse) = (m, Matrix3::identity());
    for _ in 0..50 {
        let next = (root + inverse.try_inverse()?) * 0.5;
        inverse = (inverse + root.try_inverse()?) * 0.5;
        root = next;
        let error = (root * root - m).norm();
        if error < 1e-13 * m.norm() {
            return Some(root);
        }
    }
    Some(root)
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

    #[test]
    fn sl3_logarithm() {
        for scale in [0.0, 0.1, 1.0, 4.0, 8.0] {
            let h = [0.05, -0.02, 0.1, 0.03, 0.04, -0.06, 0.2, -0.1].map(|x| scale * x);
            // A map keeps its logarithm whatever its matrix is multiplied with.
            let found = Transform(Transform::sl3(&h).0 * -3.0).sl3_log().unwrap();
            for (found, h) in found.iter().zip(h) {
                assert!((found - h).abs() < 1e-8, "{found} instead of {h}, times {scale}");
            }
        }
        let turn = Transform::rotation(3.0);
        assert!((turn.sl3_log().unwrap()[3] - 3.0).abs() < 1e-6);
        let distance = turn.sl3_distance(&Transform::rotation(2.9)).unwrap();
        assert!((distance - 0.1 * 2f64.sqrt()).abs() < 1e-6, "{distance}");
        let reflection = Transform(Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, 1.0)));
        let point = Transform(Matrix3::zeros());
        let nothing = Transform(Matrix3::from_element(f64::NAN));
        for map in [reflection, Transform::rotation(std::f64::consts::PI), point, nothing] {
            assert_eq!(map.sl3_log(), None, "{map:?}");
        }
    }
}
