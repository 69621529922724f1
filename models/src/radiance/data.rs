//! The data of a 3D run: a scene, and the poses that training starts from.

use super::model::{NotInSpace, sections};
use super::rays::ImageSize;
use crate::config::{ConfigError, Layered, NoiseKind};
use crate::evaluation::PoseSetError;
use crate::geometry::Pose;
use crate::run::files::WriteError;
use crate::scene::make_scene::{MakeError, MakeOptions, make_scene};
use crate::scene::noise::{InitialPoses, NoiseError, PoseStart};
use crate::scene::{self, LoadOptions, Scene, SceneError, View};
use std::path::Path;

/// The path that stands for the procedural scene.
const BUILTIN: &str = "builtin";
/// Its training views.
const VIEWS: usize = 100;

/// What a 3D run learns from.
#[derive(Clone, Debug)]
pub struct SpaceData {
    pub scene: Scene,
    pub size: ImageSize,
    /// Poses of the training views that training starts from, and the noise they were drawn with.
    pub start: PoseStart,
    /// Their true poses, where they are known.
    pub truth: Option<Vec<Pose>>,
    /// What the noise was drawn with.
    pub seed: u32,
}

/// Why there are no data.
#[derive(Debug, thiserror::Error)]
pub enum SpaceDataError {
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Make(#[from] MakeError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Initial(#[from] NoiseError),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Settings(#[from] NotInSpace),
    #[error(transparent)]
    Poses(#[from] PoseSetError),
}

impl SpaceData {
    /// Loads the scene, and draws or loads the poses to start from. `progress` hears how many images of how many are there.
    pub fn load(layered: &Layered, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<SpaceData, SpaceDataError> {
        let settings = &layered.settings;
        let (wanted, ..) = sections(settings)?;
        let [height, width] = wanted.image_size;
        let options = LoadOptions {
            size: Some([height, width]),
            train_limit: wanted.train_views.limit(),
            val_limit: wanted.val_views.limit(),
            test_limit: wanted.test_views.limit(),
            no_train_depths: true,
            ..LoadOptions::default()
        };
        let scene = match wanted.path.as_str() {
            BUILTIN => {
                let folder = tempfile::tempdir().map_err(|source| WriteError { path: std::env::temp_dir(), source })?;
                let made = MakeOptions { views: VIEWS, size: height.max(width), seed: 0 };
                make_scene(folder.path(), &made, &|_, _| {})?;
                scene::load(folder.path(), &options, progress)?
            }
            path => scene::load(Path::new(path), &options, progress)?,
        };
        let truth: Option<Vec<Pose>> = scene.train.iter().map(|v: &View| v.pose).collect();
        let names = || scene.train.iter().map(|v| (v.name.as_str(), v.pose));
        let (noise, seed) = (&settings.noise, settings.run.seed);
        let start = match (wanted.poses.as_str(), noise.kind) {
            ("truth", _) => InitialPoses::Truth.draw(names(), seed)?,
            ("identity", _) => InitialPoses::Identity.draw(names(), seed)?,
            ("noisy", NoiseKind::Barf) => InitialPoses::Barf { deviation: noise.rotation }.draw(names(), seed)?,
            ("noisy", NoiseKind::L2g) => {
                InitialPoses::L2g { rotation: noise.rotation, translation: noise.translation }.draw(names(), seed)?
            }
            (file, _) => PoseStart::load(Path::new(file), names())?,
        };
        let size = ImageSize { height, width };
        Ok(SpaceData { size, start, truth, scene, seed })
    }
}
