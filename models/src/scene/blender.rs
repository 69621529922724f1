//! Scenes rendered by Blender scripts in the layout of NeRF's synthetic set, and those of `raygrad make-scene`.
//!
//! `transforms_{train,val,test}.json` give one field of view and a camera-to-world matrix a frame; other intrinsics count as
//! in `transforms.json`. The world stays as it is; depths go from 2 to 6, which fits cameras about 4 away from the origin.

use super::camera::Cameras;
use super::picture::{DepthFile, image_size, is_image};
use super::{DepthRange, Entry, Listing, SceneError, WorldFrame, json};
use image::metadata::Orientation;
use serde::Deserialize;
use std::path::Path;

#[derive(Deserialize)]
struct File {
    /// Length of the depth files' unit.
    #[serde(default = "one")]
    depth_unit_scale_factor: f64,
    frames: Vec<Frame>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    depth_file_path: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
}

fn one() -> f64 {
    1.0
}

pub(super) fn lacks(root: &Path) -> Option<String> {
    (!root.join("transforms_train.json").is_file()).then(|| "no transforms_train.json".to_string())
}

pub(super) fn list(root: &Path) -> Result<Listing, SceneError> {
    let optional = |split: &str| match root.join(format!("transforms_{split}.json")).is_file() {
        true => entries(root, split).map(Some),
        false => Ok(None),
    };
    let (train, val, test) = (entries(root, "train")?, optional("val")?, optional("test")?);
    Ok(Listing {
        train,
        val,
        test: test.unwrap_or_default(),
        depth: DepthRange::Metric { near: 2.0, far: 6.0 },
        frame: WorldFrame::identity(),
        notes: vec![],
    })
}

fn entries(root: &Path, split: &str) -> Result<Vec<Entry>, SceneError> {
    let path = root.join(format!("transforms_{split}.json"));
    let file: File = json::read(&path)?;
    if split == "train" {
        json::check_frames(file.frames.len(), &path)?;
    }
    let cameras = Cameras::read(&path)?;
    let entry = |(i, frame): (usize, &Frame)| {
        let mut image = root.join(&frame.file_path);
        if !is_image(&image) && !image.exists() {
            image.as_mut_os_string().push(".png");
        }
        let size = image_size(&image, (&path, format!("frames[{i}].file_path")))?;
        let pose = json::pose_of_opengl(&frame.transform_matrix, &path, format!("frames[{i}].transform_matrix"))?;
        let depth = frame.depth_file_path.as_ref();
        Ok(Entry {
            name: frame.file_path.clone(),
            image,
            turn: Orientation::NoTransforms,
            mask: None,
            depth: depth.map(|d| DepthFile { path: root.join(d), unit: file.depth_unit_scale_factor }),
            intrinsics: cameras.intrinsics(i, size)?,
            pose: Some(pose),
        })
    };
    file.frames.iter().enumerate().map(entry).collect()
}
