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
    #[serde(flatten)]
    pub measured: Measured,
    /// Cameras brought back since the last entry, see `train.relocalise_every`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub relocalised: Vec<Relocalised>,
}

/// A camera that was brought back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Relocalised {
    pub view: String,
    /// Mean squared error of its photo where it was, and where it is now.
    pub error_before: f64,
    pub error_after: f64,
}

/// What is measured besides the losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Measured {
    Planar {
        /// -10 log10 of the rendering loss of this step.
        patch_psnr_db: f64,
        /// Distance in pixels between estimated and true patch corners.
        corner_error_px: OfPatches,
        /// Distance of estimated and true warps as vectors of sl(3); none where one is no exponential.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        warp_error: Option<OfPatches>,
    },
    Space {
        /// -10 log10 of the rendering loss of this step.
        psnr_db: f64,
        /// Mean over the training views after alignment; none where no true poses are known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rotation_error_deg: Option<f64>,
        /// A hundred times the mean distance between estimated and true world-to-camera translations.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        translation_error_x100: Option<f64>,
        /// PSNR of the first validation view, see `train.validate_every`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        validation_psnr_db: Option<f64>,
    },
}

impl Entry {
    /// PSNR of the step's pixels, in dB.
    pub fn psnr_db(&self) -> f64 {
        match self.measured {
            Measured::Planar { patch_psnr_db: psnr, .. } | Measured::Space { psnr_db: psnr, .. } => psnr,
        }
    }
    /// PSNR of the first validation view in dB, where it was looked at.
    pub fn validation_psnr_db(&self) -> Option<f64> {
        match self.measured {
            Measured::Planar { .. } => None,
            Measured::Space { validation_psnr_db, .. } => validation_psnr_db,
        }
    }
    /// Corner errors of a planar run.
    pub fn corners(&self) -> Option<&OfPatches> {
        match &self.measured {
            Measured::Planar { corner_error_px, .. } => Some(corner_error_px),
            Measured::Space { .. } => None,
        }
    }
    /// Distances of a planar run's warps in sl(3).
    pub fn warp_error(&self) -> Option<&OfPatches> {
        match &self.measured {
            Measured::Planar { warp_error, .. } => warp_error.as_ref(),
            Measured::Space { .. } => None,
        }
    }
    /// The registration error in words: "corners 0.75 px", "rotation 0.51 deg, translation 1.20".
    pub fn error_text(&self) -> String {
        match &self.measured {
            Measured::Planar { corner_error_px, .. } => format!("corners {:.2} px", corner_error_px.mean),
            Measured::Space { rotation_error_deg: Some(r), translation_error_x100: Some(t), .. } => {
                format!("rotation {r:.2} deg  translation {t:.2}")
            }
            Measured::Space { .. } => String::new(),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OfPatches {
    pub mean: f64,
    pub per_patch: Vec<f64>,
}

impl OfPatches {
    pub fn new(per_patch: Vec<f64>) -> OfPatches {
        let mean = per_patch.iter().sum::<f64>() / per_patch.len().max(1) as f64;
        OfPatches { mean, per_patch }
    }
}

/// Measurements over all pixels of all patches when the run has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Final {
    #[serde(flatten)]
    pub entry: Entry,
    /// Time spent in the run, over all its parts if it was resumed.
    pub seconds: f64,
    /// The estimated warp of each patch, row by row; none in 3D.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
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
