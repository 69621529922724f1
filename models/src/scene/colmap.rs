//! A model of COLMAP, binary or text (`cameras`, `images`, `points3D` in `sparse/0`, `sparse` or `colmap/sparse/0`), and the
//! folder `images`.
//!
//! COLMAP's poses are world to camera with the axes used here, and its pixel centres lie at halves. The world is normalised,
//! see `normalise`, with depths from the points that the images see; they are inverse, from 3/4 of the nearest on. Every
//! eighth image in the order of names is for testing, from the first on.

use super::check::resized;
use super::normalise::normalise;
use super::picture::image_size;
use super::{DepthRange, Entry, Intrinsics, Listing, Pose, SceneError, check_pose, enough_to_split, every};
use image::metadata::Orientation;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Of all depths seen, this share counts as outliers in front.
const OUTLIERS: f64 = 0.01;

pub(super) fn lacks(root: &Path) -> Option<String> {
    match model(root) {
        None => Some("no sparse/0/cameras.bin or .txt".to_string()),
        Some(_) => (!root.join("images").is_dir()).then(|| "no folder `images`".to_string()),
    }
}

/// The folder of the model and whether it is binary.
fn model(root: &Path) -> Option<(PathBuf, bool)> {
    model_of(["sparse/0", "sparse", "colmap/sparse/0"].map(|f| root.join(f)))
}

fn model_of(folders: impl IntoIterator<Item = PathBuf>) -> Option<(PathBuf, bool)> {
    folders.into_iter().find_map(|folder| {
        let has = |extension: &str| folder.join(format!("cameras.{extension}")).is_file();
        if has("bin") { Some((folder, true)) } else { has("txt").then_some((folder, false)) }
    })
}

/// The poses of a model in this folder or in those of a scene, by the names of images.
pub(super) fn poses(folder: &Path) -> Result<Vec<(String, Pose)>, SceneError> {
    let Some((found, binary)) = model_of([folder.into()]).or_else(|| model(folder)) else {
        let message = "no model of COLMAP: neither cameras.bin nor cameras.txt".to_string();
        return Err(SceneError::Format { path: folder.into(), message });
    };
    let file = found.join(if binary { "images.bin" } else { "images.txt" });
    let images = if binary { binary_images(&file)? } else { text_images(&file)? };
    let checked = |image: Image| {
        let pose = check_pose(image.pose, &file, || format!("image {}", image.name))?;
        Ok((image.name, pose))
    };
    images.into_iter().map(checked).collect()
}

pub(super) fn list(root: &Path) -> Result<Listing, SceneError> {
    let Some((folder, binary)) = model(root) else {
        return Err(SceneError::NotAScene { root: root.into(), tried: vec![] });
    };
    let extension = if binary { "bin" } else { "txt" };
    let file = |name: &str| folder.join(format!("{name}.{extension}"));
    let images_file = file("images");
    let (cameras, mut images, points) = if binary {
        (binary_cameras(&file("cameras"))?, binary_images(&images_file)?, binary_points(&file("points3D"))?)
    } else {
        (text_cameras(&file("cameras"))?, text_images(&images_file)?, text_points(&file("points3D"))?)
    };
    enough_to_split(root, images.len())?;
    let nearest = nearest_depth(&images, &points);
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let mut entries = vec![];
    for image in &images {
        let field = format!("image {}", image.name);
        let Some(camera) = cameras.get(&image.camera) else {
            let (expected, found) = (format!("a camera of {}", file("cameras").display()), image.camera.to_string());
            return Err(SceneError::Field { path: images_file, field, expected, found });
        };
        let pose = check_pose(image.pose, &images_file, || field.clone())?;
        let path = root.join("images").join(&image.name);
        let size = image_size(&path, (&images_file, field))?;
        let intrinsics =
            resized(camera, size, &images_file, || format!("camera {} of image {}", image.camera, image.name))?;
        let name = image.name.clone();
        entries.push(Entry {
            name,
            image: path,
            turn: Orientation::NoTransforms,
            mask: None,
            depth: None,
            intrinsics,
            pose: Some(pose),
        });
    }
    let poses: Vec<Pose> = images.iter().map(|i| i.pose).collect();
    let (frame, near) = normalise(&poses, nearest);
    let (train, test) = every(8, entries);
    Ok(Listing { train, val: None, test, depth: DepthRange::Inverse { near }, frame, notes: vec![] })
}

