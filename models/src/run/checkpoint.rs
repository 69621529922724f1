//! Checkpoints: every parameter and state in a safetensors file, and a manifest that says what it belongs to.
//!
//! The tensors are written first, under a name of their own; the manifest, which names the file and its digest, is put
//! in place last. So at every instant the manifest on the disk points to a complete file.

use super::files::{WriteError, write_atomically};
use super::metrics::Entry;
use crate::training::loss_scale;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the manifest in the run folder.
pub const MANIFEST: &str = "checkpoint.json";
const FORMAT: &str = "raygrad checkpoint 1";

/// A tensor by value: f32, in the engine's order.
#[derive(Clone, Debug, PartialEq)]
pub struct Saved {
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

/// Everything needed to continue a run bit by bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Steps done.
    pub step: usize,
    pub seconds: f64,
    pub steps: Vec<Entry>,
    pub tensors: BTreeMap<String, Saved>,
}

#[derive(Serialize, Deserialize)]
struct Manifest {
    format: String,
    raygrad: String,
    step: usize,
    seconds: f64,
    tensors: String,
    bytes: u64,
    blake3: String,
    steps: Vec<Entry>,
}

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("cannot read the checkpoint {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{} is not a checkpoint of raygrad: {problem}", .path.display())]
    Foreign { path: PathBuf, problem: String },
    #[error("{} is damaged: {problem}", .path.display())]
    Damaged { path: PathBuf, problem: String },
    #[error("{} does not belong to this model: {problem}", .path.display())]
    Misfit { path: PathBuf, problem: String },
}

impl Checkpoint {
    /// Writes tensors and manifest into the folder, then removes the tensors of the checkpoint before.
    pub fn save(&self, folder: &Path) -> Result<(), CheckpointError> {
        let manifest = folder.join(MANIFEST);
        let before = read_manifest(&manifest).ok().map(|m| m.tensors);
        let name = format!("checkpoint-{:07}.safetensors", self.step);
        let path = folder.join(&name);
        let bytes =
            self.to_safetensors().map_err(|e| WriteError { path: path.clone(), source: std::io::Error::other(e) })?;
        write_atomically(&path, &bytes)?;
        let content = Manifest {
            format: FORMAT.to_string(),
            raygrad: env!("CARGO_PKG_VERSION").to_string(),
            step: self.step,
            seconds: self.seconds,
            tensors: name.clone(),
            bytes: bytes.len() as u64,
            blake3: blake3::hash(&bytes).to_hex().to_string(),
            steps: self.steps.clone(),
        };
        let text = serde_json::to_string_pretty(&content)
            .map_err(|e| WriteError { path: manifest.clone(), source: std::io::Error::other(e) })?;
        write_atomically(&manifest, text.as_bytes())?;
        if let Some(before) = before.filter(|b| *b != name && is_plain_name(b)) {
            // The new checkpoint is complete; an old file that will not go away does no harm.
            let _ = std::fs::remove_file(folder.join(before));
        }
        Ok(())
    }

    /// Reads the checkpoint of a folder; `expected` are the names and shapes the model needs.
    pub fn load(folder: &Path, expected: &BTreeMap<String, Vec<usize>>) -> Result<Checkpoint, CheckpointError> {
        let manifest = read_manifest(&folder.join(MANIFEST))?;
        let path = folder.join(&manifest.tensors);
        let bytes = std::fs::read(&path).map_err(|source| CheckpointError::Read { path: path.clone(), source })?;
        let damaged = |problem: String| CheckpointError::Damaged { path: path.clone(), problem };
        if bytes.len() as u64 != manifest.bytes {
            return Err(damaged(format!("expected {} bytes, found {}", manifest.bytes, bytes.len())));
        }
        if blake3::hash(&bytes).to_hex().as_str() != manifest.blake3 {
            return Err(damaged("its content does not match the digest in the manifest".to_string()));
        }
        let file = SafeTensors::deserialize(&bytes).map_err(|e| damaged(e.to_string()))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.iter() {
            if view.dtype() != Dtype::F32 {
                return Err(damaged(format!("`{name}` is {:?}, expected F32", view.dtype())));
            }
            let values = view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            tensors.insert(name.to_string(), Saved { shape: view.shape().to_vec(), values });
        }
        // A run may go on, or be evaluated, on a device that scales the loss where this one did not, or the other way round.
        for name in loss_scale::STATES {
            match expected.get(name) {
                None => drop(tensors.remove(name)),
                Some(shape) => {
                    let zeros = || Saved { shape: shape.clone(), values: vec![0.0; shape.iter().product()] };
                    tensors.entry(name.to_string()).or_insert_with(zeros);
                }
            }
        }
        check_fit(&path, &tensors, expected)?;
        Ok(Checkpoint { step: manifest.step, seconds: manifest.seconds, steps: manifest.steps, tensors })
    }

    fn to_safetensors(&self) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let data: Vec<(&String, &Saved, Vec<u8>)> = (self.tensors.iter())
            .map(|(name, t)| (name, t, t.values.iter().flat_map(|v| v.to_le_bytes()).collect()))
            .collect();
        let view = |t: &Saved, bytes| TensorView::new(Dtype::F32, t.shape.clone(), bytes);
        let views: Result<Vec<_>, _> =
            data.iter().map(|(name, t, bytes)| view(t, bytes.as_slice()).map(|v| (*name, v))).collect();
        // One entry only: they are written in no fixed order, and equal checkpoints are to be equal files.
        safetensors::serialize(views?, Some([("format".to_string(), FORMAT.to_string())].into()))
    }
}

