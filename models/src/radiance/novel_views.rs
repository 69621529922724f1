//! The papers' novel views: what a camera sees that swings about a training camera.

use super::data::SpaceDataError;
use super::explorer::Explorer;
use crate::Error;
use crate::evaluation::{DepthStyle, anchor, inverse_depth, novel_view_path};
use crate::pictures::Canvas;
use crate::scene::Layout;
use crate::training::Watch;

/// Frames of the two videos.
#[derive(Clone, Debug, Default)]
pub struct NovelViews {
    pub rgb: Vec<Canvas>,
    /// Inverse depth in colours.
    pub depth: Vec<Canvas>,
}

impl Explorer {
    /// `frames` views along the path, through the lens of the first test view. `progress` hears how many of how many are
    /// there.
    pub fn novel_views(&mut self, frames: usize, progress: &dyn Fn(usize, usize)) -> Result<NovelViews, Error> {
        let data = self.data.clone();
        let poses = self.poses()?;
        let similarity = data.similarity(&poses).map_err(SpaceDataError::from)?;
        let anchor = anchor(&poses).map_err(SpaceDataError::from)?;
        let lens = data.scene.test.first().unwrap_or(&data.scene.train[0]).intrinsics;
        let style = DepthStyle { scale: similarity.scale, shifted: data.scene.layout == Layout::Blender };
        let mut views = NovelViews::default();
        for (i, pose) in novel_view_path(&anchor, frames, 1.0 / similarity.scale).iter().enumerate() {
            let seen = self.render(pose, &lens, Watch::none())?;
            views.rgb.push(Canvas::from_colors(lens.width, lens.height, &seen.rgb));
            views.depth.push(inverse_depth(lens.width, lens.height, &seen.depth, &seen.opacity, style));
            progress(i + 1, frames);
        }
        Ok(views)
    }
}
