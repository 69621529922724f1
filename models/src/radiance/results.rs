//! The files of a 3D run: where it starts, frames of the animation, rendered views, poses, measurements and report.

use super::data::SpaceData;
use super::explorer::{Explorer, Rendered};
use crate::Error;
use crate::config::Layered;
use crate::evaluation::{Picture as Measured, Similarity, procrustes, psnr, ssim};
use crate::geometry::Pose;
use crate::pictures::{self, Canvas};
use crate::report::{Picture, Report};
use crate::run::RunFolder;
use crate::run::metrics::Metrics;
use crate::run::results::{FRAMES, animation};
use crate::scene::View;
use crate::training::Training;
use serde::{Deserialize, Serialize};

/// Test views shown in the report.
const SHOWN: usize = 6;

/// Measurements of one test view, in its reference pose moved into the learned world and after test-time refinement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScore {
    pub name: String,
    pub psnr_db: f64,
    pub ssim: f64,
    pub refined_psnr_db: Option<f64>,
    pub refined_ssim: Option<f64>,
}

/// `evaluation.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    pub rotation_error_deg: Option<f64>,
    pub translation_error_x100: Option<f64>,
    pub psnr_db: f64,
    pub ssim: f64,
    pub refined_psnr_db: Option<f64>,
    pub refined_ssim: Option<f64>,
    pub views: Vec<ViewScore>,
}

/// What the run starts from, before it begins.
pub fn write_data(folder: &RunFolder, data: &SpaceData) -> Result<(), Error> {
    folder.write("initial_poses.json", data.start.to_json(Some(data.seed)).as_bytes())?;
    Ok(())
}

/// One frame of the animation: the first validation view as it is seen now.
pub fn write_frame(folder: &RunFolder, explorer: &mut Explorer) -> Result<(), Error> {
    let scene = &explorer.data.scene;
    let Some(View { pose, intrinsics, .. }) = scene.val.first().or(scene.train.first()).cloned() else { return Ok(()) };
    let poses = explorer.poses()?;
    let pose = match pose {
        Some(pose) => to_learned(&poses, explorer.data.truth.as_deref())?.to_learned(&pose),
        None => poses[0],
    };
    let seen = explorer.render(&pose, &intrinsics)?;
    let canvas = Canvas::from_colors(intrinsics.width, intrinsics.height, &seen.rgb);
    folder.write(&format!("{FRAMES}/{:07}.png", explorer.steps_done()), &canvas.to_png()?)?;
    Ok(())
}

/// The similarity from the learned world to the true one; the identity where that is unknown.
fn to_learned(poses: &[Pose], truth: Option<&[Pose]>) -> Result<Similarity, Error> {
    match truth {
        Some(truth) if truth.len() > 1 => Ok(procrustes(poses, truth).map_err(super::data::SpaceDataError::from)?),
        _ => Ok(Similarity::identity()),
    }
}

