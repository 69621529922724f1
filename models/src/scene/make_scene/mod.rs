//! A built-in scene: textured solids on a checkered disc, ray-cast with exact cameras and depths, written in Blender's
//! layout (`transforms_{train,val,test}.json`, RGBA images, depths as `.npy`).
//!
//! Everything follows from the options and is the same on every machine up to rounding of the last bit of a colour.

mod solids;

use super::SceneError;
use crate::data::Random;
use crate::run::files::{WriteError, write_atomically};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use serde_json::json;
use solids::World;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Distance of the cameras from the origin, and horizontal field of view in radians: those of NeRF's synthetic scenes.
const RADIUS: f64 = 4.0;
const ANGLE_X: f64 = 0.69;
/// Lowest and highest elevation of a camera, in degrees.
const ELEVATION: [f64; 2] = [8.0, 70.0];
/// Rays along each side of a picture, where that leaves 2 to 4 along each side of a pixel.
const RAYS: usize = 800;
const SIZES: std::ops::RangeInclusive<usize> = 8..=2048;

/// What to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MakeOptions {
    /// Training views; a tenth as many for validation and a fifth for testing, at least 4 each.
    pub views: usize,
    /// Height and width in pixels.
    pub size: usize,
    /// Of shapes, colours and cameras.
    pub seed: u32,
}

impl Default for MakeOptions {
    fn default() -> MakeOptions {
        MakeOptions { views: 50, size: 128, seed: 0 }
    }
}

