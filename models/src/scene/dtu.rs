//! DTU scans in the layout of IDR and NeuS (`cameras_sphere.npz` or `cameras.npz`, `image`, `mask`), and in pixelNeRF's,
//! `rs_dtu_4/DTU/SCAN`, with depth maps and masks in folders beside it.
//!
//! `world_mat_i` projects the world to pixels, P = K [R | -R c]; `scale_mat_i` holds the scale s and the centre m of the
//! object, and the loaded world is (x - m) / s. The published depths, 1.2 to 5.2 at s = 300 mm, are 360 to 1560 mm; captures in
//! other units, whose cameras are not at such distances from m, are looked at from 1 before m to 1 behind it (s in the world
//! of the files), as NeuS does.
//! Images go with the matrices of their number. Every eighth is for testing, from number 0 on, or what [`DtuSplit`] says.

use super::numpy::{self, NumpyArray};
use super::picture::{DepthFile, file_name, image_size, images_in, numbered};
use super::{
    DepthRange, Entry, Intrinsics, Listing, LoadOptions, Pose, SceneError, WorldFrame, check_pose, enough_to_split,
};
use image::metadata::Orientation;
use nalgebra::{Matrix3, Vector3};
use std::path::{Path, PathBuf};

const FILES: [&str; 2] = ["cameras_sphere.npz", "cameras.npz"];
const NEAR_FAR_MM: [f64; 2] = [360.0, 1560.0];
/// Nearest plane of captures in other units, in radii of the object.
const LEAST_NEAR: f64 = 0.1;
/// Largest shift in pixels that the skew of a camera may cause at the edge of its image.
const SKEW: f64 = 0.5;

pub(super) fn lacks(root: &Path) -> Option<String> {
    if !FILES.iter().any(|f| root.join(f).is_file()) {
        return Some("no cameras_sphere.npz or cameras.npz".to_string());
    }
    (!root.join("image").is_dir()).then(|| "no folder `image`".to_string())
}

/// Which views are for training and which for testing, by number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DtuSplit {
    /// Every eighth for testing.
    #[default]
    EveryEighth,
    /// pixelNeRF's nine for training, in its order; for testing all others but those that are badly lit.
    PixelNerf,
    /// Eighteen for training, of which the first nine are pixelNeRF's, and sixteen for testing.
    PixelNerfReduced,
    /// All for both.
    All,
}

const TRAINED: [usize; 18] = [25, 22, 28, 40, 44, 48, 0, 8, 13, 24, 30, 41, 47, 43, 29, 45, 34, 33];
const REDUCED_TEST: [usize; 16] = [1, 2, 9, 10, 11, 12, 14, 15, 23, 26, 27, 31, 32, 35, 42, 46];

impl DtuSplit {
    pub const ALL: [DtuSplit; 4] =
        [DtuSplit::EveryEighth, DtuSplit::PixelNerf, DtuSplit::PixelNerfReduced, DtuSplit::All];

    /// As the published code calls it.
    pub fn name(self) -> &'static str {
        match self {
            DtuSplit::EveryEighth => "eighth",
            DtuSplit::PixelNerf => "pixelnerf",
            DtuSplit::PixelNerfReduced => "pixelnerf_reduced_testset",
            DtuSplit::All => "all",
        }
    }

    /// The split called `name`.
    pub fn from_name(name: &str) -> Option<DtuSplit> {
        DtuSplit::ALL.into_iter().find(|s| s.name() == name)
    }

    /// The numbers to train on and to test with, of those that there are.
    pub(super) fn of(self, numbers: &[usize]) -> [Vec<usize>; 2] {
        let those = |chosen: &dyn Fn(usize) -> bool| numbers.iter().copied().filter(|n| chosen(*n)).collect();
        match self {
            DtuSplit::EveryEighth => [those(&|n| n % 8 != 0), those(&|n| n % 8 == 0)],
            DtuSplit::PixelNerf => {
                let dark = |n| matches!(n, 3..=7 | 16..=21 | 36..=39);
                [TRAINED[..9].to_vec(), those(&|n| !dark(n) && !TRAINED[..9].contains(&n))]
            }
            DtuSplit::PixelNerfReduced => [TRAINED.to_vec(), REDUCED_TEST.to_vec()],
            DtuSplit::All => [numbers.to_vec(), numbers.to_vec()],
        }
    }
}

