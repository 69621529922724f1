//! Poses for other programs: `transforms.json` (NeRF, instant-ngp, nerfstudio), COLMAP text, LLFF `poses_bounds.npy`.
//!
//! The poses are written in the frame and scale they come in: give poses aligned to the reference
//! ([`Similarity::align`](super::Similarity::align)) or those of the learned frame. A loader that recentres or flips
//! the world (LLFF's does) has to be undone by the caller first.

use super::align::{PoseSetError, check_poses};
use crate::geometry::Pose;
use crate::run::files::{WriteError, write_atomically};
use nalgebra::{Matrix3, UnitQuaternion};
use npyz::WriterBuilder;
use serde_json::json;
use std::fmt::Write;
use std::path::Path;

/// One camera as it is written out.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportCamera {
    /// The picture's file, seen from the folder that the cameras are written for.
    pub name: String,
    pub width: usize,
    pub height: usize,
    /// Focal lengths in pixels, along x and y.
    pub focal: [f64; 2],
    /// Principal point in pixels; the first pixel's centre is at (0.5, 0.5).
    pub principal: [f64; 2],
    /// k1, k2, p1, p2 of the picture's file, whose pinhole image the other numbers are of.
    pub distortion: Option<[f64; 4]>,
    /// World to camera.
    pub pose: Pose,
    /// Nearest and farthest depth seen, for LLFF.
    pub bounds: Option<[f64; 2]>,
}

/// Cameras that cannot be written in a format.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(transparent)]
    Poses(#[from] PoseSetError),
    #[error("camera {view} (`{name}`) cannot be exported: {problem}")]
    Camera { view: usize, name: String, problem: String },
    #[error(transparent)]
    Write(#[from] WriteError),
}

fn check(cameras: &[ExportCamera]) -> Result<(), ExportError> {
    let poses: Vec<Pose> = cameras.iter().map(|c| c.pose).collect();
    check_poses("exported", &poses)?;
    for (view, c) in cameras.iter().enumerate() {
        let refuse = |problem: &str| ExportError::Camera { view, name: c.name.clone(), problem: problem.to_string() };
        if c.width == 0 || c.height == 0 {
            return Err(refuse("its picture has no pixels"));
        }
        if !c.focal.iter().all(|f| f.is_finite() && *f > 0.0) || !c.principal.iter().all(|p| p.is_finite()) {
            return Err(refuse("its focal length or principal point is no positive, finite number"));
        }
    }
    Ok(())
}

/// Camera axes of OpenGL (x right, y up, z backward) in those used here (x right, y down, z forward), and back.
fn flip() -> Matrix3<f64> {
    Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)
}

/// `transforms.json`: camera to world with OpenGL's camera axes, focal lengths and principal point per frame, and those
/// of the first frame for the whole, with `camera_angle_x = 2 atan(w / (2 fl_x))`.
///
/// # Errors
/// If a camera is none.
pub fn transforms_json(cameras: &[ExportCamera]) -> Result<String, ExportError> {
    check(cameras)?;
    let lens = |c: &ExportCamera| {
        let [fx, fy] = c.focal;
        let mut lens = json!({
            "camera_angle_x": 2.0 * (c.width as f64 / (2.0 * fx)).atan(),
            "camera_angle_y": 2.0 * (c.height as f64 / (2.0 * fy)).atan(),
            "fl_x": fx, "fl_y": fy, "cx": c.principal[0], "cy": c.principal[1], "w": c.width, "h": c.height,
        });
        if let Some(distortion) = c.distortion {
            lens["camera_model"] = json!("OPENCV");
            for (key, k) in ["k1", "k2", "p1", "p2"].into_iter().zip(distortion) {
                lens[key] = json!(k);
            }
        }
        lens
    };
    let frame = |c: &ExportCamera| {
        let world = c.pose.inverse();
        let axes = world.rotation * flip();
        let row = |i: usize| json!([axes[(i, 0)], axes[(i, 1)], axes[(i, 2)], world.translation[i]]);
        let mut frame = lens(c);
        frame["file_path"] = json!(c.name);
        frame["transform_matrix"] = json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]);
        frame
    };
    let mut all = lens(&cameras[0]);
    all["frames"] = cameras.iter().map(frame).collect();
    // Numbers, strings and lists always have a JSON form.
    Ok(serde_json::to_string_pretty(&all).unwrap_or_default())
}

