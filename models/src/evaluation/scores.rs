//! What was measured of one run: per view and on average, before and after test-time refinement.

use crate::scene::Intrinsics;
use serde::{Deserialize, Serialize};
use std::fmt;

/// A quantity the papers report.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Metric {
    RotationErrorDeg,
    /// In units of the data set, times 100.
    #[serde(rename = "translation_error_x100")]
    TranslationErrorX100,
    PsnrDb,
    Ssim,
    Lpips,
    /// The same three where a view has a mask: both pictures on white outside it, over the whole frame.
    MaskedPsnrDb,
    MaskedSsim,
    MaskedLpips,
    /// Mean absolute, in units of the data set.
    DepthError,
    /// In the plane: mean distance between estimated and true corners of the patches.
    CornerErrorPx,
    /// In the plane: mean distance of estimated and true warps as vectors of sl(3).
    WarpError,
    /// In the plane: PSNR of all patches together.
    PatchPsnrDb,
    /// In the plane: 1 where the corner error is below [`success_px`], else 0; over several runs, their share.
    Success,
    /// Between the surface and a reference, the mean of both directions, in the unit of the scene's files.
    Chamfer,
}

/// Corner error in pixels below which patches count as registered: 5 in a picture of 360 x 480 (INN's supplement), and as
/// large a part of the longer side of any other.
pub fn success_px(height: usize, width: usize) -> f64 {
    5.0 * height.max(width) as f64 / 480.0
}

impl Metric {
    pub const ALL: [Metric; 14] = [
        Metric::RotationErrorDeg,
        Metric::TranslationErrorX100,
        Metric::PsnrDb,
        Metric::Ssim,
        Metric::Lpips,
        Metric::MaskedPsnrDb,
        Metric::MaskedSsim,
        Metric::MaskedLpips,
        Metric::DepthError,
        Metric::CornerErrorPx,
        Metric::WarpError,
        Metric::PatchPsnrDb,
        Metric::Success,
        Metric::Chamfer,
    ];

    /// Its name in files.
    pub fn key(self) -> &'static str {
        match self {
            Metric::RotationErrorDeg => "rotation_error_deg",
            Metric::TranslationErrorX100 => "translation_error_x100",
            Metric::PsnrDb => "psnr_db",
            Metric::Ssim => "ssim",
            Metric::Lpips => "lpips",
            Metric::MaskedPsnrDb => "masked_psnr_db",
            Metric::MaskedSsim => "masked_ssim",
            Metric::MaskedLpips => "masked_lpips",
            Metric::DepthError => "depth_error",
            Metric::CornerErrorPx => "corner_error_px",
            Metric::WarpError => "warp_error",
            Metric::PatchPsnrDb => "patch_psnr_db",
            Metric::Success => "success",
            Metric::Chamfer => "chamfer",
        }
    }

    /// Its name for people, with its unit.
    pub fn heading(self) -> &'static str {
        match self {
            Metric::RotationErrorDeg => "rotation (deg)",
            Metric::TranslationErrorX100 => "translation (x 100)",
            Metric::PsnrDb => "PSNR (dB)",
            Metric::Ssim => "SSIM",
            Metric::Lpips => "LPIPS",
            Metric::MaskedPsnrDb => "masked PSNR (dB)",
            Metric::MaskedSsim => "masked SSIM",
            Metric::MaskedLpips => "masked LPIPS",
            Metric::DepthError => "depth error",
            Metric::CornerErrorPx => "corner error (px)",
            Metric::WarpError => "warp error (sl3)",
            Metric::PatchPsnrDb => "patch PSNR (dB)",
            Metric::Success => "success (share)",
            Metric::Chamfer => "Chamfer distance",
        }
    }

    /// Digits after the point.
    pub fn decimals(self) -> usize {
        match self {
            Metric::PsnrDb | Metric::MaskedPsnrDb | Metric::PatchPsnrDb | Metric::Success => 2,
            Metric::WarpError => 4,
            _ => 3,
        }
    }

    /// Whether a smaller number is a better one.
    pub fn lower_is_better(self) -> bool {
        use Metric::{MaskedPsnrDb, MaskedSsim, PatchPsnrDb, PsnrDb, Ssim, Success};
        !matches!(self, PsnrDb | Ssim | MaskedPsnrDb | MaskedSsim | PatchPsnrDb | Success)
    }

    /// Whether it is of test views, and so differs before and after refinement of their poses; the others are of the
    /// training cameras or patches, or of the model as a whole.
    pub fn is_of_views(self) -> bool {
        use Metric::{DepthError, Lpips, MaskedLpips, MaskedPsnrDb, MaskedSsim, PsnrDb, Ssim};
        matches!(self, PsnrDb | Ssim | Lpips | MaskedPsnrDb | MaskedSsim | MaskedLpips | DepthError)
    }
}

