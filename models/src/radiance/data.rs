//! The data of a 3D run: a scene, and the poses that training starts from.

use super::model::{NotInSpace, sections};
use super::rays::ImageSize;
use crate::config::{ConfigError, Layered};
use crate::evaluation::PoseSetError;
use crate::geometry::Pose;
use crate::scene::{self, LoadOptions, Scene, SceneError, View, initial};
use std::path::Path;

/// What a 3D run learns from.
#[derive(Clone, Debug)]
pub struct SpaceData {
    pub scene: Scene,
    pub size: ImageSize,
    /// Poses of the training views that training starts from.
    pub rough: Vec<Pose>,
    /// Their true poses, where they are known.
    pub truth: Option<Vec<Pose>>,
}

/// Why there are no data.
#[derive(Debug, thiserror::Error)]
pub enum SpaceDataError {
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Initial(#[from] initial::InitialPoseError),
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
            ..LoadOptions::default()
        };
        let scene = scene::load(Path::new(&wanted.path), &options, progress)?;
        let truth: Option<Vec<Pose>> = scene.train.iter().map(|v: &View| v.pose).collect();
        let rough = initial::poses(layered, &scene)?;
        Ok(SpaceData { size: ImageSize { height, width }, rough, truth, scene })
    }
}
