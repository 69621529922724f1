//! The data of a 3D run: a scene, and the poses that training starts from.

use super::model::{NotInSpace, sections};
use super::rays::ImageSize;
use crate::config::{ConfigError, DepthSettings, Layered, NoiseKind, Settings};
use crate::evaluation::{Alignment, Measured, PoseSetError, Scores, Similarity, ViewScores, pose_errors};
use crate::geometry::Pose;
use crate::run::files::WriteError;
use crate::scene::make_scene::{MakeError, MakeOptions, make_scene};
use crate::scene::noise::{InitialPoses, NoiseError, PoseStart, Side};
use crate::scene::{self, DepthRange, DtuSplit, Layout, LoadOptions, NamedPoses, Scene, SceneError, View, World};
use std::path::Path;

/// The path that stands for the procedural scene.
const BUILTIN: &str = "builtin";
/// The file of a run with the poses that it starts from.
pub const START: &str = "initial_poses.json";
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
            layout: Layout::from_name(&wanted.layout),
            dtu_split: DtuSplit::from_name(&wanted.dtu_split).unwrap_or_default(),
            focal: (wanted.focal > 0.0).then_some(wanted.focal),
            no_train_depths: true,
            published_rotations: wanted.published_rotations,
            ..LoadOptions::default()
        };
        let mut scene = match wanted.path.as_str() {
            BUILTIN => {
                let folder = tempfile::tempdir().map_err(|source| WriteError { path: std::env::temp_dir(), source })?;
                let made = MakeOptions { views: VIEWS, size: picture[0].max(picture[1]), seed: 0 };
                make_scene(folder.path(), &made, progress)?;
                scene::load(folder.path(), &options, &|_, _| {})?
            }
            path => scene::load(Path::new(path), &options, progress)?,
        };
        let truth: Option<Vec<Pose>> = scene.train.iter().map(|v: &View| v.pose).collect();
        let names = || scene.training_poses();
        let (noise, seed, mut notes) = (&settings.noise, settings.run.seed, vec![]);
        let start = match (wanted.poses_in(scene.layout), noise.kind) {
            ("truth", _) => InitialPoses::Truth.draw(names(), seed)?,
            ("identity", _) => {
                let mut start = InitialPoses::Identity.draw(names(), seed)?;
                // On DTU, as the INN paper does it, from where the cameras are on average.
                if let (Layout::Dtu, Some(truth)) = (scene.layout, &truth) {
                    let mean = truth.iter().map(Pose::center).sum::<nalgebra::Vector3<f64>>() / truth.len() as f64;
                    start.poses.iter_mut().for_each(|p| p.translation = -mean);
                }
                start
            }
            ("noisy", NoiseKind::Barf) => InitialPoses::Barf { deviation: noise.rotation }.draw(names(), seed)?,
            ("noisy", NoiseKind::L2g) => {
                InitialPoses::L2g { rotation: noise.rotation, translation: noise.translation }.draw(names(), seed)?
            }
            (file, _) if !Path::new(file).exists() => {
                let text = format!(
                    "expected \"truth\", \"identity\", \"noisy\", \"auto\", or a file or folder of poses; there is no {file}"
                );
                return Err(layered.refuse("scene.poses", text).into());
            }
            (file, _) => match NamedPoses::load(Path::new(file)).map_err(NoiseError::from)? {
                Some(named) => {
                    let (start, lacking) = started_from(&named, Path::new(file), &scene)?;
                    notes.extend(lacking);
                    start
                }
                None => {
                    PoseStart::check_views(Path::new(file), names())?;
                    PoseStart::load(Path::new(file), names())?
                }
            },
        };
        scene.notes.extend(notes);
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
        if settings.train.as_ref().is_some_and(|t| t.depth == DepthSettings::Auto) {
            let centers: Vec<_> = start.poses.iter().map(Pose::center).collect();
            let apart = centers.iter().map(|c| (c - centers[0]).norm()).fold(0.0, f64::max);
            if apart < 1e-6 {
                let text = "\"auto\" takes near and far from the spread of the cameras, and all cameras start in one place: \
                            expected \"metric\", \"inverse\" or \"scene\"";
                return Err(layered.refuse("train.depth", text).into());
            }
        }
        let size = ImageSize { height, width };
        Ok(SpaceData { size, start, truth, scene, seed })
    }

    /// Refuses a scene that is not the one that the run in a folder began with.
    pub fn check_run(&self, folder: &Path) -> Result<(), SpaceDataError> {
        let path = folder.join(START);
        if path.exists() {
            PoseStart::check_views(&path, self.scene.training_poses())?;
        }
        Ok(())
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

/// Poses of other programs as a start. Those of another world are aligned with the true ones, as the INN paper does it with
/// COLMAP's; where nothing is true they are taken for those of the scene's files. Views without a pose start at the identity, and
/// are told.
fn started_from(named: &NamedPoses, path: &Path, scene: &Scene) -> Result<(PoseStart, Option<String>), SpaceDataError> {
    let views: Vec<&str> = scene.train.iter().map(|v| v.name.as_str()).collect();
    let mut poses = named.of_views(path, &views)?;
    if named.world == World::Other {
        let both = poses.iter().zip(&scene.train).filter_map(|(found, view)| Some(((*found)?, view.pose?)));
        let (found, truth): (Vec<Pose>, Vec<Pose>) = both.unzip();
        let known = scene.train.iter().any(|v| v.pose.is_some());
        if known && truth.len() < 2 {
            let message = format!(
                "poses of {} views of which true ones are known: to be moved into the scene's world it takes two",
                truth.len()
            );
            return Err(NoiseError::Format { path: path.into(), message }.into());
        }
        if known {
            let similarity = Alignment::Pairwise.fit(&found, &truth)?;
            poses.iter_mut().flatten().for_each(|p| *p = similarity.align(&[*p])[0]);
        } else {
            poses.iter_mut().flatten().for_each(|p| *p = scene.frame.load(p));
        }
    }
    let (lacking, all) = (poses.iter().filter(|p| p.is_none()).count(), poses.len());
    let note = (lacking > 0).then(|| {
        format!("{lacking} of {all} training views have no pose in {}: they start at the identity", path.display())
    });
    let poses = poses.into_iter().map(|p| p.unwrap_or_else(Pose::identity)).collect();
    Ok((PoseStart { poses, noise: None }, note))
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

    /// A made scene, its settings, and the data of them.
    fn made(preset: &str, set: &[&str]) -> (tempfile::TempDir, Layered) {
        let dir = tempfile::tempdir().unwrap();
        make_scene(dir.path(), &MakeOptions { views: 12, size: 8, seed: 0 }, &|_, _| {}).unwrap();
        let mut layered = Layered::load(preset).unwrap();
        layered.set(&format!("scene.path={}", dir.path().display())).unwrap();
        ["scene.image_size=[8,8]"].iter().chain(set).for_each(|s| layered.set(s).unwrap());
        (dir, layered)
    }

    #[test]
    fn poses_of_another_program_are_aligned_and_matched_by_name() {
        let (dir, mut layered) = made("barf-small", &[]);
        let data = SpaceData::load(&layered, &|_, _| {}).unwrap();
        let truth = data.truth.clone().unwrap();
        // Another world, another order, one view missing.
        let turn = Pose::exp(&[0.3, -0.5, 0.1, 0.0, 0.0, 0.0]);
        let world = Similarity { scale: 3.0, rotation: turn.rotation, ..Similarity::identity() };
        let camera = |(view, pose): (&View, &Pose)| crate::evaluation::ExportCamera {
            name: format!("{}.png", view.name),
            width: 8,
            height: 8,
            focal: [9.0, 9.0],
            principal: [4.0, 4.0],
            distortion: None,
            pose: *pose,
            bounds: None,
        };
        let mut cameras: Vec<_> = data.scene.train.iter().zip(&world.align(&truth)).map(camera).collect();
        cameras.reverse();
        let missing = cameras.len() - 1 - 4;
        cameras.remove(missing);
        let (model, json) = (dir.path().join("model"), dir.path().join("cameras.json"));
        std::fs::create_dir(&model).unwrap();
        crate::evaluation::Colmap::new(&cameras).unwrap().write(&model).unwrap();
        std::fs::write(&json, crate::evaluation::transforms_json(&cameras).unwrap()).unwrap();
        for (path, start) in [(&model, "colmap"), (&json, "file")] {
            layered.set(&format!("scene.poses={}", path.display())).unwrap();
            assert_eq!(layered.settings.start_name().as_deref(), Some(start));
            let data = SpaceData::load(&layered, &|_, _| {}).unwrap();
            let note = format!("1 of 12 training views have no pose in {}", path.display());
            assert!(data.scene.notes.iter().any(|n| n.starts_with(&note)), "{:?}", data.scene.notes);
            let found = data.start.poses;
            for (i, (a, b)) in found.iter().zip(&truth).enumerate() {
                let expected = if i == 4 { Pose::identity() } else { *b };
                let apart = (a.rotation - expected.rotation).norm() + (a.translation - expected.translation).norm();
                assert!(apart < 1e-6, "view {i} is off by {apart}");
            }
        }
    }

    /// Two cameras that another program lost do not turn the world of the others.
    #[test]
    fn outliers_among_poses_of_another_program() {
        let (dir, mut layered) = made("barf-small", &[]);
        let data = SpaceData::load(&layered, &|_, _| {}).unwrap();
        let truth = data.truth.clone().unwrap();
        let path = dir.path().join("poses.json");
        let write = |poses: &[Pose]| {
            let matrix = |p: &Pose| {
                let flip = nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, -1.0, -1.0));
                let (r, c) = ((flip * p.rotation).transpose(), p.center() * 0.5);
                (0..3).map(|i| vec![r[(i, 0)], r[(i, 1)], r[(i, 2)], c[i]]).collect::<Vec<_>>()
            };
            let frame = |(view, pose): (&View, &Pose)| serde_json::json!({ "file_path": view.name, "transform_matrix": matrix(pose) });
            let frames: Vec<_> = data.scene.train.iter().zip(poses).map(frame).collect();
            std::fs::write(&path, serde_json::json!({ "frames": frames }).to_string()).unwrap();
        };
        let mut poses = truth.clone();
        let lost = Pose::exp(&[0.5, 0.9, -0.4, 1.0, 2.0, -1.0]);
        [10, 11].iter().for_each(|i| poses[*i] = lost.after(&poses[*i]));
        write(&poses);
        layered.set(&format!("scene.poses={}", path.display())).unwrap();
        let found = SpaceData::load(&layered, &|_, _| {}).unwrap().start.poses;
        for i in 0..10 {
            let apart = (found[i].rotation - truth[i].rotation).norm() + (found[i].center() - truth[i].center()).norm();
            assert!(apart < 1e-4, "view {i} is off by {apart}");
        }
        write(&poses[..1]);
        let error = SpaceData::load(&layered, &|_, _| {}).map(|d| d.start).unwrap_err().to_string();
        assert!(error.contains("poses.json") && error.contains("1 views") && error.contains("takes two"), "{error}");
    }

    #[test]
    fn starts_of_another_scene_are_refused() {
        let (dir, mut layered) = made("barf-small", &[]);
        let data = SpaceData::load(&layered, &|_, _| {}).unwrap();
        let start = dir.path().join("start.json");
        std::fs::write(&start, data.start.to_json(None, data.scene.training_poses())).unwrap();
        layered.set(&format!("scene.poses={}", start.display())).unwrap();
        assert_eq!(SpaceData::load(&layered, &|_, _| {}).unwrap().start.poses, data.start.poses);
        let other = tempfile::tempdir().unwrap();
        make_scene(other.path(), &MakeOptions { views: 12, size: 8, seed: 1 }, &|_, _| {}).unwrap();
        layered.set(&format!("scene.path={}", other.path().display())).unwrap();
        let error = SpaceData::load(&layered, &|_, _| {}).map(|d| d.start).unwrap_err().to_string();
        assert!(error.contains("start.json") && error.contains("another reference pose"), "{error}");
    }

    #[test]
    fn a_run_knows_its_scene() {
        let (_dir, layered) = made("barf-small", &[]);
        let data = SpaceData::load(&layered, &|_, _| {}).unwrap();
        let run = tempfile::tempdir().unwrap();
        data.check_run(run.path()).unwrap();
        std::fs::write(run.path().join(START), data.start.to_json(None, data.scene.training_poses())).unwrap();
        data.check_run(run.path()).unwrap();
        let other = tempfile::tempdir().unwrap();
        make_scene(other.path(), &MakeOptions { views: 12, size: 8, seed: 1 }, &|_, _| {}).unwrap();
        let mut layered = layered;
        layered.set(&format!("scene.path={}", other.path().display())).unwrap();
        let error = SpaceData::load(&layered, &|_, _| {}).unwrap().check_run(run.path()).unwrap_err().to_string();
        assert!(error.contains("not the one that the run learned from"), "{error}");
    }

    #[test]
    fn depths_of_cameras_in_one_place_are_refused() {
        let (_dir, layered) = made("l2g-blender", &["scene.poses=identity"]);
        let error = SpaceData::load(&layered, &|_, _| {}).unwrap_err().to_string();
        assert!(error.contains("`train.depth`") && error.contains("start in one place"), "{error}");
    }
}
