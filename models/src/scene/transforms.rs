//! One `transforms.json` for all images, as instant-ngp and nerfstudio write it.
//!
//! Intrinsics (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, or `camera_angle_x`; `k1`, `k2`, `p1`, `p2`) stand at the top or in a
//! frame, where they win. Matrices are camera to world with OpenGL axes. The world is normalised, see `normalise`; nothing
//! is known of the depths, so they are inverse from half the least distance between a camera and what all look at. Every
//! eighth image is for testing, from the first on.

use super::camera::Cameras;
use super::normalise::normalise;
use super::picture::{DepthFile, image_size, is_image};
use super::{DepthRange, Entry, Listing, SceneError, enough_to_split, every, json};
use image::metadata::Orientation;
use serde::Deserialize;
use std::path::Path;

const FILE: &str = "transforms.json";

#[derive(Deserialize)]
struct File {
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
    let cameras = Cameras::read(&path)?;
    json::check_frames(file.frames.len(), &path)?;
    enough_to_split(root, file.frames.len())?;
    let mut entries = vec![];
    for (i, frame) in file.frames.iter().enumerate() {
        let mut image = root.join(&frame.file_path);
        if !is_image(&image) && !image.exists() {
            image.as_mut_os_string().push(".png");
        }
        let size = image_size(&image, (&path, format!("frames[{i}].file_path")))?;
        let intrinsics = cameras.intrinsics(i, size)?;
        let pose = json::pose_of_opengl(&frame.transform_matrix, &path, format!("frames[{i}].transform_matrix"))?;
        let depth = frame.depth_file_path.as_ref();
        entries.push(Entry {
            name: frame.file_path.clone(),
            image,
            turn: Orientation::NoTransforms,
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
