//! Where registration starts: the true poses, the identity, the true ones disturbed as the papers do it, or a file's.
//!
//! BARF moves the world under a camera, P = P_gt o Exp(0.15 N), so that cameras keep looking at the object; L2G moves the
//! camera itself, P = E o P_gt with E = [Exp(n_r N) | n_t N]. All noise of a run is in one JSON file, since no seed
//! reproduces it elsewhere; its poses are of the loaded world ([`super::WorldFrame`]). Poses of other programs are
//! [`super::NamedPoses`].

use super::check::FARTHEST;
use crate::data::Random;
use crate::geometry::Pose;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How initial poses come about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InitialPoses {
    /// The reference poses.
    Truth,
    /// [I | 0] for every camera: forward-facing captures, and cameras of which nothing is known.
    Identity,
    /// BARF's noise; the standard deviation of all six numbers of a twist, 0.15 in the paper.
    Barf { deviation: f64 },
    /// L2G's noise; standard deviations of rotation vector (radians) and translation.
    L2g { rotation: f64, translation: f64 },
}

/// Initial poses, and the noise between them and the true ones where there was any.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseStart {
    pub poses: Vec<Pose>,
    /// One rigid motion a camera; on the side of the true pose that `side` says.
    pub noise: Option<(Side, Vec<Pose>)>,
}

/// The side of the true pose on which its noise stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// Noise after the pose, in the camera's frame (L2G).
    Camera,
    /// Noise before the pose, in the world (BARF).
    World,
}

/// The file of initial poses. Either list may be missing, not both.
#[derive(Serialize, Deserialize)]
struct File {
    /// What the lists mean, for readers of the file.
    #[serde(default)]
    order: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    seed: Option<u32>,
    /// The views that the rows are of, and their reference poses where those are known: what the file was written for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    views: Vec<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    reference: Option<Vec<[f64; 12]>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    side: Option<Side>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    noise: Option<Vec<[f64; 12]>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    poses: Option<Vec<[f64; 12]>>,
}

impl File {
    fn read(path: &Path) -> Result<File, NoiseError> {
        let format = |message: String| NoiseError::Format { path: path.into(), message };
        let text = std::fs::read_to_string(path).map_err(|source| NoiseError::Read { path: path.into(), source })?;
        let mut json = serde_json::Deserializer::from_str(&text);
        serde_path_to_error::deserialize(&mut json).map_err(|e| match e.path().to_string() {
            field if field == "." => format(e.inner().to_string()),
            field => format(format!("`{field}`: {}", e.inner())),
        })
    }
}

const ORDER: &str = "one camera a row: [R | t] row by row, world to camera; side `world`: pose = truth o noise, `camera`: noise o truth";

/// Why there are no initial poses.
#[derive(Debug, thiserror::Error)]
pub enum NoiseError {
    #[error("cannot read the pose file {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{}: not a file of poses: {message}", .path.display())]
    Format { path: PathBuf, message: String },
    #[error(transparent)]
    Scene(#[from] super::SceneError),
    #[error("{}: `{list}` has {found} cameras, but the scene has {expected} training views", .path.display())]
    Count { path: PathBuf, list: &'static str, found: usize, expected: usize },
    #[error(
        "the scene is not the one that the run learned from: its training view {} `{found}` {difference}, see {}",
        .at + 1, .path.display()
    )]
    OtherScene { path: PathBuf, at: usize, found: String, difference: String },
    #[error(
        "{what} needs reference poses, but view `{view}` has none; start from the identity or from a file of poses"
    )]
    NoTruth { what: String, view: String },
}

impl InitialPoses {
    /// BARF's noise as published.
    pub const BARF: InitialPoses = InitialPoses::Barf { deviation: 0.15 };

