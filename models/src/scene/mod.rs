//! Scenes: images of one thing from many sides, their cameras, and a split into training, validation and test views.
//!
//! Whatever the layout, a loaded scene follows one convention. A pose takes the world to the camera, with camera axes x
//! right, y down, z forward. The centre of the pixel in column j and row i is (j + 0.5, i + 0.5), so the point of the plane
//! z = 1 that it shows is ((j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy, 1). Images are pinhole images: lens distortion is
//! removed while loading. [`WorldFrame`] leads back to the world of the files.

mod blender;
mod camera;
mod check;
mod colmap;
mod dtu;
mod error;
mod folder;
mod frame;
pub(crate) mod jpeg;
mod json;
mod llff;
pub mod make_scene;
mod named_poses;
pub mod noise;
mod normalise;
mod numpy;
mod picture;
pub mod plot;
mod resize;
mod transforms;

pub use dtu::DtuSplit;
pub use error::SceneError;
pub use frame::WorldFrame;
pub(crate) use frame::nearest_rotation;
pub use named_poses::{NamedPoses, World};
pub use noise::{InitialPoses, NoiseError, PoseStart};

use crate::geometry::Pose;
use check::{check_depth, check_distinct, check_pose, check_sizes, enough_to_split};
use image::metadata::Orientation;
use picture::{DepthFile, read_view};
use rayon::prelude::*;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

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
    /// Its file.
    pub file: PathBuf,
    /// Height and width of the image in it, upright.
    pub file_size: [usize; 2],
    /// Red, green, blue and opacity of every pixel, row by row.
    pub pixels: Vec<[u8; 4]>,
    /// Whether the image can be transparent.
    pub transparent: bool,
    pub intrinsics: Intrinsics,
    /// Lens distortion of the file, which was removed, see [`Intrinsics::distortion`].
    pub removed_distortion: Option<[f64; 4]>,
    /// Reference pose; `None` where nobody knows it.
    pub pose: Option<Pose>,
    /// The mask that comes with the image, one value a pixel: whether all of it is foreground.
    pub mask: Option<Vec<bool>>,
    /// Depth along the optical axis in the loaded world's unit, one number a pixel; 0 where unknown.
    pub depth: Option<Vec<f32>>,
}

impl View {
    /// Colours in 0..=1, row by row, three a pixel; on white where the image is transparent.
    pub fn rgb(&self) -> Vec<f32> {
        let unit = |byte: u8| f32::from(byte) / 255.0;
        let on_white = |p: &[u8; 4]| -> [f32; 3] {
            let opacity = unit(p[3]);
            std::array::from_fn(|c| unit(p[c]) * opacity + (1.0 - opacity))
        };
        self.pixels.iter().flat_map(on_white).collect()
    }

    /// Share of the foreground, 0..=1, one number a pixel: the mask that comes with the image, or its opacity.
    pub fn foreground(&self) -> Option<Vec<f32>> {
        match &self.mask {
            Some(mask) => Some(mask.iter().map(|m| f32::from(u8::from(*m))).collect()),
            None => self.transparent.then(|| self.pixels.iter().map(|p| f32::from(p[3]) / 255.0).collect()),
        }
    }
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
    /// In the order in which they are tried: files made for training come before those of reconstruction programs, which
    /// often lie beside them.
    pub const ALL: [Layout; 6] =
        [Layout::Blender, Layout::Transforms, Layout::Dtu, Layout::Llff, Layout::Colmap, Layout::Folder];

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

