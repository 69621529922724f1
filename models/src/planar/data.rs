//! The data of a planar run: photo, grid, true warps, and the distorted patches cut with them.

use crate::config::{ConfigError, ImageSize, Layered, Settings};
use crate::data::{Perturbation, PerturbationError, Photo, PhotoError};
use crate::geometry::{Grid, Transform};
use std::path::{Path, PathBuf};

/// Where a run keeps how its patches were cut.
pub const PERTURBATION: &str = "perturbation.json";

/// What a planar run learns from.
#[derive(Clone, Debug)]
pub struct PlanarData {
    pub photo: Photo,
    pub grid: Grid,
    pub perturbation: Perturbation,
    /// True warp of every patch.
    pub truth: Vec<Transform>,
}

/// Why there are no data.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    #[error(transparent)]
    Photo(#[from] PhotoError),
    #[error(transparent)]
    Perturbation(#[from] PerturbationError),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("{}: the run learned from other {learned} than {file} gives now", .path.display())]
    OtherRun { path: PathBuf, learned: &'static str, file: String },
}

impl PlanarData {
    /// Loads the photo and draws or loads the perturbation.
    pub fn load(layered: &Layered) -> Result<PlanarData, DataError> {
        let settings = &layered.settings;
        let photo = Photo::load(&settings.data.image)?.at_least(settings.data.patch_crop, &settings.data.image)?;
        let [height, width] = match settings.data.image_size {
            ImageSize::Photo => [photo.height, photo.width],
            ImageSize::Fixed(size) => size,
        };
        layered.check_crop([height, width])?;
        let grid = Grid { height, width, crop: settings.data.patch_crop };
        let perturbation = Perturbation::of(settings, &grid)?;
        let truth = perturbation.transforms();
        Ok(PlanarData { photo, grid, perturbation, truth })
    }

    /// What the patches are cut from and how, for the run's folder.
    pub fn to_json(&self, settings: &Settings) -> String {
        self.perturbation.to_json(settings, &self.grid, Some(self.photo.digest()))
    }

    /// Refuses a photo or a perturbation that the run in a folder did not begin with: a file has changed, or is another one.
    pub fn check_run(&self, folder: &Path, settings: &Settings) -> Result<(), DataError> {
        let path = folder.join(PERTURBATION);
        let Some((perturbation, photo)) = Perturbation::kept(&path)? else { return Ok(()) };
        let changed = if !self.perturbation.is_near(&perturbation) {
            ("perturbations", &settings.data.perturbation)
        } else if photo.is_some_and(|photo| photo != self.photo.digest()) {
            ("pictures", &settings.data.image)
        } else {
            return Ok(());
        };
        Err(DataError::OtherRun { path, learned: changed.0, file: changed.1.clone() })
    }

    /// Colours of all patches, patch by patch, row by row: the photo at the warped patch points.
    pub fn targets(&self) -> Vec<[f64; 3]> {
        let points = self.grid.crop_points();
        let patch = |warp: &Transform| -> Vec<[f64; 3]> {
            points.iter().map(|p| self.photo.sample(self.grid.lookup(warp.apply(*p)))).collect()
        };
        self.truth.iter().flat_map(patch).collect()
    }

    /// The photo at the resolution of the grid, row by row.
    pub fn picture(&self) -> Vec<[f64; 3]> {
        self.grid.points().iter().map(|p| self.photo.sample(self.grid.lookup(*p))).collect()
    }
}