struct Image {
    id: u32,
    camera: u32,
    name: String,
    pose: Pose,
}

/// A point and the images that see it.
struct Point {
    at: Vector3<f64>,
    seen_by: Vec<u32>,
}

fn nearest_depth(images: &[Image], points: &[Point]) -> Option<f64> {
    let poses: BTreeMap<u32, &Pose> = images.iter().map(|i| (i.id, &i.pose)).collect();
    let seen = points.iter().flat_map(|p| p.seen_by.iter().filter_map(|id| Some(poses.get(id)?.apply(&p.at).z)));
    let mut depths: Vec<f64> = seen.filter(|z| *z > 0.0 && z.is_finite()).collect();
    depths.sort_by(f64::total_cmp);
    depths.get((OUTLIERS * depths.len() as f64) as usize).copied()
}

/// Names and numbers of parameters of the camera models, by COLMAP's number.
const MODELS: [(&str, usize); 5] =
    [("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)];

/// The models that are not read, in the order of COLMAP's numbers, which go on from [`MODELS`].
const OTHER_MODELS: [&str; 7] = [
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
];

fn other_model(number: usize) -> &'static str {
    OTHER_MODELS.get(number - MODELS.len()).copied().unwrap_or("of an unknown number")
}

fn intrinsics(model: &str, [height, width]: [usize; 2], p: &[f64]) -> Option<Intrinsics> {
    let (fx, fy, cx, cy, distortion) = match (model, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => (f, f, cx, cy, None),
        ("PINHOLE", &[fx, fy, cx, cy]) => (fx, fy, cx, cy, None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => (f, f, cx, cy, Some([k, 0.0, 0.0, 0.0])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => (f, f, cx, cy, Some([k1, k2, 0.0, 0.0])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => (fx, fy, cx, cy, Some([k1, k2, p1, p2])),
        _ => return None,
    };
    let usable = height > 0 && width > 0 && fx > 0.0 && fy > 0.0 && p.iter().all(|x| x.is_finite());
    usable.then_some(Intrinsics { fx, fy, cx, cy, height, width, distortion })
}

fn bad_camera(path: &Path, id: u32, model: &str) -> SceneError {
    let known: Vec<&str> = MODELS.iter().map(|m| m.0).collect();
    SceneError::Field {
        path: path.into(),
        field: format!("camera {id}"),
        expected: format!("a camera of finite numbers, its model one of {}", known.join(", ")),
        found: format!("an unusable camera of model {model}"),
    }
}

fn pose([w, x, y, z]: [f64; 4], t: [f64; 3]) -> Pose {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix().into_inner();
    Pose { rotation, translation: Vector3::from(t) }
}

/// A binary file, little-endian.
struct Binary<'a> {
    path: &'a Path,
    bytes: Vec<u8>,
    at: usize,
}

impl<'a> Binary<'a> {
    fn open(path: &'a Path) -> Result<Binary<'a>, SceneError> {
        let bytes = std::fs::read(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
        Ok(Binary { path, bytes, at: 0 })
    }

    fn short(&self) -> SceneError {
        let message = format!("ends in the middle of an entry, after {} bytes", self.bytes.len());
        SceneError::Format { path: self.path.into(), message }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], SceneError> {
        let bytes = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk::<N>()).ok_or_else(|| self.short())?;
        self.at += N;
        Ok(*bytes)
    }

    fn skip(&mut self, count: u64, size: u64) -> Result<(), SceneError> {
        let end = count.checked_mul(size).and_then(|n| n.checked_add(self.at as u64));
        match end.filter(|e| *e <= self.bytes.len() as u64) {
            Some(end) => self.at = end as usize,
            None => return Err(self.short()),
        }
        Ok(())
    }

    fn u32(&mut self) -> Result<u32, SceneError> {
        Ok(u32::from_le_bytes(self.take()?))
    }
    fn u64(&mut self) -> Result<u64, SceneError> {
        Ok(u64::from_le_bytes(self.take()?))
    }
    fn floats<const N: usize>(&mut self) -> Result<[f64; N], SceneError> {
        let mut all = [0.0; N];
        for x in &mut all {
            *x = f64::from_le_bytes(self.take()?);
        }
        Ok(all)
    }
    /// Up to a zero byte.
    fn text(&mut self) -> Result<String, SceneError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|b| *b == 0).ok_or_else(|| self.short())?;
        let text = String::from_utf8_lossy(&rest[..length]).into_owned();
        self.at += length + 1;
        Ok(text)
    }
}

fn binary_cameras(path: &Path) -> Result<BTreeMap<u32, Intrinsics>, SceneError> {
    let mut file = Binary::open(path)?;
    let mut cameras = BTreeMap::new();
    for _ in 0..file.u64()? {
        let (id, model) = (file.u32()?, file.u32()? as usize);
        let (width, height) = (file.u64()? as usize, file.u64()? as usize);
        let Some((name, count)) = MODELS.get(model) else { return Err(bad_camera(path, id, other_model(model))) };
        let mut parameters = vec![];
        for _ in 0..*count {
            parameters.extend(file.floats::<1>()?);
        }
        let camera = intrinsics(name, [height, width], &parameters).ok_or_else(|| bad_camera(path, id, name))?;
        cameras.insert(id, camera);
    }
    Ok(cameras)
}

fn binary_images(path: &Path) -> Result<Vec<Image>, SceneError> {
    let mut file = Binary::open(path)?;
    let mut images = vec![];
    for _ in 0..file.u64()? {
        let id = file.u32()?;
        let (q, t) = (file.floats()?, file.floats()?);
        let (camera, name) = (file.u32()?, file.text()?);
        // Observations: x, y, number of the point.
        let observations = file.u64()?;
        file.skip(observations, 24)?;
        images.push(Image { id, camera, name, pose: pose(q, t) });
    }
    Ok(images)
}

fn binary_points(path: &Path) -> Result<Vec<Point>, SceneError> {
    let mut file = Binary::open(path)?;
    let mut points = vec![];
    for _ in 0..file.u64()? {
        file.u64()?;
        let at = Vector3::from(file.floats::<3>()?);
        // Colour and error.
        file.skip(1, 3 + 8)?;
        let mut seen_by = vec![];
        for _ in 0..file.u64()? {
            seen_by.push(file.u32()?);
            file.u32()?;
        }
        points.push(Point { at, seen_by });
    }
    Ok(points)
}

/// Lines of a text file with their numbers, comments left out.
fn lines(path: &Path) -> Result<Vec<(usize, String)>, SceneError> {
    let text = std::fs::read_to_string(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    let numbered = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim().to_string()));
    Ok(numbered.filter(|(_, line)| !line.starts_with('#')).collect())
}

/// Fields of a line, read one after the other.
struct Fields<'a> {
    path: &'a Path,
    line: usize,
    rest: std::str::SplitWhitespace<'a>,
}

