//! The similarity between the frame a run has learned and that of the reference poses.
//!
//! Registration fixes the world only up to a similarity, so errors are taken after `c' = s R c + t` has brought the
//! predicted camera centres as near to the reference as can be. Three ways to find it, those of the published programs:
//! [`procrustes`] (BARF, L2G-NeRF), [`umeyama`] and [`pairwise`] (INN on many and on few cameras).

use crate::geometry::Pose;
use nalgebra::{DMatrix, Matrix3, Vector3};

/// Poses that cannot be compared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoseSetError {
    #[error("there are {predicted} predicted poses but {reference} reference poses; each camera needs one of both")]
    Count { predicted: usize, reference: usize },
    #[error("there are no poses to compare")]
    Empty,
    #[error("{which} pose {view} has an entry that is not finite: {rows:?}")]
    NotFinite { which: &'static str, view: usize, rows: [f64; 12] },
    #[error(
        "{which} pose {view} is no rigid motion: its rotation part is off by {error:.2e} (at most {ROUGH} is let pass)"
    )]
    NotRigid { which: &'static str, view: usize, error: f64 },
}

/// How far a rotation may be from a proper one. The customary recentring of LLFF scenes leaves about a hundredth.
const ROUGH: f64 = 0.1;

/// Refuses lists of different length, empty ones, and poses that are none.
pub(super) fn check_pairs(predicted: &[Pose], reference: &[Pose]) -> Result<(), PoseSetError> {
    if predicted.len() != reference.len() {
        return Err(PoseSetError::Count { predicted: predicted.len(), reference: reference.len() });
    }
    check_poses("predicted", predicted)?;
    check_poses("reference", reference)
}

/// Refuses an empty list and poses that are none.
pub(super) fn check_poses(which: &'static str, poses: &[Pose]) -> Result<(), PoseSetError> {
    if poses.is_empty() {
        return Err(PoseSetError::Empty);
    }
    for (view, pose) in poses.iter().enumerate() {
        let rows = pose.to_rows();
        if rows.iter().any(|x| !x.is_finite()) {
            return Err(PoseSetError::NotFinite { which, view, rows });
        }
        let error = pose.rigidity_error();
        if error > ROUGH {
            return Err(PoseSetError::NotRigid { which, view, error });
        }
    }
    Ok(())
}

/// Which of the published alignments to use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alignment {
    /// Root mean square radii and the rotation between centres: [`procrustes`].
    Procrustes,
    /// Least squares on centres: [`umeyama`].
    Umeyama,
    /// The best of the similarities given by two cameras each: [`pairwise`].
    Pairwise,
}

impl Alignment {
    /// What INN uses on DTU: [`pairwise`] up to nine cameras, [`umeyama`] above.
    pub fn of_inn(cameras: usize) -> Alignment {
        if cameras <= 9 { Alignment::Pairwise } else { Alignment::Umeyama }
    }

    /// The similarity from the predicted poses' frame to that of the reference.
    ///
    /// # Errors
    /// If the lists differ in length, are empty, or hold something that is no pose.
    pub fn fit(self, predicted: &[Pose], reference: &[Pose]) -> Result<Similarity, PoseSetError> {
        match self {
            Alignment::Procrustes => procrustes(predicted, reference),
            Alignment::Umeyama => umeyama(predicted, reference),
            Alignment::Pairwise => pairwise(predicted, reference),
        }
    }
}

/// From the learned frame to the reference frame: `c_reference = scale * rotation * c_learned + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Reference units per learned unit. Learned depths times this are reference depths.
    pub scale: f64,
    pub rotation: Matrix3<f64>,
    /// In reference units.
    pub translation: Vector3<f64>,
    /// Largest over second largest singular value of the centres' correlation. Near one the rotation is well
    /// determined; infinite where centres lie on one line or in one point, so that they say nothing about the turn
    /// around it. One where the rotation is a camera's and not the centres' ([`pairwise`]).
    pub condition: f64,
}

impl Similarity {
    pub fn identity() -> Similarity {
        Similarity { scale: 1.0, rotation: Matrix3::identity(), translation: Vector3::zeros(), condition: 1.0 }
    }

    /// The rotation is not determined by the centres, or hardly: rotation errors after this alignment mean little.
    pub fn is_ill_conditioned(&self) -> bool {
        self.condition.is_nan() || self.condition > 1e4
    }

