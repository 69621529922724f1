//! `raygrad sweep`: runs of one file, and the papers' tables of them.

use crate::eval::measure;
use crate::progress::Progress as Shown;
use crate::surface::distance_to;
use crate::{listen, output_folder, print};
use anyhow::bail;
use clap::Args;
use raygrad::config::{Sweep, SweepCell};
use raygrad::evaluation::{Evaluation, Lpips, Mesh, MeshOptions};
use raygrad::run::files::write_atomically;
use raygrad::run::{EVALUATION, FolderError, RunFolder};
use raygrad::sweep::{Progress, results};
use raygrad::{Error, Experiment};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

#[derive(Args)]
pub struct SweepArgs {
    /// What to run: a TOML file with the lists `presets`, `scenes` and `seeds`, and the tables `set` and `preset`.
    file: PathBuf,
    /// Folder for the runs and the tables; by default runs/FILE without its ending.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Insist on going on with a sweep: refuse a folder that holds none of its runs.
    #[arg(long)]
    resume: bool,
    /// Weights of LPIPS, as scripts/convert_lpips.py writes them, to measure test views with.
    #[arg(long, value_name = "WEIGHTS")]
    lpips: Option<PathBuf>,
}

pub fn run(args: &SweepArgs) -> anyhow::Result<ExitCode> {
    let sweep = Sweep::load(&args.file).map_err(Error::from)?;
    let folder = args.out.clone().unwrap_or_else(|| Path::new("runs").join(&sweep.name));
    // A damaged file of weights, or a folder with something else in it, is found before anything runs.
    if let Some(weights) = &args.lpips {
        Lpips::load(weights).map_err(Error::from)?;
    }
    if folder.is_dir() && RunFolder::held_settings(&folder).map_err(Error::from)?.is_some() {
        return Err(Error::from(FolderError::OfRun { path: folder }).into());
    }
    let mut open = true;
    for cell in &sweep.cells {
        open &= cell.progress(&folder)? == Progress::Open;
    }
    if args.resume && open {
        return Err(Error::from(FolderError::NothingToResume { path: folder }).into());
    }
    sweep.mesh.check().map_err(Error::from)?;
    let cloud = |(scene, file): (&String, &PathBuf)| Ok((scene.clone(), Mesh::read_ply(file)?));
    let clouds: BTreeMap<String, Mesh> = sweep.clouds.iter().map(cloud).collect::<Result<_, Error>>()?;
    let stop = listen()?;
    let (mut done, mut failed) = (vec![], vec![]);
    for (i, cell) in sweep.cells.iter().enumerate() {
        note!("run {} of {}: {}", i + 1, sweep.cells.len(), cell.name);
        match train(cell, &folder, args.lpips.as_deref(), &stop) {
            Ok(Some(mut evaluation)) => {
                let cloud = clouds.get(&cell.layered.settings.scene_name());
                if let Some(cloud) = cloud.filter(|_| evaluation.cameras.mean.chamfer.is_none())
                    && let Err(error) = add_distance(&cell.folder(&folder), &mut evaluation, &sweep.mesh, cloud)
                {
                    note!("{} stays without a Chamfer distance: {error}", cell.name);
                }
                done.push((cell, evaluation));
            }
            Ok(None) | Err(Error::Stopped) => {
                print(&format!("stopped; continue with the same command and `--out {} --resume`\n", folder.display()))?;
                return Ok(ExitCode::from(130));
            }
            // One run that fails, by diverging, for a damaged scene or as another process trains it, leaves the others.
            Err(error) => {
                note!("{} failed: {error}", cell.name);
                failed.push(cell.name.as_str());
            }
        }
    }
    output_folder(&folder)?;
    let (table, json) = results(&sweep, &done);
    for (ending, text) in [("csv", table.to_csv()), ("tex", table.to_latex()), ("json", json)] {
        write_atomically(&folder.join(format!("sweep.{ending}")), text.as_bytes()).map_err(Error::from)?;
    }
    print(&format!("{}results in {}/sweep.csv, .tex and .json\n", table.to_text(), folder.display()))?;
    if !failed.is_empty() {
        bail!("{} of {} runs failed: {}", failed.len(), sweep.cells.len(), failed.join(", "));
    }
    Ok(ExitCode::SUCCESS)
}

/// What a run has come to; nothing if it was stopped.
fn train(
    cell: &SweepCell,
    folder: &Path,
    lpips: Option<&Path>,
    stop: &AtomicBool,
) -> Result<Option<Evaluation>, Error> {
    // As it is by now: another process may have gone on with it since the sweep began.
    let begun = match cell.progress(folder)? {
        Progress::Done(evaluation) => {
            let lacks = evaluation.before.as_ref().is_some_and(|b| b.mean.lpips.is_none());
            return match lpips.filter(|_| lacks) {
                Some(weights) => match measured_again(&cell.folder(folder), weights, stop) {
                    Err(error) if !matches!(error, Error::Stopped) => {
                        note!("{} stays without LPIPS: {error}", cell.name);
                        Ok(Some(*evaluation))
                    }
                    other => other.map(Some),
                },
                None => Ok(Some(*evaluation)),
            };
        }
        Progress::Begun => true,
        Progress::Open => {
            RunFolder::clear(&cell.folder(folder))?;
            false
        }
    };
    let mut experiment = Experiment::of(cell.layered.clone()).out(cell.folder(folder)).resume(begun);
    if let Some(weights) = lpips {
        experiment = experiment.lpips(weights)?;
    }
    if experiment.train_observed(&mut Shown::new(), stop)?.interrupted {
        return Ok(None);
    }
    match cell.progress(folder)? {
        Progress::Done(evaluation) => Ok(Some(*evaluation)),
        _ => Ok(None),
    }
}

/// Adds the distance of a finished run's surface to a reference to what was measured of it.
fn add_distance(run: &Path, evaluation: &mut Evaluation, options: &MeshOptions, reference: &Mesh) -> Result<(), Error> {
    let mut explorer = Experiment::of_run(run)?.restored_explorer()?;
    evaluation.cameras.mean.chamfer = Some(distance_to(&mut explorer, options, reference)?);
    Ok(RunFolder::open(run)?.write(EVALUATION, evaluation.to_json().as_bytes())?)
}

/// A finished run with LPIPS, which it was trained without.
fn measured_again(run: &Path, weights: &Path, stop: &AtomicBool) -> Result<Evaluation, Error> {
    let mut explorer = Experiment::of_run(run)?.lpips(weights)?.restored_explorer()?;
    measure(&mut explorer, &RunFolder::open(run)?, stop)
}
