//! What every layout refuses.

use super::{DepthRange, Entry, Intrinsics, Pose, SceneError};
use std::collections::HashMap;
use std::path::Path;

/// Images of which some are set aside must be at least so many.
const LEAST_TO_SPLIT: usize = 10;
/// Nothing is farther from the origin of a file's world.
pub(super) const FARTHEST: f64 = 1e15;

pub(super) fn check_depth(depth: DepthRange, from: &str) -> Result<(), SceneError> {
    let (near, far) = match depth {
        DepthRange::Metric { near, far } => (near, far),
        DepthRange::Inverse { near } => (near, f64::INFINITY),
    };
    // Written so that anything that is no number fails.
    let usable = near > 0.0 && near < far && (far.is_finite() || matches!(depth, DepthRange::Inverse { .. }));
    if usable { Ok(()) } else { Err(SceneError::Depth { from: from.to_string(), near, far }) }
}

/// Refuses images that are no resized images of one shape, and those of other sizes where none is asked for.
pub(super) fn check_sizes(entries: &[&Entry], resized: bool) -> Result<(), SceneError> {
    let size = |e: &Entry| [e.intrinsics.height, e.intrinsics.width];
    let Some(first) = entries.first() else { return Ok(()) };
    let expected = size(first);
    for entry in entries {
        let (path, found, first) = (entry.image.clone(), size(entry), first.image.clone());
        if !same_shape(found, expected) {
            return Err(SceneError::MixedShapes { path, found, first, expected });
        }
        if !resized && found != expected {
            return Err(SceneError::MixedSizes { path, found, first, expected });
        }
    }
    Ok(())
}

/// Refuses a list of views in which two are the same image.
pub(super) fn check_distinct(entries: &[Entry], root: &Path) -> Result<(), SceneError> {
    let mut known: HashMap<&Path, &str> = HashMap::new();
    for entry in entries {
        if let Some(first) = known.insert(&entry.image, &entry.name) {
            let message = format!("{} is there twice: views `{first}` and `{}`", entry.image.display(), entry.name);
            return Err(SceneError::Format { path: root.into(), message });
        }
    }
    Ok(())
}

/// The camera for an image of a size, which must be of the shape that the file speaks of.
pub(super) fn resized(
    camera: &Intrinsics,
    [height, width]: [usize; 2],
    path: &Path,
    field: impl Fn() -> String,
) -> Result<Intrinsics, SceneError> {
    let refuse =
        |expected: String, found: String| Err(SceneError::Field { path: path.into(), field: field(), expected, found });
    if !same_shape([camera.height, camera.width], [height, width]) {
        let found = format!("one for {} x {}", camera.height, camera.width);
        return refuse(format!("a camera for images of {height} x {width} pixels, or those resized"), found);
    }
    let within = |c: f64, size: usize| c > 0.0 && c < size as f64;
    if !(within(camera.cx, camera.width) && within(camera.cy, camera.height)) {
        let found = format!("({}, {}) of {} x {}", camera.cx, camera.cy, camera.width, camera.height);
        return refuse("a principal point inside the image".into(), found);
    }
    Ok(camera.resized(height, width))
}

/// Whether one image can be the other one resized, sides being whole pixels.
pub(super) fn same_shape([h, w]: [usize; 2], [height, width]: [usize; 2]) -> bool {
    let [h, w, height, width] = [h, w, height, width].map(|n| n as f64);
    (h * width / w - height).abs() < width / w + 1.0 && (w * height / h - width).abs() < height / h + 1.0
}

/// Refuses a pose of a file that has something else than finite numbers in it, or no rotation.
pub(super) fn check_pose(pose: Pose, path: &Path, field: impl Fn() -> String) -> Result<Pose, SceneError> {
    let refuse = |expected: &str, found: String| {
        Err(SceneError::Field { path: path.into(), field: field(), expected: expected.into(), found })
    };
    if let Some(x) = pose.to_rows().iter().find(|x| !x.is_finite()) {
        return refuse("finite numbers", x.to_string());
    }
    if let Some(x) = pose.translation.iter().find(|x| x.abs() > FARTHEST) {
        return refuse("a translation below 1e15", format!("{x:e}"));
    }
    match pose.rigidity_error() {
        e if e.is_infinite() => refuse("a rotation", "a reflection or a singular matrix".into()),
        e if e > 1e-3 => refuse("a rotation", format!("a matrix with R R^T off the identity by {e:.1e}")),
        _ => Ok(pose),
    }
}

pub(super) fn enough_to_split(root: &Path, found: usize) -> Result<(), SceneError> {
    if found < LEAST_TO_SPLIT {
        return Err(SceneError::TooFew { root: root.into(), found, least: LEAST_TO_SPLIT });
    }
    Ok(())
}
