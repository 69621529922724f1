//! The unknown distortion of the patches: drawing, files, and the transforms they stand for.
//!
//! A patch point x goes through a homography exp(h), a rotation and a translation: x -> t + R exp(h) x. Two ways of
//! drawing exist, that of L2G (large rotations) and that of BARF (shifts towards the corners).
//!
//! Files are JSON and hold what other programs need to be compared on the same data: the sizes under `image_size_hw` and
//! `patch_crop_hw`, and under `perturbation` the lists `homography` (8 numbers a patch), `rotation` (1) and
//! `translation` (2).

use super::Random;
use crate::config::{Dof, NoiseKind, Settings};
use crate::geometry::{Grid, Transform};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Redraws of one patch before the noise is declared too large for the image.
const ATTEMPTS: usize = 1_000_000;

/// More than any number of a file may be: a half length or a radian is 1.
const LARGEST: f64 = 100.0;

/// Distortions of all patches.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Perturbation {
    /// What the lists mean, for readers of the file.
    #[serde(default)]
    pub order: String,
    pub homography: Vec<[f64; 8]>,
    pub rotation: Vec<[f64; 1]>,
    pub translation: Vec<[f64; 2]>,
}

/// The file around it.
#[derive(Serialize, Deserialize)]
struct File {
    image_size_hw: [usize; 2],
    patch_crop_hw: [usize; 2],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    warp: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    dof: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    seed: Option<i64>,
    /// What tells the picture that the patches are cut from from others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    photo_blake3: Option<String>,
    perturbation: Perturbation,
}

/// Why there is no perturbation.
#[derive(Debug, thiserror::Error)]
pub enum PerturbationError {
    #[error("cannot read the perturbation file {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{}: not a perturbation file: {message}", .path.display())]
    Format { path: PathBuf, message: String },
    #[error("{}: made for {what} {found}, but this experiment has {expected}{hint}", .path.display())]
    Mismatch { path: PathBuf, what: &'static str, found: String, expected: String, hint: String },
    #[error(
        "no perturbation found in {ATTEMPTS} draws that keeps patch {patch} inside the image of {height} x {width}: \
         lower `noise.homography`, `noise.rotation` or `noise.translation`, or make `data.patch_crop` smaller"
    )]
    TooLarge { patch: usize, height: usize, width: usize },
}

impl File {
    fn read(path: &Path) -> Result<File, PerturbationError> {
        let format = |message: String| PerturbationError::Format { path: path.into(), message };
        let text =
            std::fs::read_to_string(path).map_err(|source| PerturbationError::Read { path: path.into(), source })?;
        let mut json = serde_json::Deserializer::from_str(&text);
        let file = serde_path_to_error::deserialize(&mut json).map_err(|e| match e.path().to_string() {
            field if field == "." => format(e.inner().to_string()),
            field => format(format!("`{field}`: {}", e.inner())),
        })?;
        json.end().map_err(|e| format(e.to_string()))?;
        Ok(file)
    }
}

impl Perturbation {
    /// Draws the perturbation of the settings' noise and seed, or loads the file that they name.
    pub fn of(settings: &Settings, grid: &Grid) -> Result<Perturbation, PerturbationError> {
        match settings.data.perturbation.as_str() {
            "drawn" => Perturbation::draw(settings, grid),
            file => Perturbation::load(Path::new(file), settings, grid),
        }
    }

    fn draw(settings: &Settings, grid: &Grid) -> Result<Perturbation, PerturbationError> {
        let mut random = Random::new(settings.run.seed, "perturbation");
        let mut all = Perturbation { order: ORDER.to_string(), ..Perturbation::default() };
        for patch in 0..settings.data.patches {
            let draw = |random: &mut Random| match settings.noise.kind {
                NoiseKind::L2g => draw_l2g(settings, random),
                NoiseKind::Barf => draw_barf(settings, patch, random),
            };
            let accepted = |warp: &Transform| match settings.noise.kind {
                NoiseKind::L2g => inside_and_off_centre(grid, warp),
                NoiseKind::Barf => inside(grid, warp),
            };
            let kept = (0..ATTEMPTS).map(|_| draw(&mut random)).find(|d| accepted(&d.transform()));
            let Some(mut kept) = kept else {
                return Err(PerturbationError::TooLarge { patch, height: grid.height, width: grid.width });
            };
            if patch == 0 && settings.warp.fix_first {
                kept = One::default();
            }
            all.homography.push(kept.homography);
            all.rotation.push([kept.rotation]);
            all.translation.push(kept.translation);
        }
        Ok(all)
    }