/// The three files of a COLMAP text model, which names images within the folder `images`. Poses are world to camera, as here; cameras are `PINHOLE`, or `OPENCV` with a distortion, one for all
/// pictures that share size and lens. There are no points: `points3D.txt` has a head only.
#[derive(Clone, Debug, PartialEq)]
pub struct Colmap {
    pub cameras: String,
    pub images: String,
    pub points: String,
}

impl Colmap {
    /// # Errors
    /// If a camera is none, or its name has a line break, which the format cannot hold.
    pub fn new(cameras: &[ExportCamera]) -> Result<Colmap, ExportError> {
        check(cameras)?;
        let mut lenses: Vec<&ExportCamera> = vec![];
        let mut out = Colmap {
            cameras: "# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".into(),
            images: "# Image list, two lines each: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; POINTS2D[]\n"
                .into(),
            points: "# 3D point list: POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n".into(),
        };
        for (view, c) in cameras.iter().enumerate() {
            if c.name.contains(['\n', '\r']) {
                let problem = "COLMAP's text format has no line breaks in names".to_string();
                return Err(ExportError::Camera { view, name: c.name.clone(), problem });
            }
            let same = |o: &&ExportCamera| {
                (o.width, o.height, o.focal, o.principal, o.distortion)
                    == (c.width, c.height, c.focal, c.principal, c.distortion)
            };
            let lens = lenses.iter().position(same).unwrap_or_else(|| {
                lenses.push(c);
                lenses.len() - 1
            });
            let q = UnitQuaternion::from_matrix(&c.pose.rotation);
            let t = c.pose.translation;
            // Writing to a string cannot fail.
            let _ = writeln!(
                out.images,
                "{} {} {} {} {} {} {} {} {} {}\n",
                view + 1,
                q.w,
                q.i,
                q.j,
                q.k,
                t.x,
                t.y,
                t.z,
                lens + 1,
                c.name.strip_prefix("images/").unwrap_or(&c.name)
            );
        }
        for (i, c) in lenses.iter().enumerate() {
            let ([fx, fy], [cx, cy]) = (c.focal, c.principal);
            let (model, rest) = match c.distortion {
                None => ("PINHOLE", String::new()),
                Some([k1, k2, p1, p2]) => ("OPENCV", format!(" {k1} {k2} {p1} {p2}")),
            };
            let _ = writeln!(out.cameras, "{} {model} {} {} {fx} {fy} {cx} {cy}{rest}", i + 1, c.width, c.height);
        }
        Ok(out)
    }

    /// Writes `cameras.txt`, `images.txt` and `points3D.txt` into a folder.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), WriteError> {
        let files = [("cameras.txt", &self.cameras), ("images.txt", &self.images), ("points3D.txt", &self.points)];
        files.iter().try_for_each(|(name, text)| write_atomically(&folder.join(name), text.as_bytes()))
    }
}

/// Share of a pixel that focal lengths or centres may differ by where a format has one number for both.
const LENS: f64 = 1e-3;

