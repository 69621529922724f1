//! One `transforms.json` for all images, as instant-ngp and nerfstudio write it.
//!
//! Intrinsics (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, or `camera_angle_x`; `k1`, `k2`, `p1`, `p2`) stand at the top or in a
//! frame, where they win. Matrices are camera to world with OpenGL axes. The world is normalised, see `normalise`; nothing
//! is known of the depths, so they are inverse from half the least distance between a camera and what all look at. Every
//! eighth image is for testing, from the first on.

use super::normalise::normalise;
use super::picture::{DepthFile, image_size};
use super::{DepthRange, Entry, Intrinsics, Listing, SceneError, enough_to_split, every, json};
use serde::Deserialize;
use std::path::Path;

const FILE: &str = "transforms.json";

#[derive(Clone, Copy, Deserialize)]
struct Camera {
    camera_angle_x: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
struct File {
    #[serde(flatten)]
    camera: Camera,
    camera_model: Option<String>,
    /// Length of the depth files' unit; nerfstudio's are millimetres.
    #[serde(default = "millimetre")]
    depth_unit_scale_factor: f64,
    frames: Vec<Frame>,
}

fn millimetre() -> f64 {
    1e-3
}

#[derive(Deserialize)]
struct Frame {
    #[serde(flatten)]
    camera: Camera,
    file_path: String,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
}

pub(super) fn lacks(root: &Path) -> Option<String> {
    (!root.join(FILE).is_file()).then(|| format!("no {FILE}"))
}

pub(super) fn list(root: &Path) -> Result<Listing, SceneError> {
    let path = root.join(FILE);
    let file: File = json::read(&path)?;
    if let Some(model) = file.camera_model.as_deref().filter(|m| !KNOWN.contains(m)) {
        return Err(SceneError::Field {
            path,
            field: "camera_model".into(),
            expected: format!("one of {}", KNOWN.join(", ")),
            found: model.into(),
        });
    }
    enough_to_split(root, file.frames.len())?;
    let mut entries = vec![];
    for (i, frame) in file.frames.iter().enumerate() {
        let mut image = root.join(&frame.file_path);
        if image.extension().is_none() {
            image.as_mut_os_string().push(".png");
        }
        let size = image_size(&image, (&path, format!("frames[{i}].file_path")))?;
        let intrinsics = frame.camera.or(&file.camera).intrinsics(size, &path)?;
        let pose = json::pose_of_opengl(&frame.transform_matrix, &path, format!("frames[{i}].transform_matrix"))?;
        let depth = frame.depth_file_path.as_ref();
        entries.push(Entry {
            name: frame.file_path.clone(),
            image,
            mask: frame.mask_path.as_ref().map(|m| root.join(m)),
            depth: depth.map(|d| DepthFile { path: root.join(d), unit: file.depth_unit_scale_factor }),
            intrinsics,
            pose: Some(pose),
        });
    }
    // Some writers list images in no order; every eighth of the sorted ones is spread evenly over a sequence.
    entries.sort_by(|a, b| a.name.cmp(&b.name));
    let poses: Vec<_> = entries.iter().filter_map(|e| e.pose).collect();
    let (frame, near) = normalise(&poses, None);
    let (train, test) = every(8, entries);
    let notes = vec!["no depths are known; the near plane is a guess from the cameras".to_string()];
    Ok(Listing { train, val: None, test, depth: DepthRange::Inverse { near }, frame, notes })
}

const KNOWN: [&str; 6] = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "perspective"];

impl Camera {
    /// What a frame says, else what the file says.
    fn or(&self, file: &Camera) -> Camera {
        Camera {
            camera_angle_x: self.camera_angle_x.or(file.camera_angle_x),
            fl_x: self.fl_x.or(file.fl_x),
            fl_y: self.fl_y.or(file.fl_y),
            cx: self.cx.or(file.cx),
            cy: self.cy.or(file.cy),
            w: self.w.or(file.w),
            h: self.h.or(file.h),
            k1: self.k1.or(file.k1),
            k2: self.k2.or(file.k2),
            k3: self.k3.or(file.k3),
            k4: self.k4.or(file.k4),
            p1: self.p1.or(file.p1),
            p2: self.p2.or(file.p2),
        }
    }

    /// The camera for an image of a size, which may differ from the size that the file speaks of.
    fn intrinsics(&self, [height, width]: [usize; 2], path: &Path) -> Result<Intrinsics, SceneError> {
        let refuse = |field: &str, expected: &str, found: String| {
            Err(SceneError::Field { path: path.into(), field: field.into(), expected: expected.into(), found })
        };
        let (w, h) = (self.w.unwrap_or(width as f64), self.h.unwrap_or(height as f64));
        for (field, value) in [("w", w), ("h", h)] {
            if !(1.0..1e6).contains(&value) {
                return refuse(field, "a number of pixels", value.to_string());
            }
        }
        let by_angle = self.camera_angle_x.map(|a| 0.5 * w / (0.5 * a).tan());
        let Some(fx) = self.fl_x.or(by_angle) else {
            return refuse("fl_x", "a focal length in pixels, or `camera_angle_x`", "neither".into());
        };
        let fy = self.fl_y.unwrap_or(fx);
        for (field, value) in [("fl_x", fx), ("fl_y", fy)] {
            if !(value > 0.0 && value.is_finite()) {
                return refuse(field, "a positive focal length", value.to_string());
            }
        }
        for (field, value) in [("k3", self.k3), ("k4", self.k4)] {
            if let Some(k) = value.filter(|k| *k != 0.0) {
                return refuse(field, "0, the model having k1, k2, p1 and p2 only", k.to_string());
            }
        }
        let distortion = [self.k1, self.k2, self.p1, self.p2].map(Option::unwrap_or_default);
        let camera = Intrinsics {
            fx,
            fy,
            cx: self.cx.unwrap_or(w / 2.0),
            cy: self.cy.unwrap_or(h / 2.0),
            height: h as usize,
            width: w as usize,
            distortion: Some(distortion).filter(|d| d.iter().any(|k| *k != 0.0)),
        };
        Ok(camera.resized(height, width))
    }
}