    /// A point of the learned frame in the reference frame.
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point * self.scale + self.translation
    }

    /// A point of the reference frame in the learned frame.
    pub fn point_to_learned(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.transpose() * (point - self.translation) / self.scale
    }

    /// Learned poses (world to camera) in the reference frame.
    pub fn align(&self, predicted: &[Pose]) -> Vec<Pose> {
        predicted.iter().map(|p| moved(p, &self.rotation.transpose(), self.apply(&p.center()))).collect()
    }

    /// A pose of the reference frame, say of a test view, in the learned frame.
    pub fn to_learned(&self, reference: &Pose) -> Pose {
        moved(reference, &self.rotation, self.point_to_learned(&reference.center()))
    }
}

/// The pose in a turned world, with its centre at `center`.
fn moved(pose: &Pose, turn: &Matrix3<f64>, center: Vector3<f64>) -> Pose {
    let rotation = pose.rotation * turn;
    Pose { rotation, translation: -(rotation * center) }
}

struct Centers {
    mean: Vector3<f64>,
    /// Without their mean.
    offsets: Vec<Vector3<f64>>,
    /// Mean squared length of the offsets.
    spread: f64,
}

fn centers(poses: &[Pose]) -> Centers {
    let all: Vec<Vector3<f64>> = poses.iter().map(Pose::center).collect();
    let n = all.len() as f64;
    let mean = all.iter().sum::<Vector3<f64>>() / n;
    let offsets: Vec<Vector3<f64>> = all.iter().map(|c| c - mean).collect();
    let spread = offsets.iter().map(Vector3::norm_squared).sum::<f64>() / n;
    // Equal centres differ from their mean by rounding, which is no spread.
    let rounding = (1e-14 * mean.norm()).powi(2);
    Centers { mean, offsets, spread: if spread <= rounding { 0.0 } else { spread } }
}

/// `U`, singular values, `V^T` with values descending. The general algorithm: the one for 3 x 3 works on squares and
/// loses half the digits.
fn svd(m: &Matrix3<f64>) -> Option<(Matrix3<f64>, Vector3<f64>, Matrix3<f64>)> {
    let general = DMatrix::from_fn(3, 3, |i, j| m[(i, j)]);
    let mut svd = general.try_svd(true, true, f64::EPSILON, 1000)?;
    svd.sort_by_singular_values();
    let (u, v_t) = (svd.u?, svd.v_t?);
    let fixed = |m: DMatrix<f64>| Matrix3::from_fn(|i, j| m[(i, j)]);
    Some((fixed(u), Vector3::from_fn(|i, _| svd.singular_values[i]), fixed(v_t)))
}

/// `first / second` singular value; infinite where there is no second.
fn condition(values: &Vector3<f64>) -> f64 {
    // What rounding leaves of an exact zero.
    if values[1] <= 1e-12 * values[0] { f64::INFINITY } else { values[0] / values[1] }
}

/// BARF's and L2G-NeRF's alignment on camera centres.
///
/// With means `t0` (reference), `t1` (predicted) and root mean square radii `s0`, `s1`, the rotation is `U V^T` of the
/// centres' correlation; a reflection is mended by negating its third row, as the published code does. Where the
/// centres of either list coincide, as at an identity start, nothing can be fitted and the identity comes back with an
/// infinite condition.
///
/// # Errors
/// If the lists differ in length, are empty, or hold something that is no pose.
pub fn procrustes(predicted: &[Pose], reference: &[Pose]) -> Result<Similarity, PoseSetError> {
    check_pairs(predicted, reference)?;
    let (to, from) = (centers(reference), centers(predicted));
    let (s0, s1) = (to.spread.sqrt(), from.spread.sqrt());
    let pairs = to.offsets.iter().zip(&from.offsets);
    let correlation: Matrix3<f64> = pairs.map(|(x0, x1)| x0 * x1.transpose() / (s0 * s1)).sum();
    let undetermined = Similarity { condition: f64::INFINITY, ..Similarity::identity() };
    if s0 * s1 == 0.0 || correlation.iter().any(|x| !x.is_finite()) {
        return Ok(undetermined);
    }
    let Some((u, values, v_t)) = svd(&correlation) else { return Ok(undetermined) };
    let mut rotation = u * v_t;
    if rotation.determinant() < 0.0 {
        rotation.row_mut(2).neg_mut();
    }
    let scale = s0 / s1;
    let translation = to.mean - rotation * from.mean * scale;
    Ok(Similarity { scale, rotation, translation, condition: condition(&values) })
}