/// LLFF's `poses_bounds.npy`: per picture 17 doubles, the 3 x 5 matrix of the columns down, right, back, centre and
/// (height, width, focal) row by row, then the nearest and farthest depth.
///
/// # Errors
/// If a camera is none, has no bounds, two focal lengths, or a principal point off the middle of the picture: the
/// format has no place for those.
pub fn poses_bounds(cameras: &[ExportCamera]) -> Result<Vec<u8>, ExportError> {
    check(cameras)?;
    let mut numbers: Vec<f64> = Vec::with_capacity(17 * cameras.len());
    for (view, c) in cameras.iter().enumerate() {
        let refuse = |problem: String| ExportError::Camera { view, name: c.name.clone(), problem };
        let ([fx, fy], [cx, cy], [w, h]) = (c.focal, c.principal, [c.width as f64, c.height as f64]);
        if (fx - fy).abs() > LENS {
            return Err(refuse(format!("LLFF's format has one focal length, and these are {fx} and {fy}")));
        }
        if (cx - w / 2.0).abs() > LENS || (cy - h / 2.0).abs() > LENS {
            return Err(refuse(format!(
                "LLFF's format has the principal point in the middle, and this is ({cx}, {cy})"
            )));
        }
        if c.distortion.is_some() {
            return Err(refuse("LLFF's format has no lens distortion, and its picture's file has one".to_string()));
        }
        let bounds = c.bounds.filter(|[near, far]| 0.0 < *near && near <= far && far.is_finite());
        let [near, far] =
            bounds.ok_or_else(|| refuse("it has no near and far depth, which LLFF's format asks for".into()))?;
        let world = c.pose.inverse();
        let (axes, center) = (world.rotation, world.translation);
        for (i, last) in [h, w, fx].into_iter().enumerate() {
            numbers.extend([axes[(i, 1)], axes[(i, 0)], -axes[(i, 2)], center[i], last]);
        }
        numbers.extend([near, far]);
    }
    let mut bytes = vec![];
    let shape = [cameras.len() as u64, 17];
    // Writing to memory cannot fail, and the shape is that of the numbers.
    let written =
        npyz::WriteOptions::new().default_dtype().shape(&shape).writer(&mut bytes).begin_nd().and_then(|mut w| {
            w.extend(numbers)?;
            w.finish()
        });
    written.map_err(|source| WriteError { path: "poses_bounds.npy".into(), source })?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Quaternion, Vector3};

    fn cameras() -> Vec<ExportCamera> {
        let camera = |i: usize| ExportCamera {
            name: format!("images/IMG {i}.JPG"),
            width: 640,
            height: 480,
            focal: [500.25, 500.25],
            principal: [320.0, 240.0],
            distortion: None,
            pose: Pose::exp(&[0.3 * i as f64, -0.2, 1.0 + i as f64, 0.5, -1.0, 2.0]),
            bounds: Some([1.5, 20.0 + i as f64]),
        };
        (0..4).map(camera).collect()
    }

    fn assert_near(found: &Pose, expected: &Pose) {
        let pairs = found.to_rows().into_iter().zip(expected.to_rows());
        assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-12), "{found:?} instead of {expected:?}");
    }

    /// Reads as section 1.6 of the specification does: R = F R_c^T, t = -F R_c^T t_c.
    #[test]
    fn transforms_read_back_are_the_poses() {
        let mut cameras = cameras();
        cameras[1].distortion = Some([0.1, -0.2, 0.0, 0.003]);
        let json: serde_json::Value = serde_json::from_str(&transforms_json(&cameras).unwrap()).unwrap();
        let frame = |i: usize| &json["frames"][i];
        assert_eq!([&frame(1)["k2"], &frame(1)["p2"], &frame(0)["k2"]], [&json!(-0.2), &json!(0.003), &json!(null)]);
        let focal = 0.5 * 640.0 / (0.5 * json["camera_angle_x"].as_f64().unwrap()).tan();
        assert!((focal - 500.25).abs() < 1e-9 && json["fl_y"] == 500.25 && json["h"] == 480);
        for (frame, camera) in json["frames"].as_array().unwrap().iter().zip(&cameras) {
            let at = |i: usize, j: usize| frame["transform_matrix"][i][j].as_f64().unwrap();
            let (r, t) = (Matrix3::from_fn(at), Vector3::from_fn(|i, _| at(i, 3)));
            let rotation = flip() * r.transpose();
            assert_near(&Pose { rotation, translation: -(rotation * t) }, &camera.pose);
            assert_eq!((frame["file_path"].as_str().unwrap(), at(3, 3)), (camera.name.as_str(), 1.0));
        }
    }

    #[test]
    fn colmap_read_back_is_the_poses() {
        let mut cameras = cameras();
        cameras[2].focal = [400.0, 410.0];
        cameras[3].distortion = Some([0.1, -0.2, 0.0, 0.003]);
        let model = Colmap::new(&cameras).unwrap();
        let dir = tempfile::tempdir().unwrap();
        model.write(dir.path()).unwrap();
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        let images = read("images.txt");
        let body: Vec<&str> = images.lines().filter(|l| !l.starts_with('#')).collect();
        // Every image has a second line for its points, which is empty.
        assert_eq!(body.len(), 2 * cameras.len());
        let lenses: Vec<String> = read("cameras.txt").lines().filter(|l| !l.starts_with('#')).map(Into::into).collect();
        assert_eq!(
            lenses,
            [
                "1 PINHOLE 640 480 500.25 500.25 320 240",
                "2 PINHOLE 640 480 400 410 320 240",
                "3 OPENCV 640 480 500.25 500.25 320 240 0.1 -0.2 0 0.003"
            ]
        );
        for (i, camera) in cameras.iter().enumerate() {
            assert_eq!(body[2 * i + 1], "");
            let fields: Vec<&str> = body[2 * i].splitn(10, ' ').collect();
            let x: Vec<f64> = fields[..8].iter().map(|f| f.parse().unwrap()).collect();
            let q = UnitQuaternion::from_quaternion(Quaternion::new(x[1], x[2], x[3], x[4]));
            let rotation = q.to_rotation_matrix().into_inner();
            assert_near(&Pose { rotation, translation: Vector3::new(x[5], x[6], x[7]) }, &camera.pose);
            assert_eq!((fields[8], fields[9]), (["1", "1", "2", "3"][i], &camera.name["images/".len()..]));
        }
        assert!(read("points3D.txt").lines().all(|l| l.starts_with('#')));
    }

    /// Reads as sections 1.7 and 12 of the specification do, without scale and recentring.
    #[test]
    fn poses_bounds_read_back_are_the_poses() {
        let cameras = cameras();
        let bytes = poses_bounds(&cameras).unwrap();
        let file = npyz::NpyFile::new(&bytes[..]).unwrap();
        assert_eq!(file.shape(), [4, 17]);
        let numbers: Vec<f64> = file.into_vec().unwrap();
        for (row, camera) in numbers.chunks(17).zip(&cameras) {
            let column = |j: usize| Vector3::from_fn(|i, _| row[5 * i + j]);
            // (down, right, back) to (right, up, back), camera to world, then to x right, y down, z forward.
            let axes = Matrix3::from_columns(&[column(1), -column(0), column(2)]) * flip();
            let rotation = axes.transpose();
            assert_near(&Pose { rotation, translation: -(rotation * column(3)) }, &camera.pose);
            assert_eq!((column(4), &row[15..]), (Vector3::new(480.0, 640.0, 500.25), &camera.bounds.unwrap()[..]));
        }
    }

    #[test]
    fn cameras_that_do_not_fit_a_format_are_refused() {
        let with = |change: fn(&mut ExportCamera)| {
            let mut cameras = cameras();
            change(&mut cameras[1]);
            cameras
        };
        let llff = |change| poses_bounds(&with(change)).unwrap_err().to_string();
        assert!(llff(|c| c.focal[1] = 400.0).contains("camera 1 (`images/IMG 1.JPG`)"));
        assert!(llff(|c| c.principal[0] = 300.0).contains("principal point"));
        assert!(llff(|c| c.bounds = None).contains("near and far"));
        assert!(llff(|c| c.distortion = Some([0.1, 0.0, 0.0, 0.0])).contains("no lens distortion"));
        assert!(llff(|c| c.pose.translation.x = f64::NAN).contains("exported pose 1"));
        assert!(transforms_json(&[]).is_err());
        assert!(transforms_json(&with(|c| c.focal[0] = 0.0)).is_err());
        assert!(Colmap::new(&with(|c| c.name = "a\nb".into())).unwrap_err().to_string().contains("line breaks"));
    }
}