/// A file name without any folder: manifests are data, and must not make this program delete something elsewhere.
fn is_plain_name(name: &str) -> bool {
    Path::new(name).file_name().is_some_and(|f| f == name) && name.starts_with("checkpoint-")
}

fn read_manifest(path: &Path) -> Result<Manifest, CheckpointError> {
    let text = std::fs::read(path).map_err(|source| CheckpointError::Read { path: path.into(), source })?;
    let foreign = |problem: String| CheckpointError::Foreign { path: path.into(), problem };
    let manifest: Manifest = serde_json::from_slice(&text).map_err(|e| foreign(e.to_string()))?;
    if manifest.format != FORMAT {
        return Err(foreign(format!("expected format \"{FORMAT}\", found \"{}\"", manifest.format)));
    }
    if !is_plain_name(&manifest.tensors) {
        return Err(foreign(format!("\"{}\" is not the name of a checkpoint file", manifest.tensors)));
    }
    Ok(manifest)
}

fn check_fit(
    path: &Path,
    tensors: &BTreeMap<String, Saved>,
    expected: &BTreeMap<String, Vec<usize>>,
) -> Result<(), CheckpointError> {
    let misfit = |problem: String| Err(CheckpointError::Misfit { path: path.into(), problem });
    for (name, shape) in expected {
        match tensors.get(name) {
            None => return misfit(format!("it lacks `{name}`")),
            Some(t) if t.shape != *shape => {
                return misfit(format!("`{name}` has the shape {:?}, expected {shape:?}", t.shape));
            }
            Some(_) => {}
        }
    }
    match tensors.keys().find(|name| !expected.contains_key(*name)) {
        Some(name) => misfit(format!("this model has no `{name}`")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loss_scale_comes_and_goes_with_devices() {
        let dir = tempfile::tempdir().unwrap();
        let scale = |values| Saved { shape: vec![1], values };
        let [held, steps] = loss_scale::STATES.map(str::to_string);
        let mut saved = example();
        saved.tensors.extend([(held.clone(), scale(vec![512.0])), (steps.clone(), scale(vec![7.0]))]);
        saved.save(dir.path()).unwrap();
        let mut expected = BTreeMap::from([("w".to_string(), vec![2, 3])]);
        assert_eq!(Checkpoint::load(dir.path(), &expected).unwrap().tensors, example().tensors);
        expected.extend([(held.clone(), vec![1]), (steps, vec![1])]);
        assert_eq!(Checkpoint::load(dir.path(), &expected).unwrap().tensors, saved.tensors);
        // Where there is none, it starts with its first value, which 0 stands for.
        example().save(dir.path()).unwrap();
        assert_eq!(Checkpoint::load(dir.path(), &expected).unwrap().tensors[&held].values, [0.0]);
    }

    fn example() -> Checkpoint {
        let saved = Saved { shape: vec![2, 3], values: vec![1.0, -0.0, f32::MIN_POSITIVE, 3.5, 1e-40, 7.0] };
        Checkpoint { step: 12, seconds: 1.5, steps: vec![], tensors: BTreeMap::from([("w".to_string(), saved)]) }
    }

    #[test]
    fn survives_a_round_trip_and_replaces_its_predecessor() {
        let dir = tempfile::tempdir().unwrap();
        let expected = BTreeMap::from([("w".to_string(), vec![2, 3])]);
        let mut c = example();
        c.save(dir.path()).unwrap();
        c.step = 13;
        c.save(dir.path()).unwrap();
        assert_eq!(Checkpoint::load(dir.path(), &expected).unwrap(), c);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn truncated_and_foreign_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let expected = BTreeMap::from([("w".to_string(), vec![2, 3])]);
        let error = |expected: &BTreeMap<_, _>| Checkpoint::load(dir.path(), expected).unwrap_err().to_string();
        example().save(dir.path()).unwrap();
        assert!(error(&BTreeMap::from([("w".to_string(), vec![3, 3])])).contains("shape [2, 3], expected [3, 3]"));
        assert!(error(&BTreeMap::new()).contains("this model has no `w`"));
        let more = BTreeMap::from([("w".to_string(), vec![2, 3]), ("v".to_string(), vec![1])]);
        assert!(error(&more).contains("checkpoint-0000012.safetensors does not belong to this model: it lacks `v`"));
        let tensors = dir.path().join("checkpoint-0000012.safetensors");
        let bytes = std::fs::read(&tensors).unwrap();
        std::fs::write(&tensors, &bytes[..bytes.len() - 5]).unwrap();
        assert!(error(&expected).contains("expected"), "{}", error(&expected));
        let mut flipped = bytes.clone();
        *flipped.last_mut().unwrap() ^= 1;
        std::fs::write(&tensors, flipped).unwrap();
        assert!(error(&expected).contains("digest"));
        std::fs::write(dir.path().join(MANIFEST), "{\"weights\": 3}").unwrap();
        assert!(error(&expected).contains("not a checkpoint of raygrad"));
    }
}
