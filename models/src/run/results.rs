//! The files of a planar run: data, animation frames, pictures and report.

use super::folder::CONFIG;
use super::metrics::Metrics;
use super::{EVALUATION, RunFolder};
use crate::Error;
use crate::config::{Layered, Settings};
use crate::evaluation::{self, Measured, Scores, ViewScores, success_px};
use crate::geometry::Grid;
use crate::pictures::{self, Canvas};
use crate::planar::{Evaluation, PERTURBATION, PlanarData, Trainer};
use crate::report::{Picture, Report};
use crate::training::Training;

/// Folder of the animation's frames, one PNG a step number.
pub(crate) const FRAMES: &str = "frames";

/// What the run learns from, before it begins.
pub fn write_data(folder: &RunFolder, settings: &Settings, data: &PlanarData) -> Result<(), Error> {
    folder.write(PERTURBATION, data.to_json(settings).as_bytes())?;
    let colors: Vec<f32> = data.targets().concat().iter().map(|c| *c as f32).collect();
    folder.write("patches.png", &pictures::patch_row(&data.grid, &colors).to_png()?)?;
    Ok(())
}

/// One frame of the animation: the learned picture and the outlines as they are now.
pub fn write_frame(folder: &RunFolder, trainer: &mut Trainer) -> Result<(), Error> {
    let warps = trainer.warps()?;
    let (view, rgb) = trainer.picture(false)?;
    let canvas = pictures::outlined(&view, &rgb, &warps, &trainer.data.truth);
    folder.write(&format!("{FRAMES}/{:07}.png", trainer.steps_done()), &canvas.to_png()?)?;
    Ok(())
}

/// Writes `evaluation.json`: corner errors of the patches, patch PSNR, and whether the patches are registered.
pub fn write_evaluation(
    folder: &RunFolder,
    settings: &Settings,
    grid: &Grid,
    found: &Evaluation,
) -> Result<evaluation::Evaluation, Error> {
    let corners: &[f64] = found.entry.corners().map_or(&[], |c| &c.per_patch);
    let warps = found.entry.warp_error();
    let patch = |(i, error): (usize, &f64)| {
        let warp_error = warps.and_then(|w| w.per_patch.get(i).copied());
        let scores = Scores { corner_error_px: Some(*error), warp_error, ..Scores::default() };
        ViewScores { view: format!("patch {i}"), scores }
    };
    let mut cameras = Measured::new(corners.iter().enumerate().map(patch).collect());
    cameras.mean.patch_psnr_db = Some(found.entry.psnr_db());
    let below = success_px(grid.height, grid.width);
    cameras.mean.success = cameras.mean.corner_error_px.map(|e| if e < below { 1.0 } else { 0.0 });
    let (scene, method) = (settings.scene_name(), settings.method_name().to_string());
    let evaluation = evaluation::Evaluation { scene, method, cameras, ..evaluation::Evaluation::default() };
    folder.write(EVALUATION, evaluation.to_json().as_bytes())?;
    Ok(evaluation)
}

/// Pictures, animation, metrics and report of a finished run.
pub fn write_results(
    folder: &RunFolder,
    layered: &Layered,
    trainer: &mut Trainer,
    found: &Evaluation,
    measured: &evaluation::Evaluation,
    metrics: &Metrics,
) -> Result<(), Error> {
    let grid = trainer.data.grid;
    let (view, rgb) = trainer.picture(true)?;
    let truth = &trainer.data.truth;
    let reconstruction = pictures::outlined(&view, &rgb, &found.warps, truth).to_png()?;
    let plain = Canvas::from_colors(view.width, view.height, &rgb).to_png()?;
    let photo: Vec<f32> = trainer.data.picture().concat().iter().map(|c| *c as f32).collect();
    let photo = pictures::outlined(&view, &photo, &found.warps, truth).to_png()?;
    let targets: Vec<f32> = trainer.data.targets().concat().iter().map(|c| *c as f32).collect();
    let patches = [pictures::patch_row(&grid, &targets), pictures::patch_row(&grid, &found.color)];
    let fields = [pictures::warp_field(&grid, &found.local), pictures::warp_field(&grid, &found.global)];
    let rows = |pair: [Canvas; 2]| pictures::tile(&pair.map(|c| vec![c])).to_png();
    let (patches, fields) = (rows(patches)?, rows(fields)?);
    let animation = animation(folder, trainer.steps_done())?;
    let mut shown = vec![
        Picture {
            title: "Reconstruction",
            caption: "The learned picture. Thick outlines: where the patches were found; thin ones: where they belong.",
            png: &reconstruction,
        },
        Picture {
            title: "Photo",
            caption: "The photo with the same outlines; training never sees it whole.",
            png: &photo,
        },
        Picture {
            title: "Patches",
            caption: "Above, the distorted patches given; below, the same rendered by the model.",
            png: &patches,
        },
        Picture {
            title: "Warp field",
            caption: "Where each pixel of a patch lands, x as red and y as green. Above the local map, below the global fit.",
            png: &fields,
        },
    ];
    if let Some(png) = &animation {
        shown.push(Picture { title: "Training", caption: "The learned picture and the outlines over training.", png });
    }
    let config = toml::to_string(&layered.settings).unwrap_or_default();
    let report = Report {
        title: &layered.name,
        device: &trainer.learner().device_name(),
        metrics,
        pictures: shown,
        drawings: vec![],
        evaluation: measured,
        config: &config,
    };
    let report = report.to_html()?;
    let files = [
        ("reconstruction.png", &reconstruction),
        ("learned.png", &plain),
        ("photo.png", &photo),
        ("patches.png", &patches),
        ("warp_field.png", &fields),
    ];
    for (name, bytes) in files {
        folder.write(name, bytes)?;
    }
    if let Some(bytes) = &animation {
        folder.write("training.png", bytes)?;
    }
    debug_assert!(folder.path().join(CONFIG).exists());
    Ok(folder.write("report.html", report.as_bytes())?)
}

/// The frames up to the given step as one animated picture.
pub(crate) fn animation(folder: &RunFolder, last: usize) -> Result<Option<Vec<u8>>, Error> {
    let mut frames: Vec<(usize, std::path::PathBuf)> = vec![];
    for entry in std::fs::read_dir(folder.path().join(FRAMES)).into_iter().flatten().flatten() {
        let path = entry.path();
        let step = path.file_stem().and_then(|s| s.to_str()).and_then(|s| s.parse().ok());
        if let Some(step) = step.filter(|s| *s <= last) {
            frames.push((step, path));
        }
    }
    frames.sort();
    // A frame that was damaged or taken away since is left out of the animation.
    let frames: Vec<Canvas> =
        frames.iter().filter_map(|(_, path)| Canvas::from_png(&std::fs::read(path).ok()?).ok()).collect();
    if frames.is_empty() {
        return Ok(None);
    }
    Ok(Some(pictures::animate(&frames)?))
}
