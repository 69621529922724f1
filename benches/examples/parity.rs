//! The perturbations of the published L2G-NeRF code, registered by raygrad, beside the curve that the published code reached.
//!
//! `$RAYGRAD_DATA` holds `parity/*.json` (settings, perturbation, curve) and the photos that they name.

use anyhow::{Context, ensure};
use raygrad::Experiment;
use raygrad::training::Training;
use raygrad_benches::{Table, quick, train};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// A run of the published code.
#[derive(Deserialize)]
struct Published {
    image: String,
    image_size_hw: [usize; 2],
    patch_crop_hw: [usize; 2],
    seed: u32,
    max_iter: usize,
    coarse_to_fine: [f64; 2],
    lr: [f64; 2],
    lr_warp: [f64; 2],
    lambda_: f64,
    curve: Vec<Point>,
}

/// Step, mean corner error in pixels, patch PSNR in dB, and, in some files, the corner error of each patch.
#[derive(Deserialize, Clone)]
#[serde(untagged)]
enum Point {
    Patches(usize, f64, f64, Vec<f64>),
    Mean(usize, f64, f64),
}

impl Point {
    fn values(&self) -> (usize, f64, f64, &[f64]) {
        match self {
            Point::Patches(step, corner, psnr, patches) => (*step, *corner, *psnr, patches),
            Point::Mean(step, corner, psnr) => (*step, *corner, *psnr, &[]),
        }
    }
}

fn main() -> anyhow::Result<()> {
    let Some(data) = std::env::var_os("RAYGRAD_DATA").map(PathBuf::from) else {
        ensure!(quick(), "set RAYGRAD_DATA to the folder that holds `parity`");
        println!("RAYGRAD_DATA is not set: nothing to compare with");
        return Ok(());
    };
    let folder = data.join("parity");
    let entries = std::fs::read_dir(&folder).with_context(|| folder.display().to_string())?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "json"));
    files.sort();
    for file in files {
        compare(&data, &file)?;
    }
    Ok(())
}

fn compare(data: &Path, file: &Path) -> anyhow::Result<()> {
    let published: Published = serde_json::from_str(&std::fs::read_to_string(file)?)?;
    let steps = if quick() { 2 } else { published.max_iter };
    let list = |a: [usize; 2]| format!("[{},{}]", a[0], a[1]);
    let settings = [
        format!("data.image_size={}", list(published.image_size_hw)),
        format!("data.patch_crop={}", list(published.patch_crop_hw)),
        format!("data.perturbation={}", file.display()),
        format!("run.seed={}", published.seed),
        format!("optim.steps={steps}"),
        format!("optim.lr={}", published.lr[0]),
        format!("optim.lr_end={}", published.lr[1]),
        format!("optim.lr_warp={}", published.lr_warp[0]),
        format!("optim.lr_warp_end={}", published.lr_warp[1]),
        format!("loss.alignment={}", published.lambda_),
        format!("field.window=[{:?},{:?}]", published.coarse_to_fine[0], published.coarse_to_fine[1]),
    ];
    let mut experiment = Experiment::preset("planar-l2g")?.image(data.join(&published.image));
    for assignment in &settings {
        experiment = experiment.set(assignment)?;
    }
    println!("## {}\n", file.file_stem().unwrap_or_default().display());
    let mut table = Table::new(&["step", "published: px", "dB", "px per patch", "raygrad: px", "dB", "px per patch"]);
    let per_patch = |errors: &[f64]| errors.iter().map(|e| format!("{e:.2}")).collect::<Vec<_>>().join(", ");
    let (_, seconds) = train("parity", &experiment, |trainer| {
        let done = trainer.steps_done();
        let shown = done.is_multiple_of(500) || [100, 200].contains(&done) || done == steps;
        let point = published.curve.iter().find(|p| p.values().0 == done);
        if let (true, Some(point)) = (shown, point) {
            let (_, corner, psnr, patches) = point.values();
            let own = trainer.measure()?;
            let Some(errors) = own.corners() else { return Ok(()) };
            table.row([
                done.to_string(),
                format!("{corner:.3}"),
                format!("{psnr:.2}"),
                per_patch(patches),
                format!("{:.3}", errors.mean),
                format!("{:.2}", own.psnr_db()),
                per_patch(&errors.per_patch),
            ]);
        }
        Ok(())
    })?;
    println!("{table}\n{steps} steps in {seconds:.0} s\n");
    Ok(())
}