impl<'a> Fields<'a> {
    fn next<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, SceneError> {
        let found = self.rest.next();
        found.and_then(|f| f.parse().ok()).ok_or_else(|| SceneError::Field {
            path: self.path.into(),
            field: format!("line {}, {what}", self.line),
            expected: "a value".into(),
            found: found.unwrap_or("the end of the line").into(),
        })
    }
    fn floats<const N: usize>(&mut self, what: &str) -> Result<[f64; N], SceneError> {
        let mut all = [0.0; N];
        for x in &mut all {
            *x = self.next(what)?;
        }
        Ok(all)
    }
}

fn fields<'a>(path: &'a Path, (line, text): &'a (usize, String)) -> Fields<'a> {
    Fields { path, line: *line, rest: text.split_whitespace() }
}

fn text_cameras(path: &Path) -> Result<BTreeMap<u32, Intrinsics>, SceneError> {
    let mut cameras = BTreeMap::new();
    for line in lines(path)?.iter().filter(|l| !l.1.is_empty()) {
        let mut fields = fields(path, line);
        let (id, model): (u32, String) = (fields.next("camera")?, fields.next("model")?);
        let (width, height): (usize, usize) = (fields.next("width")?, fields.next("height")?);
        let parameters: Option<Vec<f64>> = fields.rest.map(|p| p.parse().ok()).collect();
        let camera = parameters.and_then(|p| intrinsics(&model, [height, width], &p));
        cameras.insert(id, camera.ok_or_else(|| bad_camera(path, id, &model))?);
    }
    Ok(cameras)
}

