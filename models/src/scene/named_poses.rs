//! Poses of other programs to start from: a COLMAP model, a `transforms.json`, or the `poses.json` of a run. They go to the
//! views that have their names.

use super::json::{self, pose_of_opengl};
use super::{NoiseError, Pose, SceneError, colmap};
use serde::Deserialize;
use std::collections::HashMap;
use std::path::Path;

/// Poses by the names of images.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedPoses {
    /// World to camera.
    pub poses: Vec<(String, Pose)>,
    pub world: World,
}

/// The world of named poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum World {
    /// That of the loaded scene.
    Loaded,
    /// Some world of another program.
    Other,
}

#[derive(Deserialize)]
struct Frames {
    frames: Vec<Frame>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
}

/// The `poses.json` of a run.
#[derive(Deserialize)]
struct Found {
    views: Vec<String>,
    aligned: Vec<[f64; 12]>,
}

impl NamedPoses {
    /// The poses of a COLMAP model's folder, or of a file; nothing if the file is none of these kinds.
    pub fn load(path: &Path) -> Result<Option<NamedPoses>, SceneError> {
        if path.is_dir() {
            let poses = colmap::poses(path)?;
            return Ok(Some(NamedPoses { poses, world: World::Other }));
        }
        if path.extension().is_some_and(|e| e == "bin" || e == "txt" || e == "npy") {
            let message = "expected a JSON file of poses, or the folder of a COLMAP model".to_string();
            return Err(SceneError::Format { path: path.into(), message });
        }
        let keys: serde_json::Map<String, serde_json::Value> = json::read(path)?;
        if keys.contains_key("frames") {
            let file: Frames = json::read(path)?;
            let pose = |(i, f): (usize, Frame)| {
                let pose = pose_of_opengl(&f.transform_matrix, path, format!("frames[{i}].transform_matrix"))?;
                Ok((f.file_path, pose))
            };
            let poses = file.frames.into_iter().enumerate().map(pose).collect::<Result<_, SceneError>>()?;
            return Ok(Some(NamedPoses { poses, world: World::Other }));
        }
        if keys.contains_key("aligned") {
            let file: Found = json::read(path)?;
            let pose = |(i, row): (usize, [f64; 12])| {
                super::check_pose(Pose::from_rows(&row), path, || format!("aligned[{i}]"))
            };
            let poses = file.aligned.into_iter().enumerate().map(pose).collect::<Result<Vec<_>, _>>()?;
            if poses.len() != file.views.len() {
                let message = format!("{} `views`, but {} poses `aligned`", file.views.len(), poses.len());
                return Err(SceneError::Format { path: path.into(), message });
            }
            return Ok(Some(NamedPoses { poses: file.views.into_iter().zip(poses).collect(), world: World::Loaded }));
        }
        Ok(None)
    }

    /// A pose, or nothing, for each of these views. Endings of names do not count, nor do folders that one of two names lacks, where
    /// the rest is unique.
    ///
    /// # Errors
    /// If no view has a pose.
    pub fn of_views(&self, path: &Path, views: &[&str]) -> Result<Vec<Option<Pose>>, NoiseError> {
        let whole: HashMap<&str, Pose> = self.poses.iter().map(|(name, pose)| (without_ending(name), *pose)).collect();
        let mut short: HashMap<&str, Option<(&str, Pose)>> = HashMap::new();
        for (name, pose) in &self.poses {
            short.entry(last(name)).and_modify(|p| *p = None).or_insert(Some((without_ending(name), *pose)));
        }
        let alike = |view: &str| {
            let (view, (name, pose)) = (without_ending(view), (*short.get(last(view))?)?);
            let is_end = |of: &str, end: &str| of.strip_suffix(end).is_some_and(|rest| rest.ends_with(['/', '\\']));
            (is_end(view, name) || is_end(name, view)).then_some(pose)
        };
        let of = |view: &&str| whole.get(without_ending(view)).copied().or_else(|| alike(view));
        let found: Vec<Option<Pose>> = views.iter().map(of).collect();
        if found.iter().all(Option::is_none) {
            let name = |n: Option<&str>| n.map_or("nothing".to_string(), |n| format!("`{n}`"));
            let (view, pose) = (name(views.first().copied()), name(self.poses.first().map(|p| p.0.as_str())));
            let message = format!("its poses are of other images: the scene has {view}, the file {pose}");
            return Err(NoiseError::Format { path: path.into(), message });
        }
        Ok(found)
    }
}

fn without_ending(name: &str) -> &str {
    let name = name.strip_prefix("./").unwrap_or(name);
    match name.rsplit_once('.') {
        Some((stem, ending)) if !ending.contains('/') => stem,
        _ => name,
    }
}

fn last(name: &str) -> &str {
    without_ending(name).rsplit(['/', '\\']).next().unwrap_or(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_match_without_endings_and_folders() {
        let pose = |x: f64| Pose::exp(&[0.1, 0.2, 0.3, x, 0.0, 1.0]);
        let of = |names: &[&str]| NamedPoses {
            poses: names.iter().enumerate().map(|(i, n)| (n.to_string(), pose(i as f64))).collect(),
            world: World::Other,
        };
        let path = Path::new("model");
        let named = of(&["images/b.png", "images/a.JPG"]);
        let found = named.of_views(path, &["a.jpg", "./images/b", "c.png"]).unwrap();
        assert_eq!(found, [Some(pose(1.0)), Some(pose(0.0)), None]);
        // The last part of two names says nothing.
        let found = of(&["left/a.png", "right/a.png", "b.v2.png"]).of_views(path, &["right/a.png", "a", "b.v2.jpg"]);
        assert_eq!(found.unwrap(), [Some(pose(1.0)), None, Some(pose(2.0))]);
        // Neither do two folders.
        let found = of(&["val/a.png", "b.png"]).of_views(path, &["./train/a.png", "./train/b.png", "far/val/a"]);
        assert_eq!(found.unwrap(), [None, Some(pose(1.0)), Some(pose(0.0))]);
        let error = named.of_views(path, &["x.png"]).unwrap_err().to_string();
        assert!(error.contains("model") && error.contains("`x.png`") && error.contains("`images/b.png`"), "{error}");
    }

    #[test]
    fn kinds_of_files() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.json");
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            NamedPoses::load(&path)
        };
        let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let text = format!(r#"{{"views": ["a"], "learned": [], "aligned": [{identity:?}]}}"#);
        let found = load(&text).unwrap().unwrap();
        assert_eq!((found.poses, found.world), (vec![("a".to_string(), Pose::identity())], World::Loaded));
        let frame = r#"{"frames": [{"file_path": "b.png", "transform_matrix": [[1,0,0,0],[0,-1,0,0],[0,0,-1,0]]}]}"#;
        let found = load(frame).unwrap().unwrap();
        assert_eq!((found.poses, found.world), (vec![("b.png".to_string(), Pose::identity())], World::Other));
        assert_eq!(load(r#"{"poses": []}"#).unwrap(), None);
        for (text, expected) in [
            (r#"{"views": ["a"], "aligned": []}"#, "1 `views`, but 0 poses"),
            (r#"{"views": ["a"], "aligned": [[2,0,0,0, 0,1,0,0, 0,0,1,0]]}"#, "aligned[0]"),
            (r#"{"frames": [{"file_path": "b.png"}]}"#, "frames[0]"),
            ("[1]", "poses.json"),
        ] {
            let error = load(text).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("poses.json"), "{error}");
        }
        let error = NamedPoses::load(dir.path()).unwrap_err().to_string();
        assert!(error.contains("COLMAP"), "{error}");
    }
}