/// Why there is no scene.
#[derive(Debug, thiserror::Error)]
pub enum MakeError {
    #[error("the folder {} is not empty; expected a new or an empty one", .path.display())]
    NotEmpty { path: PathBuf },
    #[error("`{option}`: expected {expected}, found {found}")]
    Option { option: &'static str, expected: String, found: usize },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Read(#[from] SceneError),
}

/// Makes the scene in the folder `root`. `progress` hears how many of how many images are there, from any thread.
pub fn make_scene(
    root: &Path,
    options: &MakeOptions,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<(), MakeError> {
    let MakeOptions { views, size, seed } = *options;
    if !(1..=100_000).contains(&views) {
        return Err(MakeError::Option { option: "views", expected: "1 to 100000".into(), found: views });
    }
    if !SIZES.contains(&size) {
        let expected = format!("{} to {} pixels", SIZES.start(), SIZES.end());
        return Err(MakeError::Option { option: "size", expected, found: size });
    }
    let folder =
        |path: &Path| std::fs::create_dir_all(path).map_err(|source| WriteError { path: path.to_path_buf(), source });
    folder(root)?;
    let mut inside = std::fs::read_dir(root).map_err(|source| SceneError::Read { path: root.into(), source })?;
    if inside.next().is_some() {
        return Err(MakeError::NotEmpty { path: root.into() });
    }
    let splits = [("train", views), ("val", (views / 10).max(4)), ("test", (views / 5).max(4))];
    let total: usize = splits.iter().map(|s| s.1).sum();
    let (world, done) = (World::new(seed), AtomicUsize::new(0));
    for (split, count) in splits {
        folder(&root.join(split))?;
        let cameras = cameras(seed, split, count);
        let one = |(i, camera): (usize, &Camera)| {
            let picture = render(&world, camera, size);
            let file = |suffix: &str| root.join(split).join(format!("r_{i}{suffix}"));
            write_atomically(&file(".png"), &picture.png(size))?;
            write_atomically(&file("_depth.npy"), &picture.npy(size))?;
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
            Ok::<(), WriteError>(())
        };
        cameras.par_iter().enumerate().try_for_each(one)?;
        let frame = |(i, camera): (usize, &Camera)| {
            json!({
                "file_path": format!("./{split}/r_{i}"),
                "depth_file_path": format!("./{split}/r_{i}_depth.npy"),
                "transform_matrix": camera.matrix(),
            })
        };
        let frames: Vec<_> = cameras.iter().enumerate().map(frame).collect();
        let file = json!({ "camera_angle_x": ANGLE_X, "depth_unit_scale_factor": 1.0, "frames": frames });
        write_atomically(&root.join(format!("transforms_{split}.json")), format!("{file:#}\n").as_bytes())?;
    }
    Ok(())
}

/// A camera that looks at the origin; axes are columns (right, up, back), OpenGL's.
struct Camera {
    axes: Matrix3<f64>,
    center: Vector3<f64>,
}

impl Camera {
    fn matrix(&self) -> [[f64; 4]; 4] {
        let row = |i: usize| [self.axes[(i, 0)], self.axes[(i, 1)], self.axes[(i, 2)], self.center[i]];
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }
}

/// Cameras spread evenly over the upper hemisphere, along a spiral of golden angles with a start of its own in every split.
fn cameras(seed: u32, split: &str, count: usize) -> Vec<Camera> {
    let mut random = Random::new(seed, split);
    let (turn, shift) = (random.uniform(), random.uniform());
    let [low, high] = ELEVATION.map(|e| e.to_radians().sin());
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let one = |i: usize| {
        let azimuth = std::f64::consts::TAU * (turn + i as f64 * golden).fract();
        // Even in the sine of the elevation, which is even in area.
        let height = low + (high - low) * ((i as f64 + shift) / count as f64);
        let across = (1.0 - height * height).sqrt();
        let back = Vector3::new(across * azimuth.cos(), across * azimuth.sin(), height);
        let right = Vector3::z().cross(&back).normalize();
        let axes = Matrix3::from_columns(&[right, back.cross(&right), back]);
        Camera { axes, center: RADIUS * back }
    };
    (0..count).map(one).collect()
}

struct Picture {
    /// RGBA, the colours not multiplied by opacity.
    bytes: Vec<u8>,
    /// Along the optical axis through the centre of a pixel; 0 where there is nothing.
    depth: Vec<f32>,
}

fn render(world: &World, camera: &Camera, size: usize) -> Picture {
    let focal = 0.5 * size as f64 / (0.5 * ANGLE_X).tan();
    // A ray's parameter is the depth along the optical axis, since its component along it is 1.
    let ray = |u: f64, v: f64| {
        let half = size as f64 / 2.0;
        camera.axes * Vector3::new((u - half) / focal, -(v - half) / focal, -1.0)
    };
    let samples = (RAYS / size).clamp(2, 4);
    let mut picture = Picture { bytes: vec![], depth: vec![] };
    for pixel in 0..size * size {
        let (u, v) = ((pixel % size) as f64, (pixel / size) as f64);
        let (mut sum, mut hits) = (Vector3::zeros(), 0);
        for sample in 0..samples * samples {
            let within = |i: usize| (i as f64 + 0.5) / samples as f64;
            let direction = ray(u + within(sample % samples), v + within(sample / samples));
            if let Some(color) = world.color(&camera.center, &direction) {
                sum += color;
                hits += 1;
            }
        }
        let mean = sum / f64::from(hits.max(1));
        picture.bytes.extend(mean.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8));
        picture.bytes.push((f64::from(hits) * 255.0 / (samples * samples) as f64).round() as u8);
        picture.depth.push(world.depth(&camera.center, &ray(u + 0.5, v + 0.5)).unwrap_or(0.0) as f32);
    }
    picture
}

impl Picture {
    fn png(&self, size: usize) -> Vec<u8> {
        let mut bytes = vec![];
        let encoder = PngEncoder::new(&mut bytes);
        let side = size as u32;
        encoder.write_image(&self.bytes, side, side, ExtendedColorType::Rgba8).expect("four bytes a pixel, in memory");
        bytes
    }