/// Values of the metrics, as far as they were taken. Infinite ones, as the PSNR of equal pictures, become null in JSON.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Scores {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rotation_error_deg: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub translation_error_x100: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub masked_psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub masked_ssim: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub masked_lpips: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_error: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub corner_error_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warp_error: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patch_psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub success: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chamfer: Option<f64>,
}

impl Scores {
    pub fn get(&self, metric: Metric) -> Option<f64> {
        match metric {
            Metric::RotationErrorDeg => self.rotation_error_deg,
            Metric::TranslationErrorX100 => self.translation_error_x100,
            Metric::PsnrDb => self.psnr_db,
            Metric::Ssim => self.ssim,
            Metric::Lpips => self.lpips,
            Metric::MaskedPsnrDb => self.masked_psnr_db,
            Metric::MaskedSsim => self.masked_ssim,
            Metric::MaskedLpips => self.masked_lpips,
            Metric::DepthError => self.depth_error,
            Metric::CornerErrorPx => self.corner_error_px,
            Metric::WarpError => self.warp_error,
            Metric::PatchPsnrDb => self.patch_psnr_db,
            Metric::Success => self.success,
            Metric::Chamfer => self.chamfer,
        }
    }

    /// The mean of each metric over those that have it.
    pub fn mean<'a>(all: impl IntoIterator<Item = &'a Scores> + Clone) -> Scores {
        let of = |metric: Metric| {
            let values: Vec<f64> = all.clone().into_iter().filter_map(|s| s.get(metric)).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        Scores {
            rotation_error_deg: of(Metric::RotationErrorDeg),
            translation_error_x100: of(Metric::TranslationErrorX100),
            psnr_db: of(Metric::PsnrDb),
            ssim: of(Metric::Ssim),
            lpips: of(Metric::Lpips),
            masked_psnr_db: of(Metric::MaskedPsnrDb),
            masked_ssim: of(Metric::MaskedSsim),
            masked_lpips: of(Metric::MaskedLpips),
            depth_error: of(Metric::DepthError),
            corner_error_px: of(Metric::CornerErrorPx),
            warp_error: of(Metric::WarpError),
            patch_psnr_db: of(Metric::PatchPsnrDb),
            success: of(Metric::Success),
            chamfer: of(Metric::Chamfer),
        }
    }
}

/// Scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScores {
    /// Name of the view's picture, or of a patch.
    pub view: String,
    #[serde(flatten)]
    pub scores: Scores,
}

/// Scores of views and their mean.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    pub mean: Scores,
    pub views: Vec<ViewScores>,
}

impl Measured {
    pub fn new(views: Vec<ViewScores>) -> Measured {
        Measured { mean: Scores::mean(views.iter().map(|v| &v.scores)), views }
    }
}

/// When pictures were scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Test poses as the alignment gives them.
    Before,
    /// Test poses refined on their pictures with the field frozen.
    After,
}

impl Stage {
    pub fn name(self) -> &'static str {
        match self {
            Stage::Before => "before",
            Stage::After => "after",
        }
    }
}

