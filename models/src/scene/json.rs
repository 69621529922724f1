//! Camera files in JSON: reading with the field at fault, and OpenGL camera matrices.

use super::{Pose, SceneError, check_pose};
use nalgebra::{Matrix3, Vector3};
use serde::de::DeserializeOwned;
use std::path::Path;

pub(super) fn read<T: DeserializeOwned>(path: &Path) -> Result<T, SceneError> {
    let text = std::fs::read_to_string(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    let mut json = serde_json::Deserializer::from_str(text.strip_prefix('\u{feff}').unwrap_or(&text));
    serde_path_to_error::deserialize(&mut json).map_err(|e| {
        let message = match e.path().to_string() {
            field if field == "." => e.inner().to_string(),
            field => format!("`{field}`: {}", e.inner()),
        };
        SceneError::Format { path: path.into(), message }
    })
}

/// Refuses a file without frames.
pub(super) fn check_frames(count: usize, path: &Path) -> Result<(), SceneError> {
    if count > 0 {
        return Ok(());
    }
    let (expected, found) = ("at least one frame".to_string(), "none".to_string());
    Err(SceneError::Field { path: path.into(), field: "frames".into(), expected, found })
}

/// The pose of a camera-to-world matrix with OpenGL axes (x right, y up, z back): with F = diag(1, -1, -1),
/// R = F R_c^T and t = -F R_c^T t_c.
pub(super) fn pose_of_opengl(rows: &[Vec<f64>], path: &Path, field: String) -> Result<Pose, SceneError> {
    let shaped = (rows.len() == 3 || rows.len() == 4) && rows.iter().all(|r| r.len() == 4);
    if !shaped {
        return Err(SceneError::Field {
            path: path.into(),
            field,
            expected: "3 or 4 rows of 4 numbers".into(),
            found: format!("rows of {:?} numbers", rows.iter().map(Vec::len).collect::<Vec<_>>()),
        });
    }
    let rotation = Matrix3::from_fn(|i, j| rows[i][j]);
    let center = Vector3::from_fn(|i, _| rows[i][3]);
    check_pose(opengl(&rotation, &center), path, || field.clone())
}

/// See [`pose_of_opengl`].
pub(super) fn opengl(rotation: &Matrix3<f64>, center: &Vector3<f64>) -> Pose {
    let rotation = FLIP * rotation.transpose();
    Pose { rotation, translation: -(rotation * center) }
}

/// From OpenGL's camera axes to OpenCV's.
pub(super) const FLIP: Matrix3<f64> = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