    fn load(path: &Path, settings: &Settings, grid: &Grid) -> Result<Perturbation, PerturbationError> {
        let format = |message: String| PerturbationError::Format { path: path.into(), message };
        let file = File::read(path)?;
        let size = |s: [usize; 2]| format!("{} x {}", s[0], s[1]);
        let sets = |key: &str, s: [usize; 2]| format!("; `--set {key}=[{},{}]` would fit", s[0], s[1]);
        let mismatch = |what, found: String, expected: String, hint: String| {
            Err(PerturbationError::Mismatch { path: path.into(), what, found, expected, hint })
        };
        if file.image_size_hw != [grid.height, grid.width] {
            let hint = sets("data.image_size", file.image_size_hw);
            return mismatch("images of", size(file.image_size_hw), size([grid.height, grid.width]), hint);
        }
        if file.patch_crop_hw != grid.crop {
            let hint = sets("data.patch_crop", file.patch_crop_hw);
            return mismatch("patches of", size(file.patch_crop_hw), size(grid.crop), hint);
        }
        let p = file.perturbation;
        for (list, len) in
            [("homography", p.homography.len()), ("rotation", p.rotation.len()), ("translation", p.translation.len())]
        {
            if len != settings.data.patches {
                let hint = format!(" (in `perturbation.{list}`)");
                return mismatch("a number of patches of", len.to_string(), settings.data.patches.to_string(), hint);
            }
        }
        let all =
            p.homography.iter().flatten().chain(p.rotation.iter().flatten()).chain(p.translation.iter().flatten());
        if let Some(x) = all.into_iter().find(|x| x.is_nan() || x.abs() > LARGEST) {
            return Err(format(format!("expected numbers of at most {LARGEST}, found {x:e}")));
        }
        if settings.warp.fix_first && p.transforms().first().is_some_and(|t| *t != Transform::identity()) {
            let text = "patch 0 is to stay where it is (`warp.fix_first`), so all its numbers should be 0";
            return Err(format(format!("{text}; `--set warp.fix_first=false` trains it too")));
        }
        if let Some((i, _)) = p.transforms().iter().enumerate().find(|(_, t)| !inside(grid, t)) {
            return Err(format(format!("patch {i} does not stay inside the image")));
        }
        Ok(p)
    }

    /// The perturbation in a file of [`Perturbation::to_json`], and the digest of the photo if it is known; nothing where no such file
    /// is.
    pub fn kept(path: &Path) -> Result<Option<(Perturbation, Option<String>)>, PerturbationError> {
        let file = match File::read(path) {
            Err(PerturbationError::Read { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                return Ok(None);
            }
            file => file?,
        };
        Ok(Some((file.perturbation, file.photo_blake3)))
    }

    /// Whether all numbers are the same but for what writing them takes.
    pub fn is_near(&self, other: &Perturbation) -> bool {
        let numbers = |p: &Perturbation| [p.homography.concat(), p.rotation.concat(), p.translation.concat()].concat();
        let (a, b) = (numbers(self), numbers(other));
        a.len() == b.len() && a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= 1e-9)
    }

    /// The file that loads as this perturbation, with the digest of the photo if it is known.
    pub fn to_json(&self, settings: &Settings, grid: &Grid, photo: Option<String>) -> String {
        let file = File {
            image_size_hw: [grid.height, grid.width],
            patch_crop_hw: grid.crop,
            warp: Some(settings.warp.dof.to_string()),
            dof: Some(settings.warp.dof.into()),
            seed: (settings.data.perturbation == "drawn").then_some(i64::from(settings.run.seed)),
            photo_blake3: photo,
            perturbation: self.clone(),
        };
        // A struct of numbers and strings always has a JSON form.
        serde_json::to_string_pretty(&file).unwrap_or_default()
    }

    /// One transform a patch, from patch points to points of the photo.
    pub fn transforms(&self) -> Vec<Transform> {
        let parts = self.homography.iter().zip(&self.rotation).zip(&self.translation);
        parts.map(|((h, r), t)| One { homography: *h, rotation: r[0], translation: *t }.transform()).collect()
    }
}

const ORDER: &str =
    "homography sl(3) (8), then rotation (1, radians), then translation (2, in half lengths of the longer side)";

#[derive(Clone, Copy, Debug, Default)]
struct One {
    homography: [f64; 8],
    rotation: f64,
    translation: [f64; 2],
}

impl One {
    fn transform(&self) -> Transform {
        Transform::translation(self.translation) * Transform::rotation(self.rotation) * Transform::sl3(&self.homography)
    }
}