/// One run, measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    pub scene: String,
    pub method: String,
    /// Pose errors of the training cameras, or corner errors of the patches of a picture; empty where there is no reference
    /// to compare with. The mean also has what is of the model as a whole: whether patches are registered, and the Chamfer
    /// distance of the surface.
    pub cameras: Measured,
    /// Test views at the poses the alignment gives.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<Measured>,
    /// Test views after test-time refinement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<Measured>,
    /// Whether the camera centres leave the alignment open, see
    /// [`Similarity::is_ill_conditioned`](super::Similarity::is_ill_conditioned).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub undetermined: bool,
    /// The part of the rotation errors that is one turn of all cameras, in degrees: centres that are nearly in a plane may lie in
    /// it as they should while everything leans.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub common_turn_deg: Option<f64>,
    /// Where lenses were refined, what was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<FoundLens>,
}

/// How refined lenses differ from those that were given, the same for all views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FoundLens {
    /// Found focal lengths, along x and y, as multiples of the given ones.
    pub focal_scale: [f64; 2],
    /// By how much principal points moved, along x and y, in given focal lengths.
    pub principal_shift: [f64; 2],
}

impl FoundLens {
    /// A lens as it was found.
    pub fn of(&self, given: &Intrinsics) -> Intrinsics {
        let (scale, shift) = (self.focal_scale, self.principal_shift);
        let (cx, cy) = (given.cx + shift[0] * given.fx, given.cy + shift[1] * given.fy);
        Intrinsics { fx: given.fx * scale[0], fy: given.fy * scale[1], cx, cy, ..*given }
    }
}

impl fmt::Display for FoundLens {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let ([a, b], [u, v]) = (self.focal_scale, self.principal_shift);
        match a == b {
            true => write!(f, "focal lengths x {a:.4}")?,
            false => write!(f, "focal lengths x {a:.4} and {b:.4}")?,
        }
        if (u, v) != (0.0, 0.0) {
            write!(f, ", principal points {u:+.4} and {v:+.4} focal lengths from where they were taken to be")?;
        }
        Ok(())
    }
}

impl Evaluation {
    /// As JSON.
    pub fn to_json(&self) -> String {
        // Numbers, strings and lists always have a JSON form.
        serde_json::to_string_pretty(self).unwrap_or_default()
    }

    /// What is to be said wherever the numbers are shown.
    pub fn notes(&self) -> Vec<String> {
        let undetermined = self.undetermined.then(|| {
            "the camera centres, found or true, lie in one point or on one line, which does not determine the turn that \
             aligns them: errors of poses and test views mean little"
                .to_string()
        });
        undetermined.into_iter().chain(self.lens.map(|lens| format!("lenses were refined: {lens}"))).collect()
    }

    /// The views of a stage.
    pub fn stage(&self, stage: Stage) -> Option<&Measured> {
        match stage {
            Stage::Before => self.before.as_ref(),
            Stage::After => self.after.as_ref(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_over_what_was_measured() {
        let view = |view: &str, psnr_db, lpips| ViewScores {
            view: view.into(),
            scores: Scores { psnr_db: Some(psnr_db), lpips, ..Scores::default() },
        };
        let measured = Measured::new(vec![view("a", 20.0, None), view("b", 30.0, Some(0.5))]);
        assert_eq!(measured.mean, Scores { psnr_db: Some(25.0), lpips: Some(0.5), ..Scores::default() });
        assert_eq!(Measured::new(vec![]).mean, Scores::default());
    }

    #[test]
    fn names_in_files_are_those_of_the_fields() {
        for metric in Metric::ALL {
            assert_eq!(serde_json::to_value(metric).unwrap(), metric.key());
        }
        let all: Scores = serde_json::from_str(
            r#"{"rotation_error_deg": 1, "translation_error_x100": 2, "psnr_db": 3,
                "ssim": 4, "lpips": 5, "masked_psnr_db": 6, "masked_ssim": 7, "masked_lpips": 8, "depth_error": 9,
                "corner_error_px": 10, "warp_error": 11, "patch_psnr_db": 12, "success": 13, "chamfer": 14}"#,
        )
        .unwrap();
        let values: Vec<f64> = Metric::ALL.iter().filter_map(|m| all.get(*m)).collect();
        assert_eq!(values, (1..=14).map(f64::from).collect::<Vec<_>>());
        let json = serde_json::to_value(all).unwrap();
        assert!(Metric::ALL.iter().all(|m| json.get(m.key()).is_some()));
    }
}