/// Renders and measures the test views, writes poses, pictures and report.
pub fn write_results(
    folder: &RunFolder,
    layered: &Layered,
    explorer: &mut Explorer,
    metrics: &Metrics,
) -> Result<Scores, Error> {
    let poses = explorer.poses()?;
    let similarity = to_learned(&poses, explorer.data.truth.as_deref())?;
    let test = explorer.data.scene.test.clone();
    // Known poses need no refinement: they are what the field was learned with.
    let refines = layered.settings.warp.method != crate::config::Method::None;
    let (mut views, mut shown) = (vec![], vec![]);
    for (i, view) in test.iter().enumerate() {
        let Some(reference) = view.pose else { continue };
        let pose = similarity.to_learned(&reference);
        let before = explorer.render(&pose, &view.intrinsics)?;
        let (width, height) = (view.intrinsics.width, view.intrinsics.height);
        let photo = view.rgb();
        let score = |seen: &Rendered| -> Result<(f64, f64), Error> {
            let (a, b) = (Measured::new(width, height, &seen.rgb)?, Measured::new(width, height, &photo)?);
            Ok((psnr(&a, &b)?, ssim(&a, &b)?))
        };
        let (psnr_db, ssim_before) = score(&before)?;
        let mut of_view = ViewScore {
            name: view.name.clone(),
            psnr_db,
            ssim: ssim_before,
            refined_psnr_db: None,
            refined_ssim: None,
        };
        let mut best = before;
        if refines {
            let refined = explorer.refined(&pose, view)?;
            best = explorer.render(&refined, &view.intrinsics)?;
            let (p, s) = score(&best)?;
            (of_view.refined_psnr_db, of_view.refined_ssim) = (Some(p), Some(s));
        }
        views.push(of_view);
        let rgb = Canvas::from_colors(width, height, &best.rgb);
        folder.write(&format!("test/{i:03}.png"), &rgb.to_png()?)?;
        let depth = Canvas::from_colors(width, height, &depth_colors(&best, similarity.scale));
        folder.write(&format!("test/{i:03}_depth.png"), &depth.to_png()?)?;
        if shown.len() < SHOWN {
            shown.push([Canvas::from_colors(width, height, &photo), rgb, depth]);
        }
    }
    let mean = |value: &dyn Fn(&ViewScore) -> Option<f64>| {
        let all: Vec<f64> = views.iter().filter_map(value).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    };
    let last = metrics.last.as_ref().map(|f| f.entry.measured.clone());
    let (rotation, translation) = match last {
        Some(crate::run::Measured::Space { rotation_error_deg, translation_error_x100, .. }) => {
            (rotation_error_deg, translation_error_x100)
        }
        _ => (None, None),
    };
    let scores = Scores {
        rotation_error_deg: rotation,
        translation_error_x100: translation,
        psnr_db: mean(&|v| Some(v.psnr_db)).unwrap_or(f64::NAN),
        ssim: mean(&|v| Some(v.ssim)).unwrap_or(f64::NAN),
        refined_psnr_db: mean(&|v| v.refined_psnr_db),
        refined_ssim: mean(&|v| v.refined_ssim),
        views,
    };
    folder.write("evaluation.json", serde_json::to_string_pretty(&scores).unwrap_or_default().as_bytes())?;
    write_poses(folder, &explorer.data, &poses, &similarity)?;
    write_report(folder, layered, explorer, metrics, &shown)?;
    Ok(scores)
}

/// `poses.json`: the poses found, in the learned world and aligned with the true one, world to camera, row by row.
fn write_poses(folder: &RunFolder, data: &SpaceData, poses: &[Pose], similarity: &Similarity) -> Result<(), Error> {
    let names: Vec<&str> = data.scene.train.iter().map(|v| v.name.as_str()).collect();
    let rows = |poses: &[Pose]| poses.iter().map(|p| p.to_rows()).collect::<Vec<_>>();
    let aligned = similarity.align(poses);
    let found = serde_json::json!({ "views": names, "learned": rows(poses), "aligned": rows(&aligned) });
    folder.write("poses.json", serde_json::to_string_pretty(&found).unwrap_or_default().as_bytes())?;
    Ok(())
}

/// Inverse depth as grey, in the true world's unit where that is known.
fn depth_colors(seen: &Rendered, scale: f64) -> Vec<f32> {
    let inverse = |(depth, opacity): (&f32, &f32)| {
        let depth = f64::from(*depth) / f64::from(opacity.max(1e-6)) * scale;
        (1.0 / (depth - 1.5).max(1.0)).clamp(0.0, 1.0) as f32
    };
    seen.depth.iter().zip(&seen.opacity).flat_map(|d| [inverse(d); 3]).collect()
}

fn write_report(
    folder: &RunFolder,
    layered: &Layered,
    explorer: &Explorer,
    metrics: &Metrics,
    shown: &[[Canvas; 3]],
) -> Result<(), Error> {
    let animation = animation(folder, explorer.steps_done())?;
    let mut pictures = vec![];
    let views = match shown.is_empty() {
        true => None,
        false => Some(pictures::tile(&shown.iter().map(|row| row.to_vec()).collect::<Vec<_>>()).to_png()?),
    };
    if let Some(png) = &views {
        let caption = "Test views: the photo, the same rendered by the model, and its inverse depth.";
        pictures.push(Picture { title: "Views", caption, png });
        folder.write("test_views.png", png)?;
    }
    if let Some(png) = &animation {
        pictures.push(Picture { title: "Training", caption: "A view over training.", png });
        folder.write("training.png", png)?;
    }
    let config = toml::to_string(&layered.settings).unwrap_or_default();
    let device = explorer.learner().device_name();
    let report = Report { title: &layered.name, device: &device, metrics, pictures, config: &config };
    Ok(folder.write("report.html", report.to_html()?.as_bytes())?)
}