/// Always draws all eleven numbers, so that experiments of different freedom see the same sequence.
fn draw_l2g(settings: &Settings, random: &mut Random) -> One {
    let noise = &settings.noise;
    let (mut homography, [rotation], translation) =
        (random.normals(noise.homography), random.normals(noise.rotation), random.normals(noise.translation));
    homography[..2].fill(0.0);
    match settings.warp.dof {
        Dof::Rotation => One { rotation, ..One::default() },
        Dof::Translation => One { translation, ..One::default() },
        Dof::Rigid => One { rotation, translation, ..One::default() },
        Dof::Homography | Dof::Pose => One { homography, rotation, translation },
    }
}

fn draw_barf(settings: &Settings, patch: usize, random: &mut Random) -> One {
    let t = settings.noise.translation;
    let shift = [[0.0, 0.0], [-t, -t], [-t, t], [t, -t], [t, t]][patch.min(4)];
    let mut homography: [f64; 8] = random.normals(settings.noise.homography);
    homography[0] += shift[0];
    homography[1] += shift[1];
    let [h1, h2, h3, h4, ..] = homography;
    // Smaller groups keep the part of the draw that they can express.
    match settings.warp.dof {
        Dof::Homography | Dof::Pose => One { homography, ..One::default() },
        Dof::Rigid => One { rotation: (h4 - h3) / 2.0, translation: [h1, h2], ..One::default() },
        Dof::Translation => One { translation: [h1, h2], ..One::default() },
        Dof::Rotation => One { rotation: (h4 - h3) / 2.0, ..One::default() },
    }
}

fn inside(grid: &Grid, warp: &Transform) -> bool {
    let within = |x: f64, size: usize| 0.0 <= x && x < size as f64;
    grid.warped_corners(warp).iter().all(|c| within(c[0], grid.width) && within(c[1], grid.height))
}

/// Inside the image, and outside a strip around each middle line, an eighth of the patch to either side.
fn inside_and_off_centre(grid: &Grid, warp: &Transform) -> bool {
    let off = |x: f64, size: usize, crop: usize| {
        let (middle, margin) = ((size / 2) as f64, (crop / 8) as f64);
        x < middle - margin || x >= middle + margin
    };
    let corners = grid.warped_corners(warp);
    let off_centre = |c: &[f64; 2]| off(c[0], grid.width, grid.crop[1]) && off(c[1], grid.height, grid.crop[0]);
    inside(grid, warp) && corners.iter().all(off_centre)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Layered;

    const CAT: Grid = Grid { height: 360, width: 480, crop: [180, 180] };

    #[test]
    fn draws_are_accepted_repeatable_and_reload() {
        for preset in ["planar-l2g", "planar-barf-original", "planar-l2g-rigid", "planar-l2g-rotation"] {
            let settings = Layered::load(preset).unwrap().settings;
            let p = Perturbation::of(&settings, &CAT).unwrap();
            assert_eq!(p, Perturbation::of(&settings, &CAT).unwrap());
            assert_eq!(p.transforms()[0], Transform::identity());
            assert!(p.transforms().iter().all(|t| inside(&CAT, t)));
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("perturbation.json");
            std::fs::write(&path, p.to_json(&settings, &CAT, None)).unwrap();
            assert_eq!(Perturbation::load(&path, &settings, &CAT).unwrap(), p);
            let smaller = Grid { crop: [100, 100], ..CAT };
            let error = Perturbation::load(&path, &settings, &smaller).unwrap_err().to_string();
            assert!(error.contains("patches of 180 x 180, but this experiment has 100 x 100"), "{error}");
        }
    }

    #[test]
    fn files_of_nonsense_are_refused() {
        let settings = Layered::load("planar-l2g").unwrap().settings;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("perturbation.json");
        let good = Perturbation::of(&settings, &CAT).unwrap();
        let refused = |p: &Perturbation, more: &str, part: &str| {
            std::fs::write(&path, p.to_json(&settings, &CAT, None) + more).unwrap();
            let error = Perturbation::load(&path, &settings, &CAT).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        };
        refused(&good, "]", "trailing characters");
        let mut huge = good.clone();
        huge.homography[1] = [1e100; 8];
        refused(&huge, "", "expected numbers of at most 100, found 1e100");
        let mut moved = good.clone();
        moved.translation[0] = [0.1, 0.0];
        refused(&moved, "", "patch 0 is to stay where it is");
    }

    #[test]
    fn noise_that_fits_nowhere_is_refused() {
        let mut layered = Layered::load("planar-l2g").unwrap();
        layered.set("noise.translation=50").unwrap();
        let mut grid = CAT;
        grid.crop = [360, 480];
        let error = Perturbation::of(&layered.settings, &grid).unwrap_err().to_string();
        assert!(error.contains("noise.homography"), "{error}");
    }
}