pub(super) fn list(root: &Path, options: &LoadOptions) -> Result<Listing, SceneError> {
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
    let mut images = images_in(&root.join("image"))?;
    enough_to_split(root, images.len())?;
    let cameras = arrays.keys().filter(|name| name.starts_with("world_mat_")).count();
    let has = |n: &usize| arrays.contains_key(&format!("world_mat_{n}"));
    let numbers = numbered(&mut images).map(|all| all.into_iter().map(|n| n as usize).collect::<Vec<_>>());
    let numbers = match numbers.filter(|all| all.iter().all(has) && all.windows(2).all(|w| w[0] < w[1])) {
        Some(numbers) => numbers,
        // Names that say nothing: in their order.
        None if images.len() == cameras => (0..cameras).collect(),
        None => {
            let (folder, found) = (root.join("image"), images.len());
            let message = format!(
                "has {cameras} cameras, but {} has {found} images, whose names are not the cameras' numbers",
                folder.display()
            );
            return Err(SceneError::Format { path, message });
        }
    };
    let frame = frame_of(matrix(format!("scale_mat_{}", numbers[0]))?, &path)?;
    let around = Around::of(root);
    let entry = |image: PathBuf, i: usize| {
        let field = format!("scale_mat_{i}");
        if frame_of(matrix(field.clone())?, &path)? != frame {
            let message =
                format!("`{field}` differs from `scale_mat_{}`: expected one world for all images", numbers[0]);
            return Err(SceneError::Format { path: path.clone(), message });
        }
        let field = format!("world_mat_{i}");
        let (k, pose) = decompose(&matrix(field.clone())?.values, &path, &field)?;
        let [height, width] = image_size(&image, (&path, field.clone()))?;
        let (cx, cy) = (k[(0, 2)], k[(1, 2)]);
        let central = |c: f64, size: usize| (0.4..=0.6).contains(&(c / size as f64));
        if !(central(cx, width) && central(cy, height)) {
            let name = file_name(&image);
            return Err(SceneError::Field {
                path: path.clone(),
                field,
                expected: format!(
                    "a camera for {name}, of {height} x {width} pixels, with its principal point amid it"
                ),
                found: format!("one at ({cx:.1}, {cy:.1}); the cameras seem to be for images of another size"),
            });
        }
        let sheared = k[(0, 1)].abs() / k[(1, 1)] * height as f64 / 2.0;
        if sheared > SKEW {
            return Err(SceneError::Field {
                path: path.clone(),
                field,
                expected: "a camera without skew, its axes at right angles".into(),
                found: format!("a skew of {:.3}, which moves pixels by up to {sheared:.1}", k[(0, 1)]),
            });
        }
        let intrinsics = Intrinsics { fx: k[(0, 0)], fy: k[(1, 1)], cx, cy, height, width, distortion: None };
        let (mask, depth) = (around.mask(root, &image, i), around.depth(i));
        Ok(Entry {
            name: file_name(&image),
            image,
            turn: Orientation::NoTransforms,
            mask,
            depth,
            intrinsics,
            pose: Some(pose),
        })
    };
    let [train, test] = options.dtu_split.of(&numbers).map(|chosen| {
        let one = |n: usize| match numbers.iter().position(|m| *m == n) {
            Some(place) => entry(images[place].clone(), n),
            None => {
                let image = root.join("image").join(format!("{n:06}.png"));
                let field = format!("split {}", options.dtu_split.name());
                Err(SceneError::MissingImage { path: path.clone(), field, image })
            }
        };
        chosen.into_iter().map(one).collect::<Result<Vec<Entry>, SceneError>>()
    });
    let (train, test) = (train?, test?);
    let (depth, notes) = depths(&frame, train.iter().chain(&test));
    Ok(Listing { train, val: None, test, depth, frame, notes })
}

/// The published depths, or for captures in other units those around the object, and a note on them.
fn depths<'a>(frame: &WorldFrame, entries: impl Iterator<Item = &'a Entry>) -> (DepthRange, Vec<String>) {
    let distances = entries.filter_map(|e| Some(frame.load(&e.pose?).center().norm()));
    let (least, most) = distances.fold((f64::INFINITY, 0.0_f64), |(a, b), d| (a.min(d), b.max(d)));
    let [near, far] = NEAR_FAR_MM.map(|mm| mm * frame.scale);
    if near <= least && most <= far {
        return (DepthRange::Metric { near, far }, vec![]);
    }
    let (near, far) = ((least - 1.0).max(LEAST_NEAR), most + 1.0);
    let note = format!(
        "the cameras are {least:.3} to {most:.3} radii of the object from it, not 360 to 1560 mm as those of DTU; depths from \
         {near:.3} to {far:.3} are a guess from that"
    );
    (DepthRange::Metric { near, far }, vec![note])
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
        let shared = |root: PathBuf| {
            let scan = root.file_name()?.to_string_lossy().into_owned();
            let above = root.ancestors().nth(2).filter(|p| p.file_name().is_some_and(|n| n == "rs_dtu_4"))?;
            Some((above.parent()?.to_path_buf(), scan))
        };
        // The path as it was given comes first: a scan may be a link to elsewhere.
        let full = [std::path::absolute(root), root.canonicalize()];
        Around { shared: full.into_iter().flatten().find_map(shared) }
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