/// Two lines an image, the second its observations. That may be empty, and some writers leave empty lines out.
fn text_images(path: &Path) -> Result<Vec<Image>, SceneError> {
    let mut images = vec![];
    let lines = lines(path)?;
    let mut rest = lines.iter().filter(|l| !l.1.is_empty()).peekable();
    while let Some(line) = rest.next() {
        let mut fields = fields(path, line);
        let id = fields.next("image")?;
        let (q, t) = (fields.floats("quaternion")?, fields.floats("translation")?);
        let camera = fields.next("camera")?;
        let first: String = fields.next("name")?;
        let name = std::iter::once(first.as_str()).chain(fields.rest).collect::<Vec<_>>().join(" ");
        images.push(Image { id, camera, name, pose: pose(q, t) });
        rest.next_if(|l| observations(&l.1));
    }
    Ok(images)
}

/// Whether a line is x, y and a point's number, any number of times.
fn observations(line: &str) -> bool {
    let fields: Vec<&str> = line.split_whitespace().collect();
    fields.len().is_multiple_of(3) && fields.iter().all(|f| f.parse::<f64>().is_ok())
}

fn text_points(path: &Path) -> Result<Vec<Point>, SceneError> {
    let mut points = vec![];
    for line in lines(path)?.iter().filter(|l| !l.1.is_empty()) {
        let mut fields = fields(path, line);
        let _id: u64 = fields.next("point")?;
        let at = Vector3::from(fields.floats::<3>("position")?);
        let _color: [f64; 3] = fields.floats("colour")?;
        let _error: f64 = fields.next("error")?;
        let seen_by = fields.rest.step_by(2).filter_map(|id| id.parse().ok()).collect();
        points.push(Point { at, seen_by });
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The file `cameras.bin` of one camera of this model, of 8 x 6 pixels.
    fn camera(model: u32) -> Vec<u8> {
        let numbers = [50.0_f64, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0].map(f64::to_le_bytes).concat();
        [
            &1_u64.to_le_bytes()[..],
            &7_u32.to_le_bytes(),
            &model.to_le_bytes(),
            &8_u64.to_le_bytes(),
            &6_u64.to_le_bytes(),
        ]
        .concat()
        .into_iter()
        .chain(numbers)
        .collect()
    }

    #[test]
    fn models_of_binary_files() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cameras.bin");
        let read = |model| {
            std::fs::write(&path, camera(model)).unwrap();
            binary_cameras(&path).map(|all| all[&7].fx).map_err(|e| e.to_string())
        };
        assert_eq!(read(0), Ok(50.0));
        let error = read(5).unwrap_err();
        assert!(error.contains("cameras.bin") && error.contains("camera 7"), "{error}");
        assert!(error.contains("model OPENCV_FISHEYE"), "{error}");
        assert!(read(99).unwrap_err().contains("unknown number"));
    }
}