    /// Draws the noise of a seed. `views` gives name and reference pose of every training view.
    pub fn draw<'a>(
        self,
        views: impl IntoIterator<Item = (&'a str, Option<Pose>)>,
        seed: u32,
    ) -> Result<PoseStart, NoiseError> {
        let views: Vec<(&str, Option<Pose>)> = views.into_iter().collect();
        let (n, mut random) = (views.len(), Random::new(seed, "pose noise"));
        let (side, noise) = match self {
            InitialPoses::Identity => return Ok(PoseStart { poses: vec![Pose::identity(); n], noise: None }),
            InitialPoses::Truth => {
                return Ok(PoseStart { poses: truth(&views, "starting at the truth")?, noise: None });
            }
            InitialPoses::Barf { deviation } => {
                (Side::World, (0..n).map(|_| Pose::exp(&random.normals(deviation))).collect())
            }
            InitialPoses::L2g { rotation, translation } => {
                // All rotations first, then all translations.
                let turns: Vec<[f64; 3]> = (0..n).map(|_| random.normals(rotation)).collect();
                let one = |[a, b, c]: [f64; 3]| {
                    let shift: [f64; 3] = random.normals(translation);
                    Pose { translation: shift.into(), ..Pose::exp(&[a, b, c, 0.0, 0.0, 0.0]) }
                };
                (Side::Camera, turns.into_iter().map(one).collect())
            }
        };
        PoseStart::disturbed(&truth(&views, "pose noise")?, side, noise)
    }
}

fn truth(views: &[(&str, Option<Pose>)], what: &str) -> Result<Vec<Pose>, NoiseError> {
    let known = |(name, pose): &(&str, Option<Pose>)| {
        pose.ok_or_else(|| NoiseError::NoTruth { what: what.to_string(), view: name.to_string() })
    };
    views.iter().map(known).collect()
}

impl PoseStart {
    fn disturbed(truth: &[Pose], side: Side, noise: Vec<Pose>) -> Result<PoseStart, NoiseError> {
        let one = |(p, e): (&Pose, &Pose)| match side {
            Side::World => p.after(e),
            Side::Camera => e.after(p),
        };
        Ok(PoseStart { poses: truth.iter().zip(&noise).map(one).collect(), noise: Some((side, noise)) })
    }

