//! The data of a 3D run: a scene, and the poses that training starts from.

use super::model::{NotInSpace, sections};
use super::rays::ImageSize;
use crate::config::{ConfigError, DepthSettings, Layered, NoiseKind, Settings};
use crate::evaluation::{Alignment, Measured, PoseSetError, Scores, Similarity, ViewScores, pose_errors};
use crate::geometry::Pose;
use crate::run::files::WriteError;
use crate::scene::make_scene::{MakeError, MakeOptions, make_scene};
use crate::scene::noise::{InitialPoses, NoiseError, PoseStart, Side};
use crate::scene::{self, DepthRange, Layout, LoadOptions, Scene, SceneError, View};
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
        SpaceData::load_at(layered, sections(&layered.settings)?.0.image_size, progress)
    }

    /// The same for those who look at no picture: they are tiny, which saves the time of making the built-in ones.
    pub fn outline(layered: &Layered) -> Result<SpaceData, SpaceDataError> {
        SpaceData::load_at(layered, [8, 8], &|_, _| {})
    }

    /// With pictures of this height and width, whatever the settings say.
    fn load_at(
        layered: &Layered,
        picture: [usize; 2],
        progress: &(dyn Fn(usize, usize) + Sync),
    ) -> Result<SpaceData, SpaceDataError> {
        let settings = &layered.settings;
        let (wanted, ..) = sections(settings)?;
        let [height, width] = wanted.image_size;
        let options = LoadOptions {
            size: Some(picture),
            train_limit: wanted.train_views.limit(),
            val_limit: wanted.val_views.limit(),
            test_limit: wanted.test_views.limit(),
            focal: (wanted.focal > 0.0).then_some(wanted.focal),
            no_train_depths: true,
            ..LoadOptions::default()
        };
        let scene = match wanted.path.as_str() {
            BUILTIN => {
                let folder = tempfile::tempdir().map_err(|source| WriteError { path: std::env::temp_dir(), source })?;
                let made = MakeOptions { views: VIEWS, size: picture[0].max(picture[1]), seed: 0 };
                make_scene(folder.path(), &made, progress)?;
                scene::load(folder.path(), &options, &|_, _| {})?
            }
            path => scene::load(Path::new(path), &options, progress)?,
        };
        let truth: Option<Vec<Pose>> = scene.train.iter().map(|v: &View| v.pose).collect();
        let names = || scene.train.iter().map(|v| (v.name.as_str(), v.pose));
        let (noise, seed) = (&settings.noise, settings.run.seed);
        let start = match (wanted.poses_in(scene.layout), noise.kind) {
            ("truth", _) => InitialPoses::Truth.draw(names(), seed)?,
            ("identity", _) => InitialPoses::Identity.draw(names(), seed)?,
            ("noisy", NoiseKind::Barf) => InitialPoses::Barf { deviation: noise.rotation }.draw(names(), seed)?,
            ("noisy", NoiseKind::L2g) => {
                InitialPoses::L2g { rotation: noise.rotation, translation: noise.translation }.draw(names(), seed)?
            }
            (file, _) => PoseStart::load(Path::new(file), names())?,
        };
        if settings.train.as_ref().is_some_and(|t| t.ndc) {
            let away = start.poses.iter().filter(|p| p.rotation[(2, 2)] <= 0.0).count();
            if away > 0 {
                let text = format!(
                    "normalised device coordinates are for forward-facing scenes, whose cameras look along +z: {away} of \
                     the {} poses that training starts from look the other way",
                    start.poses.len()
                );
                return Err(layered.refuse("train.ndc", text).into());
            }
        }
        let size = ImageSize { height, width };
        Ok(SpaceData { size, start, truth, scene, seed })
    }

    /// The settings with the scene's own depths, where they ask for them: from near to far, and where L2G's noise displaced
    /// the cameras a standard deviation farther, since they must see the scene from there too. (Nearer than near lie no
    /// samples: a camera would explain its photo by something that no other camera sees.)
    pub fn with_depths(&self, settings: &Settings) -> Settings {
        let mut settings = settings.clone();
        if let Some(train) = settings.train.as_mut().filter(|t| t.depth == DepthSettings::Scene) {
            let displaced = self.start.noise.as_ref().is_some_and(|(side, _)| *side == Side::Camera);
            let farther = if displaced { settings.noise.translation } else { 0.0 };
            (train.depth, train.range) = match self.scene.depth {
                DepthRange::Metric { near, far } => (DepthSettings::Metric, [near, far + farther]),
                DepthRange::Inverse { near } => (DepthSettings::Inverse, [1.0 / near, 0.0]),
            };
        }
        settings
    }

    /// How learned poses are aligned with the true ones: as INN's paper does it on DTU, else as BARF's and L2G-NeRF's do.
    pub fn alignment(&self) -> Alignment {
        match self.scene.layout {
            Layout::Dtu => Alignment::of_inn(self.scene.train.len()),
            _ => Alignment::Procrustes,
        }
    }

    /// The similarity from the learned world to the true one; the identity where that is unknown, or known of one camera.
    pub fn similarity(&self, poses: &[Pose]) -> Result<Similarity, PoseSetError> {
        match &self.truth {
            Some(truth) if truth.len() > 1 => self.alignment().fit(poses, truth),
            _ => Ok(Similarity::identity()),
        }
    }

    /// Errors of learned poses of the training views, after alignment; none where there is nothing to compare with.
    /// Translation errors are those of the world-to-camera vectors, on DTU those of the centres, as in the papers.
    pub fn pose_scores(&self, poses: &[Pose]) -> Result<Measured, PoseSetError> {
        let Some(truth) = self.truth.as_ref().filter(|t| t.len() > 1) else { return Ok(Measured::default()) };
        let errors = pose_errors(&self.similarity(poses)?.align(poses), truth)?;
        let lengths = if self.scene.layout == Layout::Dtu { &errors.center } else { &errors.translation };
        let scores = errors.rotation_deg().into_iter().zip(lengths).map(|(degrees, length)| Scores {
            rotation_error_deg: Some(degrees),
            translation_error_x100: Some(100.0 * length),
            ..Scores::default()
        });
        let views = self.scene.train.iter().zip(scores);
        Ok(Measured::new(views.map(|(v, scores)| ViewScores { view: v.name.clone(), scores }).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dtu_is_measured_by_centres_and_the_other_scenes_by_translation_vectors() {
        let dir = tempfile::tempdir().unwrap();
        make_scene(dir.path(), &MakeOptions { views: 12, size: 8, seed: 0 }, &|_, _| {}).unwrap();
        let mut layered = Layered::load("l2g-small").unwrap();
        for set in [&format!("scene.path={}", dir.path().display()), "scene.image_size=[8,8]"] {
            layered.set(set).unwrap();
        }
        let mut data = SpaceData::load(&layered, &|_, _| {}).unwrap();
        let truth = data.truth.clone().unwrap();
        // Cameras turned about their own centres, in a world of another place and scale.
        let turn = Pose::exp(&[0.0, 0.1, 0.0, 0.0, 0.0, 0.0]);
        let world = Similarity { scale: 2.0, rotation: turn.rotation, ..Similarity::identity() };
        let found = world.align(&truth.iter().map(|p| turn.after(p)).collect::<Vec<_>>());
        let of = |data: &SpaceData| {
            let mean = data.pose_scores(&found).unwrap().mean;
            (mean.rotation_error_deg.unwrap(), mean.translation_error_x100.unwrap())
        };
        let (degrees, vectors) = of(&data);
        assert!((degrees - 0.1f64.to_degrees()).abs() < 1e-6 && vectors > 30.0, "{degrees} {vectors}");
        data.scene.layout = Layout::Dtu;
        assert_eq!(data.alignment(), Alignment::Umeyama);
        let (degrees, centers) = of(&data);
        assert!((degrees - 0.1f64.to_degrees()).abs() < 1e-6 && centers < 1e-3, "{degrees} {centers}");
        data.truth = None;
        assert_eq!(data.pose_scores(&found).unwrap(), Measured::default());
    }
}