    /// Whether it is of photos that somebody took, whose poses, if there are any, are a reconstruction program's.
    pub fn is_capture(self) -> bool {
        !matches!(self, Layout::Blender | Layout::Dtu)
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

/// Whether cameras stand around something, rather than look all the same way.
pub fn stand_around(poses: &[Pose]) -> bool {
    matches!(normalise::Arrangement::of(poses), normalise::Arrangement::Around { .. })
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
    /// Instead of the layout's own, in the loaded world's unit.
    pub depth: Option<DepthRange>,
    /// Focal length in pixels of the image file, for layouts that know none (folders of images).
    pub focal: Option<f64>,
    /// Leave the depths of training views on the disk.
    pub no_train_depths: bool,
    /// For DTU scans; other layouts have one split.
    pub dtu_split: DtuSplit,
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
    /// From the world of the files to the loaded one.
    pub frame: WorldFrame,
    /// What had to be assumed, a sentence each.
    pub notes: Vec<String>,
}

impl Scene {
    /// Names and reference poses of the training views.
    pub fn training_poses(&self) -> impl Iterator<Item = (&str, Option<Pose>)> {
        self.train.iter().map(|v| (v.name.as_str(), v.pose))
    }
}

/// What a layout says of one view before any pixel is read.
struct Entry {
    name: String,
    image: PathBuf,
    /// What is done to the image before anything else; known cameras are those of the file's own pixels.
    turn: Orientation,
    mask: Option<PathBuf>,
    depth: Option<DepthFile>,
    /// For the image file's own size.
    intrinsics: Intrinsics,
    /// In the world of the files.
    pose: Option<Pose>,
}

/// What a layout says of a scene.
struct Listing {
    train: Vec<Entry>,
    /// `None`: the test views.
    val: Option<Vec<Entry>>,
    test: Vec<Entry>,
    depth: DepthRange,
    frame: WorldFrame,
    notes: Vec<String>,
}

impl Layout {
    /// What of this layout the folder lacks; `None` if it looks like one.
    fn lacks(self, root: &Path) -> Option<String> {
        match self {
            Layout::Blender => blender::lacks(root),
            Layout::Llff => llff::lacks(root),
            Layout::Dtu => dtu::lacks(root),
            Layout::Transforms => transforms::lacks(root),
            Layout::Colmap => colmap::lacks(root),
            Layout::Folder => folder::lacks(root),
        }
    }

    /// The layout of a folder.
    pub fn of(root: &Path) -> Result<Layout, SceneError> {
        std::fs::read_dir(root).map_err(|source| SceneError::Read { path: root.into(), source })?;
        let mut tried = vec![];
        for layout in Layout::ALL {
            match layout.lacks(root) {
                None => return Ok(layout),
                Some(lacks) => tried.push((layout, lacks)),
            }
        }
        Err(SceneError::NotAScene { root: root.into(), tried })
    }
}

/// Loads the scene in the folder `root`. `progress` hears how many of how many images are there, from any thread.
///
/// # Errors
/// Files that are missing or damaged, metadata that make no sense, too few images to split, images of different shapes, or
/// sizes where none is asked for, a folder that holds no scene.
pub fn load(root: &Path, options: &LoadOptions, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<Scene, SceneError> {
    let layout = match options.layout {
        Some(layout) => match layout.lacks(root) {
            Some(lacks) => return Err(SceneError::NotAScene { root: root.into(), tried: vec![(layout, lacks)] }),
            None => layout,
        },
        None => Layout::of(root)?,
    };
    let mut listing = match layout {
        Layout::Blender => blender::list(root),
        Layout::Llff => llff::list(root, options),
        Layout::Dtu => dtu::list(root, options),
        Layout::Transforms => transforms::list(root),
        Layout::Colmap => colmap::list(root),
        Layout::Folder => folder::list(root, options),
    }?;
    check_distinct(&listing.train, root)?;
    check_distinct(&listing.test, root)?;
    let limit = |entries: &mut Vec<Entry>, n: Option<usize>| entries.truncate(n.unwrap_or(usize::MAX));
    limit(&mut listing.train, options.train_limit);
    if options.no_train_depths {
        listing.train.iter_mut().for_each(|entry| entry.depth = None);
    }
    limit(&mut listing.test, options.test_limit);
    if let Some(val) = &mut listing.val {
        limit(val, options.val_limit);
    }
    let depth = options.depth.unwrap_or(listing.depth);
    check_depth(depth, if options.depth.is_some() { "the options" } else { layout.name() })?;
    let (trained, own_val) = (listing.train.len(), listing.val.as_ref().map_or(0, Vec::len));
    let entries: Vec<&Entry> = listing.train.iter().chain(listing.val.iter().flatten()).chain(&listing.test).collect();
    if trained == 0 {
        return Err(SceneError::TooFew { root: root.into(), found: 0, least: 1 });
    }
    check_sizes(&entries, options.size.is_some())?;
    let done = AtomicUsize::new(0);
    let read = |entry: &&Entry| {
        let view = read_view(entry, &listing.frame, options)?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, entries.len());
        Ok(view)
    };
    let views: Result<Vec<View>, SceneError> = entries.par_iter().map(read).collect();
    let mut views = views?;
    let test = views.split_off(trained + own_val);
    let val = match listing.val {
        Some(_) => views.split_off(trained),
        None => test.iter().take(options.val_limit.unwrap_or(usize::MAX)).cloned().collect(),
    };
    Ok(Scene { layout, root: root.into(), val, test, depth, frame: listing.frame, notes: listing.notes, train: views })
}

/// Every nth of a list, from the first on, set aside: (the others, the chosen).
fn every<T>(n: usize, all: Vec<T>) -> (Vec<T>, Vec<T>) {
    let (chosen, others): (Vec<_>, Vec<_>) = all.into_iter().enumerate().partition(|(i, _)| i % n == 0);
    let strip = |list: Vec<(usize, T)>| list.into_iter().map(|(_, x)| x).collect();
    (strip(others), strip(chosen))
}

/// The last tenth of a list set aside: (the others, the last).
fn last_tenth<T>(mut all: Vec<T>) -> (Vec<T>, Vec<T>) {
    let last = all.split_off(all.len() - all.len() / 10);
    (all, last)
}

#[cfg(test)]
mod tests;