    /// Loads a file: its `noise` on the reference poses if it has any, else its `poses`.
    pub fn load<'a>(
        path: &Path,
        views: impl IntoIterator<Item = (&'a str, Option<Pose>)>,
    ) -> Result<PoseStart, NoiseError> {
        let views: Vec<(&str, Option<Pose>)> = views.into_iter().collect();
        let format = |message: String| NoiseError::Format { path: path.into(), message };
        let file = File::read(path)?;
        let checked = |list: &'static str, rows: Vec<[f64; 12]>| {
            if rows.len() != views.len() {
                let (found, expected) = (rows.len(), views.len());
                return Err(NoiseError::Count { path: path.into(), list, found, expected });
            }
            let poses: Vec<Pose> = rows.iter().map(|r| Pose::from_rows(r)).collect();
            let far = |p: &Pose| p.translation.iter().any(|x| x.abs() > FARTHEST);
            match poses.iter().position(|p| p.rigidity_error() > 1e-3 || far(p)) {
                Some(i) => {
                    Err(format(format!("`{list}[{i}]`: expected a rotation and a translation of numbers below 1e15")))
                }
                None => Ok(poses),
            }
        };
        match (file.noise, file.side, file.poses) {
            (Some(noise), Some(side), _) => {
                PoseStart::disturbed(&truth(&views, "the noise of a file")?, side, checked("noise", noise)?)
            }
            (Some(_), None, _) => Err(format("`noise` needs `side`: expected \"world\" or \"camera\"".to_string())),
            (None, _, Some(poses)) => Ok(PoseStart { poses: checked("poses", poses)?, noise: None }),
            (None, _, None) => {
                let expected = "expected `poses`, or `noise` and `side` (as in initial_poses.json of a run), `views` and \
                                `aligned` (as in its poses.json), or `frames` (as in transforms.json)";
                Err(format(expected.to_string()))
            }
        }
    }

    /// Refuses views other than those that a file was written for: of other names, or of other reference poses. Files of
    /// poses that say nothing of views fit all.
    pub fn check_views<'a>(
        path: &Path,
        views: impl IntoIterator<Item = (&'a str, Option<Pose>)>,
    ) -> Result<(), NoiseError> {
        let file = File::read(path)?;
        let views: Vec<(&str, Option<Pose>)> = views.into_iter().collect();
        if file.views.is_empty() {
            return Ok(());
        }
        if file.views.len() != views.len() {
            let (found, expected) = (file.views.len(), views.len());
            return Err(NoiseError::Count { path: path.into(), list: "views", found, expected });
        }
        for (at, (name, pose)) in views.iter().enumerate() {
            let other = |difference: String| {
                Err(NoiseError::OtherScene { path: path.into(), at, found: name.to_string(), difference })
            };
            if file.views[at] != *name {
                return other(format!("was `{}`", file.views[at]));
            }
            let known = file.reference.as_ref().and_then(|rows| rows.get(at)).map(|row| Pose::from_rows(row));
            let apart = known.zip(*pose).map_or(0.0, |(a, b)| {
                (a.rotation - b.rotation).norm() + (a.translation - b.translation).norm() / (1.0 + b.translation.norm())
            });
            if apart > 1e-6 {
                return other("had another reference pose".to_string());
            }
        }
        Ok(())
    }

    /// The file that loads as this start, of these views.
    pub fn to_json<'a>(&self, seed: Option<u32>, views: impl IntoIterator<Item = (&'a str, Option<Pose>)>) -> String {
        let (names, reference): (Vec<&str>, Vec<Option<Pose>>) = views.into_iter().unzip();
        let reference: Option<Vec<Pose>> = reference.into_iter().collect();
        let rows = |poses: &[Pose]| poses.iter().map(|p| p.to_rows()).collect();
        let file = File {
            order: ORDER.to_string(),
            seed,
            views: names.iter().map(|n| n.to_string()).collect(),
            reference: reference.as_deref().map(rows),
            side: self.noise.as_ref().map(|n| n.0),
            noise: self.noise.as_ref().map(|n| rows(&n.1)),
            poses: Some(rows(&self.poses)),
        };
        // A struct of numbers and strings always has a JSON form.
        serde_json::to_string_pretty(&file).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras(n: i32) -> Vec<Pose> {
        (0..n).map(|i| Pose::exp(&[0.1 * f64::from(i), 0.3, -0.2, 0.5, f64::from(i), 4.0])).collect()
    }

    fn views(poses: &[Pose]) -> impl Iterator<Item = (&'static str, Option<Pose>)> {
        poses.iter().map(|p| ("view", Some(*p)))
    }

    #[test]
    fn noise_stands_on_its_side_and_reloads() {
        let truth = cameras(7);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.json");
        let l2g = InitialPoses::L2g { rotation: 0.07, translation: 0.5 };
        for kind in [InitialPoses::BARF, l2g, InitialPoses::Truth, InitialPoses::Identity] {
            let start = kind.draw(views(&truth), 3).unwrap();
            assert_eq!(start, kind.draw(views(&truth), 3).unwrap());
            for (i, pose) in start.poses.iter().enumerate() {
                let expected = match (kind, &start.noise) {
                    (InitialPoses::Barf { .. }, Some((Side::World, e))) => truth[i].after(&e[i]),
                    (InitialPoses::L2g { .. }, Some((Side::Camera, e))) => e[i].after(&truth[i]),
                    (InitialPoses::Truth, None) => truth[i],
                    (InitialPoses::Identity, None) => Pose::identity(),
                    other => panic!("{other:?}"),
                };
                assert_eq!(*pose, expected);
            }
            std::fs::write(&path, start.to_json(Some(3), views(&truth))).unwrap();
            assert_eq!(PoseStart::load(&path, views(&truth)).unwrap(), start);
        }
    }

    /// BARF's mean angle is 0.15 sqrt(8 / pi) = 13.7 degrees; L2G's translations have their deviation.
    #[test]
    fn sizes_of_the_noise() {
        let truth = cameras(2000);
        let barf = InitialPoses::BARF.draw(views(&truth), 0).unwrap().noise.unwrap().1;
        let angle = |p: &Pose| ((p.rotation.trace() - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees();
        let mean = barf.iter().map(angle).sum::<f64>() / 2000.0;
        assert!((mean - 13.7).abs() < 0.5, "{mean}");
        let l2g = InitialPoses::L2g { rotation: 0.09, translation: 0.7 };
        let l2g = l2g.draw(views(&truth), 0).unwrap().noise.unwrap().1;
        let square = l2g.iter().map(|p| p.translation.norm_squared()).sum::<f64>() / 6000.0;
        assert!((square.sqrt() - 0.7).abs() < 0.03, "{square}");
    }

    #[test]
    fn files_know_their_views() {
        let truth = cameras(3);
        let named = |names: [&'static str; 3], poses: &[Pose]| -> Vec<(&'static str, Option<Pose>)> {
            names.into_iter().zip(poses.iter().map(|p| Some(*p))).collect()
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("initial_poses.json");
        let start = InitialPoses::Identity.draw(views(&truth), 0).unwrap();
        std::fs::write(&path, start.to_json(None, named(["a", "b", "c"], &truth))).unwrap();
        let check = |views: Vec<(&str, Option<Pose>)>| PoseStart::check_views(&path, views).map_err(|e| e.to_string());
        assert_eq!(check(named(["a", "b", "c"], &truth)), Ok(()));
        assert_eq!(check(vec![("a", None), ("b", None), ("c", None)]), Ok(()));
        let mut moved = truth.clone();
        moved[1].translation.x += 1e-3;
        for (views, expected) in [
            (named(["a", "x", "c"], &truth), "view 2 `x` was `b`"),
            (named(["a", "b", "c"], &moved), "view 2 `b` had another reference pose"),
            (named(["a", "b", "c"], &truth)[..2].to_vec(), "`views` has 3 cameras, but the scene has 2"),
        ] {
            let error = check(views).unwrap_err();
            assert!(error.contains(expected) && error.contains("initial_poses.json"), "{error}");
        }
        std::fs::write(&path, start.to_json(None, [])).unwrap();
        assert_eq!(check(named(["a", "x", "c"], &truth)), Ok(()));
    }

    #[test]
    fn unusable_files_and_unknown_truth() {
        let truth = cameras(2);
        let unknown = InitialPoses::BARF.draw([("a.png", None)], 0).unwrap_err().to_string();
        assert!(unknown.contains("a.png") && unknown.contains("identity"), "{unknown}");
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.json");
        let three = InitialPoses::Identity.draw(views(&cameras(3)), 0).unwrap().to_json(None, []);
        let skewed = r#"{"poses": [[1,0,0,0, 0,1,0,0, 0,0,1,0], [1,0.5,0,0, 0,1,0,0, 0,0,1,0]]}"#;
        for (text, expected) in [
            (three.as_str(), "`poses` has 3 cameras, but the scene has 2"),
            (skewed, "`poses[1]`: expected a rotation"),
            (r#"{"noise": []}"#, "`noise` needs `side`"),
            (r#"{"side": "world"}"#, "expected `poses`"),
            (r#"{"poses": [[1, 2]]}"#, "`poses[0]`"),
            ("not JSON", "poses.json"),
        ] {
            std::fs::write(&path, text).unwrap();
            let found = PoseStart::load(&path, views(&truth)).unwrap_err().to_string();
            assert!(found.contains(expected), "{found}");
        }
        assert!(
            PoseStart::load(&dir.path().join("no.json"), views(&truth)).unwrap_err().to_string().contains("no.json")
        );
    }
}
