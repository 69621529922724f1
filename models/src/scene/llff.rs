//! Forward-facing captures of LLFF: `poses_bounds.npy` and the folders `images`, `images_2`, `images_4`, `images_8`.
//!
//! A row of the file holds a 3 x 5 matrix (columns down, right, back, centre, then height, width, focal length) and the
//! nearest and farthest depth. The world is scaled so that the nearest depth of all is 1 / 0.75, and turned and moved so
//! that the average camera is the identity; depths are then inverse, from 1 on. Rows are in the plain order of the images'
//! names: 10.png before 2.png. The last tenth is for testing.

use super::check::resized;
use super::frame::nearest_rotation;
use super::json::{FLIP, opengl};
use super::numpy::{self, NumpyArray};
use super::picture::{file_name, image_size, images_in};
use super::{DepthRange, Entry, Intrinsics, Listing, LoadOptions, Pose, SceneError, WorldFrame};
use super::{check_pose, enough_to_split, last_tenth};
use image::metadata::Orientation;
use nalgebra::{Matrix3, Vector3};
use std::path::{Path, PathBuf};

const FILE: &str = "poses_bounds.npy";

pub(super) fn lacks(root: &Path) -> Option<String> {
    (!root.join(FILE).is_file()).then(|| format!("no {FILE}"))
}

pub(super) fn list(root: &Path, options: &LoadOptions) -> Result<Listing, SceneError> {
    let path = root.join(FILE);
    let cameras = Cameras::of(&numpy::read(&path)?, &path)?;
    let folder = image_folder(root)?;
    let images = images_in(&folder)?;
    if images.len() != cameras.poses.len() {
        let (rows, found) = (cameras.poses.len(), images.len());
        let message = format!("has {rows} cameras, but {} has {found} images", folder.display());
        return Err(SceneError::Format { path, message });
    }
    enough_to_split(root, images.len())?;
    let frame = recentring(&cameras, options.published_rotations);
    let mut entries = vec![];
    for (i, (image, pose)) in images.into_iter().zip(&cameras.poses).enumerate() {
        let size = image_size(&image, (&path, format!("row {i}")))?;
        let camera = || format!("row {i}, height and width for {}", file_name(&image));
        let intrinsics = resized(&cameras.intrinsics, size, &path, camera)?;
        entries.push(Entry {
            name: file_name(&image),
            image,
            turn: Orientation::NoTransforms,
            mask: None,
            depth: None,
            intrinsics,
            pose: Some(*pose),
        });
    }
    let (train, test) = last_tenth(entries);
    Ok(Listing { train, val: None, test, depth: DepthRange::Inverse { near: 1.0 }, frame, notes: vec![] })
}

/// The folder of images in full resolution, else the largest.
fn image_folder(root: &Path) -> Result<PathBuf, SceneError> {
    for name in ["images", "images_2", "images_4", "images_8"] {
        let folder = root.join(name);
        if folder.is_dir() && !images_in(&folder)?.is_empty() {
            return Ok(folder);
        }
    }
    let source = std::io::Error::new(std::io::ErrorKind::NotFound, "no PNG or JPEG images in it");
    Err(SceneError::Read { path: root.join("images"), source })
}

/// What the file says.
struct Cameras {
    /// For the size that the file gives.
    intrinsics: Intrinsics,
    poses: Vec<Pose>,
    /// The smallest of all bounds.
    nearest: f64,
}

impl Cameras {
    fn of(array: &NumpyArray, path: &Path) -> Result<Cameras, SceneError> {
        let refuse = |i: usize, field: &str, expected: &str, found: String| {
            let field = format!("row {i}, {field}");
            Err(SceneError::Field { path: path.into(), field, expected: expected.into(), found })
        };
        if array.shape.len() != 2 || array.shape[1] != 17 || array.shape[0] == 0 {
            return Err(array.refuse(path, "rows of 17 numbers"));
        }
        let rows = array.values.as_chunks::<17>().0;
        let mut poses = vec![];
        for (i, row) in rows.iter().enumerate() {
            let column = |j: usize| Vector3::from_fn(|r, _| row[5 * r + j]);
            let rotation = Matrix3::from_columns(&[column(1), -column(0), column(2)]);
            poses.push(check_pose(opengl(&rotation, &column(3)), path, || format!("row {i}"))?);
            let [near, far] = [row[15], row[16]];
            if !(near > 0.0 && near < far && far.is_finite()) {
                return refuse(i, "bounds", "0 < near < far", format!("near {near}, far {far}"));
            }
        }
        let [height, width, focal] = [rows[0][4], rows[0][9], rows[0][14]];
        if ![height, width, focal].iter().all(|x| (1.0..1e6).contains(x)) {
            let found = format!("{height}, {width}, {focal}");
            return refuse(0, "height, width, focal length", "numbers of pixels", found);
        }
        let (cx, cy) = (width / 2.0, height / 2.0);
        let (height, width) = (height as usize, width as usize);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx, cy, height, width, distortion: None };
        let nearest = rows.iter().flat_map(|r| [r[15], r[16]]).fold(f64::INFINITY, f64::min);
        Ok(Cameras { intrinsics, poses, nearest })
    }
}

/// Scales by the nearest bound and makes the average camera the identity.
fn recentring(cameras: &Cameras, published: bool) -> WorldFrame {
    let scale = 1.0 / (0.75 * cameras.nearest);
    average_camera(&cameras.poses, scale, published)
}

/// The world in which the average camera of `poses` is the identity, after scaling. The average up direction is not
/// orthogonal to the average view direction, nor is their cross product of length 1; published loaders leave that so.
pub(super) fn average_camera(poses: &[Pose], scale: f64, published: bool) -> WorldFrame {
    let n = poses.len() as f64;
    let mean = |f: &dyn Fn(&Pose) -> Vector3<f64>| poses.iter().map(f).sum::<Vector3<f64>>() / n;
    // Rows of R are the camera's axes in the world: right, down, forward.
    // Directions that cancel each other out have no average: the first camera's count then.
    let axis = |i: usize| {
        let along = |p: &Pose| -p.rotation.row(i).transpose();
        mean(&along).try_normalize(1e-9).or_else(|| poses.first().map(along)).unwrap_or_else(Vector3::zeros)
    };
    let (up, back) = (axis(1), axis(2));
    let average = Matrix3::from_columns(&[up.cross(&back), up, back]);
    let average = if published { average } else { nearest_rotation(&average) };
    let linear = FLIP * average.transpose();
    WorldFrame { linear, scale, offset: -(linear * mean(&|p| p.center()) * scale) }
}
