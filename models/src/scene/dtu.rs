//! DTU scans in the layout of IDR and NeuS (`cameras_sphere.npz` or `cameras.npz`, `image`, `mask`), and in pixelNeRF's,
//! `rs_dtu_4/DTU/SCAN`, with depth maps and masks in folders beside it.
//!
//! `world_mat_i` projects the world to pixels, P = K [R | -R c]; `scale_mat_i` holds the scale s and the centre m of the
//! object, and the loaded world is (x - m) / s. The published depths, 1.2 to 5.2 at s = 300 mm, are 360 to 1560 mm.
//! Every eighth image is for testing, from the first on.

use super::numpy::{self, NumpyArray};
use super::picture::{DepthFile, file_name, image_size, images_in};
use super::{DepthRange, Entry, Intrinsics, Listing, Pose, SceneError, WorldFrame, check_pose, enough_to_split, every};
use nalgebra::{Matrix3, Vector3};
use std::path::{Path, PathBuf};

const FILES: [&str; 2] = ["cameras_sphere.npz", "cameras.npz"];
const NEAR_FAR_MM: [f64; 2] = [360.0, 1560.0];

pub(super) fn lacks(root: &Path) -> Option<String> {
    if !FILES.iter().any(|f| root.join(f).is_file()) {
        return Some("no cameras_sphere.npz or cameras.npz".to_string());
    }
    (!root.join("image").is_dir()).then(|| "no folder `image`".to_string())
}

pub(super) fn list(root: &Path) -> Result<Listing, SceneError> {
    let path = FILES.iter().map(|f| root.join(f)).find(|p| p.is_file()).unwrap_or_else(|| root.join(FILES[0]));
    let arrays = numpy::read_archive(&path, |n| n.starts_with("world_mat_") || n.starts_with("scale_mat_"))?;
    let matrix = |name: String| match arrays.get(&name) {
        Some(a) if a.shape == [4, 4] || a.shape == [3, 4] => Ok(a),
        Some(a) => Err(a.refuse(&path, &format!("`{name}` of 4 x 4 numbers"))),
        None => {
            let (expected, found) = ("a matrix for every image".to_string(), "none".to_string());
            Err(SceneError::Field { path: path.clone(), field: name, expected, found })
        }
    };
    let frame = frame_of(matrix("scale_mat_0".into())?, &path)?;
    let images = images_in(&root.join("image"))?;
    enough_to_split(root, images.len())?;
    let around = Around::of(root);
    let mut entries = vec![];
    for (i, image) in images.into_iter().enumerate() {
        let scale = matrix(format!("scale_mat_{i}"))?;
        if frame_of(scale, &path)? != frame {
            let message = format!("`scale_mat_{i}` differs from `scale_mat_0`: expected one world for all images");
            return Err(SceneError::Format { path, message });
        }
        let field = format!("world_mat_{i}");
        let (k, pose) = decompose(&matrix(field.clone())?.values, &path, &field)?;
        let [height, width] = image_size(&image, (&path, field.clone()))?;
        let (cx, cy) = (k[(0, 2)], k[(1, 2)]);
        if !(cx > 0.0 && cx < width as f64 && cy > 0.0 && cy < height as f64) {
            return Err(SceneError::Field {
                path,
                field,
                expected: format!("a camera for images of {height} x {width} like {}", file_name(&image)),
                found: format!("its principal point at ({cx:.1}, {cy:.1})"),
            });
        }
        let intrinsics = Intrinsics { fx: k[(0, 0)], fy: k[(1, 1)], cx, cy, height, width, distortion: None };
        let (mask, depth) = (around.mask(root, &image, i), around.depth(i));
        entries.push(Entry { name: file_name(&image), image, mask, depth, intrinsics, pose: Some(pose) });
    }
    let (train, test) = every(8, entries);
    let [near, far] = NEAR_FAR_MM.map(|mm| mm * frame.scale);
    Ok(Listing { train, val: None, test, depth: DepthRange::Metric { near, far }, frame, notes: vec![] })
}