    fn npy(&self, size: usize) -> Vec<u8> {
        use npyz::WriterBuilder;
        let mut bytes = vec![];
        let shape = [size as u64, size as u64];
        let options = npyz::WriteOptions::new().default_dtype().shape(&shape).writer(&mut bytes);
        let mut writer = options.begin_nd().expect("writing to memory");
        writer.extend(self.depth.iter().copied()).expect("writing to memory");
        writer.finish().expect("as many numbers as the shape says");
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{LoadOptions, load};

    /// Depths and poses agree: what a view sees, moved into another view, lies at the depth that view sees there, unless
    /// something hides it.
    #[test]
    fn a_made_scene_loads_and_its_views_agree() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("scene");
        let options = MakeOptions { views: 6, size: 48, seed: 5 };
        make_scene(&root, &options, &|_, _| ()).unwrap();
        let scene = load(&root, &LoadOptions::default(), &|_, _| ()).unwrap();
        assert_eq!([scene.train.len(), scene.val.len(), scene.test.len()], [6, 4, 4]);
        let (a, b) = (&scene.train[0], &scene.train[1]);
        let (from, to, k) = (a.pose.unwrap(), b.pose.unwrap(), a.intrinsics);
        let (mut agree, mut nearer, mut compared) = (0, 0, 0);
        for (i, z) in a.depth.as_ref().unwrap().iter().map(|z| f64::from(*z)).enumerate() {
            let (u, v) = ((i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5);
            let x = Vector3::new((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z);
            let seen = to.apply(&from.inverse().apply(&x));
            let (u, v) = (seen.x / seen.z * k.fx + k.cx, seen.y / seen.z * k.fy + k.cy);
            if z > 0.0 && (0.0..48.0).contains(&u) && (0.0..48.0).contains(&v) {
                let there = f64::from(b.depth.as_ref().unwrap()[v as usize * 48 + u as usize]);
                agree += usize::from((there - seen.z).abs() < 0.1);
                nearer += usize::from(there > 0.0 && there < seen.z - 0.1);
                compared += 1;
            }
        }
        assert!(compared > 200 && agree + nearer > compared * 9 / 10, "{agree} and {nearer} of {compared}");
        // The two stand nearly opposite each other, so that most of what one sees is hidden from the other.
        assert!(agree > compared / 6, "{agree} of {compared}");
        let foreground = a.foreground().unwrap();
        let opaque = foreground.iter().zip(a.depth.as_ref().unwrap());
        assert!(
            opaque.clone().all(|(m, z)| *m < 1.0 || *z > 0.0) && opaque.clone().all(|(m, z)| *m > 0.0 || *z == 0.0)
        );
    }

    #[test]
    fn the_same_options_make_the_same_files() {
        let dir = tempfile::tempdir().unwrap();
        let make = |name: &str, seed: u32| {
            let root = dir.path().join(name);
            make_scene(&root, &MakeOptions { views: 1, size: 16, seed }, &|_, _| ()).unwrap();
            ["train/r_0.png", "test/r_3_depth.npy", "transforms_val.json"].map(|f| std::fs::read(root.join(f)).unwrap())
        };
        let first = make("a", 1);
        assert_eq!(first, make("b", 1));
        assert_ne!(first, make("c", 2));
    }

    #[test]
    fn refusals() {
        let dir = tempfile::tempdir().unwrap();
        let make = |options: MakeOptions| make_scene(dir.path(), &options, &|_, _| ()).unwrap_err().to_string();
        let few = MakeOptions { views: 0, ..MakeOptions::default() };
        assert!(make(few).contains("`views`: expected 1"));
        assert!(make(MakeOptions { size: 5000, ..few }).contains("`views`"));
        assert!(make(MakeOptions { size: 5000, ..MakeOptions::default() }).contains("`size`: expected 8 to 2048"));
        std::fs::write(dir.path().join("thesis.tex"), "text").unwrap();
        assert!(make(MakeOptions::default()).contains("not empty"));
    }
}
