//! `metrics.json`: what was measured, per logged step and at the end.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Measurements of one logged step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Steps done, so the first possible value is 1.
    pub step: usize,
    /// The loss terms before weighting, and their weighted sum as `total`.
    pub loss: BTreeMap<String, f64>,
    /// -10 log10 of the rendering loss of this step.
    pub patch_psnr_db: f64,
    /// Distance in pixels between estimated and true patch corners.
    pub corner_error_px: CornerError,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CornerError {
    pub mean: f64,
    pub per_patch: Vec<f64>,
}

impl CornerError {
    pub fn new(per_patch: Vec<f64>) -> CornerError {
        let mean = per_patch.iter().sum::<f64>() / per_patch.len().max(1) as f64;
        CornerError { mean, per_patch }
    }
}

/// Measurements over all pixels of all patches when the run has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Final {
    #[serde(flatten)]
    pub entry: Entry,
    /// Time spent in the run, over all its parts if it was resumed.
    pub seconds: f64,
    /// The estimated warp of each patch, row by row.
    pub warps: Vec<[f64; 9]>,
}

/// The whole file.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Metrics {
    pub steps: Vec<Entry>,
    #[serde(rename = "final", default, skip_serializing_if = "Option::is_none")]
    pub last: Option<Final>,
}

impl Metrics {
    pub fn to_json(&self) -> String {
        // Numbers, strings and lists always have a JSON form.
        serde_json::to_string_pretty(self).unwrap_or_default()
    }
}