/// The world of the object's unit sphere.
fn frame_of(scale_mat: &NumpyArray, path: &Path) -> Result<WorldFrame, SceneError> {
    let m = &scale_mat.values;
    let (scale, center) = (m[0], Vector3::new(m[3], m[7], m[11]));
    let uniform = (m[5] - scale).abs() <= 1e-6 * scale && (m[10] - scale).abs() <= 1e-6 * scale;
    if !(scale > 0.0 && scale.is_finite() && uniform && center.iter().all(|x| x.is_finite())) {
        return Err(SceneError::Field {
            path: path.into(),
            field: "scale_mat_0".into(),
            expected: "one positive scale on the diagonal and a centre in the last column".into(),
            found: format!("diagonal {}, {}, {}", m[0], m[5], m[10]),
        });
    }
    Ok(WorldFrame { linear: Matrix3::identity(), scale: 1.0 / scale, offset: -center / scale })
}

/// K (positive diagonal, K_33 = 1) and pose of a projection matrix, by RQ decomposition.
fn decompose(p: &[f64], path: &Path, field: &str) -> Result<(Matrix3<f64>, Pose), SceneError> {
    let m = Matrix3::from_fn(|i, j| p[4 * i + j]);
    let last = Vector3::from_fn(|i, _| p[4 * i + 3]);
    let (Some(center), true) = (m.lu().solve(&-last), p.iter().all(|x| x.is_finite())) else {
        return Err(SceneError::Field {
            path: path.into(),
            field: field.into(),
            expected: "an invertible projection of finite numbers".into(),
            found: "none".into(),
        });
    };
    // RQ by QR of the rows and columns turned around: with J the reversal, (J M)^T = Q U gives M = (J U^T J) (J Q^T).
    let reversal = Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0);
    let (q, u) = (reversal * m).transpose().qr().unpack();
    let (k, r) = (reversal * u.transpose() * reversal, reversal * q.transpose());
    let signs = Matrix3::from_diagonal(&k.diagonal().map(f64::signum));
    let (k, r) = (k * signs, signs * r);
    // A projection is known up to a factor, which may be negative.
    let r = if r.determinant() < 0.0 { -r } else { r };
    let pose = check_pose(Pose { rotation: r, translation: -(r * center) }, path, || field.to_string())?;
    Ok((k / k[(2, 2)], pose))
}

/// Where masks and depth maps lie.
struct Around {
    /// The folder that holds `rs_dtu_4`, and the scan's name.
    shared: Option<(PathBuf, String)>,
}

impl Around {
    fn of(root: &Path) -> Around {
        let scan = root.file_name().map(|n| n.to_string_lossy().into_owned());
        let above = root.ancestors().nth(2).filter(|p| p.file_name().is_some_and(|n| n == "rs_dtu_4"));
        Around { shared: above.and_then(Path::parent).map(Path::to_path_buf).zip(scan) }
    }

    fn mask(&self, root: &Path, image: &Path, i: usize) -> Option<PathBuf> {
        let stem = image.file_stem()?.to_string_lossy().into_owned();
        let mut candidates = vec![root.join("mask").join(format!("{stem}.png"))];
        candidates.push(root.join("mask").join(format!("{i:03}.png")));
        if let Some((base, scan)) = &self.shared {
            let masks = base.join("submission_data/idrmasks").join(scan);
            candidates.push(masks.join(format!("{i:03}.png")));
            candidates.push(masks.join("mask").join(format!("{i:03}.png")));
        }
        candidates.into_iter().find(|p| p.is_file())
    }

    fn depth(&self, i: usize) -> Option<DepthFile> {
        let (base, scan) = self.shared.as_ref()?;
        let path = base.join("Depths").join(scan).join(format!("depth_map_{i:04}.pfm"));
        path.is_file().then_some(DepthFile { path, unit: 1.0 })
    }
}