/// Umeyama's least squares similarity on camera centres, with the two safeguards of INN's code: the predicted spread is
/// enlarged by 1e-6, and below a spread of 1e-5 the scale is one.
///
/// # Errors
/// If the lists differ in length, are empty, or hold something that is no pose.
pub fn umeyama(predicted: &[Pose], reference: &[Pose]) -> Result<Similarity, PoseSetError> {
    check_pairs(predicted, reference)?;
    let (to, from) = (centers(reference), centers(predicted));
    let pairs = to.offsets.iter().zip(&from.offsets);
    let covariance: Matrix3<f64> = pairs.map(|(g, e)| g * e.transpose() / predicted.len() as f64).sum();
    let Some((u, values, v_t)) = svd(&covariance) else {
        return Ok(Similarity { condition: f64::INFINITY, ..Similarity::identity() });
    };
    let mut signs = Vector3::new(1.0, 1.0, 1.0);
    if u.determinant() * v_t.determinant() < 0.0 {
        signs[2] = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let scale = if from.spread < 1e-5 { 1.0 } else { values.dot(&signs) / (from.spread + 1e-6) };
    let translation = to.mean - rotation * from.mean * scale;
    Ok(Similarity { scale, rotation, translation, condition: condition(&values) })
}

/// How many of the first cameras [`pairwise`] tries.
const TRIED: usize = 10;

/// INN's alignment of few cameras: of all ordered pairs (a, b) among the first ten, the similarity that maps pose a
/// exactly and the distance to b, chosen by the least product of mean rotation and mean centre error.
///
/// # Errors
/// If the lists differ in length, are empty, or hold something that is no pose.
pub fn pairwise(predicted: &[Pose], reference: &[Pose]) -> Result<Similarity, PoseSetError> {
    check_pairs(predicted, reference)?;
    let tried = predicted.len().min(TRIED);
    let mut best = (f64::INFINITY, Similarity { condition: f64::INFINITY, ..Similarity::identity() });
    for a in 0..tried {
        let (e, g) = (predicted[a].center(), reference[a].center());
        // Poses are world to camera: the camera's own turn cancels.
        let rotation = reference[a].rotation.transpose() * predicted[a].rotation;
        for b in (0..tried).filter(|b| *b != a) {
            let scale = (g - reference[b].center()).norm() / (e - predicted[b].center()).norm();
            if !(scale.is_finite() && scale > 0.0) {
                continue;
            }
            let candidate = Similarity { scale, rotation, translation: g - rotation * e * scale, condition: 1.0 };
            let errors = super::pose_errors(&candidate.align(predicted), reference)?;
            let cost = errors.mean_rotation_deg() * errors.mean_center();
            if cost < best.0 {
                best = (cost, candidate);
            }
        }
    }
    Ok(best.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(center: Vector3<f64>, twist: [f64; 3]) -> Pose {
        let rotation = Pose::exp(&[twist[0], twist[1], twist[2], 0.0, 0.0, 0.0]).rotation;
        Pose { rotation, translation: -(rotation * center) }
    }

    /// The check of section 8.1 of the method's specification.
    fn check_of_the_specification() -> (Vec<Pose>, Vec<Pose>) {
        let truth =
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [1.0, 1.0, 1.0]].map(Vector3::from);
        let turn = Pose::exp(&[0.3, -0.1, 0.2, 0.0, 0.0, 0.0]).rotation;
        let mut learned = truth.map(|c| turn * c * 0.5 + Vector3::new(0.1, 0.2, 0.3));
        learned[4] += Vector3::new(0.02, -0.01, 0.03);
        let poses = |centers: [Vector3<f64>; 5]| centers.map(|c| at(c, [0.1, c.x, -c.y])).to_vec();
        (poses(learned), poses(truth))
    }

    #[test]
    fn procrustes_on_the_specifications_numbers() {
        let (learned, truth) = check_of_the_specification();
        let found = procrustes(&learned, &truth).unwrap();
        assert!((found.scale - 1.496_663_0 / 0.750_738_7).abs() < 1e-6, "{found:?}");
        let rows = [0.976106, 0.175222, 0.128505, -0.205699, 0.935714, 0.286578, -0.070029, -0.306164, 0.949399];
        assert!((found.rotation - Matrix3::from_row_slice(&rows)).abs().max() < 1e-6);
        let last = found.align(&learned)[4].center();
        assert!((last - Vector3::new(1.031168, 0.994403, 1.044655)).norm() < 1e-6);
        assert!(!found.is_ill_conditioned());
    }

    #[test]
    fn every_method_undoes_an_exact_similarity_and_back() {
        let (_, truth) = check_of_the_specification();
        let exact = Similarity {
            scale: 2.5,
            rotation: Pose::exp(&[0.4, 1.0, -0.3, 0.0, 0.0, 0.0]).rotation,
            translation: Vector3::new(1.0, -2.0, 0.5),
            condition: 1.0,
        };
        let learned: Vec<Pose> = truth.iter().map(|p| exact.to_learned(p)).collect();
        for method in [Alignment::Procrustes, Alignment::Umeyama, Alignment::Pairwise] {
            let found = method.fit(&learned, &truth).unwrap();
            // Umeyama's scale is damped by 1e-6 over the learned spread.
            let room = if method == Alignment::Umeyama { 1e-4 } else { 1e-10 };
            for (a, b) in found.align(&learned).iter().zip(&truth) {
                assert!((a.rotation - b.rotation).abs().max() < 1e-10, "{method:?}");
                assert!((a.translation - b.translation).norm() < room, "{method:?}");
            }
            assert!((found.to_learned(&truth[1]).translation - learned[1].translation).norm() < room, "{method:?}");
        }
        assert_eq!((Alignment::of_inn(9), Alignment::of_inn(10)), (Alignment::Pairwise, Alignment::Umeyama));
    }

    #[test]
    fn cameras_on_a_line_or_in_a_point_are_told() {
        let line = |s: f64| (0..6).map(|i| at(Vector3::new(0.1, 0.2, 0.7) * s * f64::from(i), [0.1; 3])).collect();
        let (a, b): (Vec<Pose>, Vec<Pose>) = (line(1.0), line(2.0));
        assert!(procrustes(&a, &b).unwrap().is_ill_conditioned());
        assert!(umeyama(&a, &b).unwrap().is_ill_conditioned());
        let found = pairwise(&a, &b).unwrap();
        assert!(!found.is_ill_conditioned() && (found.scale - 2.0).abs() < 1e-12);
        // An identity start: nothing to align, and the poses stay as they are.
        let start = vec![Pose::identity(); 6];
        for method in [Alignment::Procrustes, Alignment::Umeyama, Alignment::Pairwise] {
            let found = method.fit(&start, &b).unwrap();
            assert!(found.is_ill_conditioned(), "{method:?}: {found:?}");
            assert!(found.align(&start).iter().all(|p| p.to_rows().iter().all(|x| x.is_finite())));
        }
        assert_eq!(procrustes(&start, &b).unwrap().align(&start), start);
    }

    #[test]
    fn a_reflection_is_mended_on_the_third_row() {
        let (_, truth) = check_of_the_specification();
        let mirrored: Vec<Pose> = truth
            .iter()
            .map(|p| {
                let c = p.center();
                at(Vector3::new(-c.x, c.y, c.z), [0.0; 3])
            })
            .collect();
        let found = procrustes(&mirrored, &truth).unwrap();
        let expected = Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, -1.0));
        assert!((found.rotation - expected).abs().max() < 1e-9, "{found:?}");
    }

    #[test]
    fn what_is_no_pose_is_refused() {
        let (learned, truth) = check_of_the_specification();
        assert_eq!(procrustes(&learned[..4], &truth).unwrap_err(), PoseSetError::Count { predicted: 4, reference: 5 });
        assert_eq!(umeyama(&[], &[]).unwrap_err(), PoseSetError::Empty);
        let mut broken = learned.clone();
        broken[2].translation.y = f64::NAN;
        let message = pairwise(&broken, &truth).unwrap_err().to_string();
        assert!(message.contains("predicted pose 2"), "{message}");
        broken = truth;
        broken[1].rotation *= 2.0;
        assert!(matches!(
            procrustes(&learned, &broken),
            Err(PoseSetError::NotRigid { which: "reference", view: 1, .. })
        ));
    }
}
