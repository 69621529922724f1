//! The cameras that a run found, as other programs take them.

use super::data::SpaceDataError;
use super::explorer::Explorer;
use crate::Error;
use crate::evaluation::ExportCamera;
use crate::scene::DepthRange;
use std::path::Path;

/// The near plane of scenes with inverse depth lies at this part of the nearest depth seen.
const NEAR_PART: f64 = 0.75;
/// What is written for the farthest depth of those, in nearest ones: their depths have no end.
const FAR: f64 = 100.0;

impl Explorer {
    /// The training cameras at the poses found, aligned with the true ones, in the world and unit of the scene's files; for
    /// images of the files' own size.
    pub fn cameras(&mut self) -> Result<Vec<ExportCamera>, Error> {
        let (found, refined) = (self.poses()?, self.found_lens()?);
        let aligned = self.data.similarity(&found).map_err(SpaceDataError::from)?.align(&found);
        let scene = &self.data.scene;
        let bounds = match scene.depth {
            DepthRange::Metric { near, far } => [near, far],
            DepthRange::Inverse { near } => [near / NEAR_PART, FAR * near / NEAR_PART],
        };
        let camera = |(view, pose): (&crate::scene::View, _)| {
            let lens = refined.map_or(view.intrinsics, |found| found.of(&view.intrinsics));
            let [height, width] = view.file_size;
            let lens = lens.resized(height, width);
            ExportCamera {
                name: exported_name(&scene.root, &view.file),
                width: lens.width,
                height: lens.height,
                focal: [lens.fx, lens.fy],
                principal: [lens.cx, lens.cy],
                distortion: view.removed_distortion,
                pose: scene.frame.unload(pose),
                bounds: Some(bounds.map(|d| d / scene.frame.scale)),
            }
        };
        Ok(scene.train.iter().zip(&aligned).map(camera).collect())
    }
}

/// The file of an image as seen from the scene's folder.
fn exported_name(root: &Path, file: &Path) -> String {
    let name = file.strip_prefix(root).unwrap_or(file).to_string_lossy().replace('\\', "/");
    name.strip_prefix("./").map_or(name.clone(), String::from)
}
