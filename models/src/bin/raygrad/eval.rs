//! `raygrad eval`: measures a run again, at its last checkpoint.

use crate::held::HeldRun;
use crate::print;
use crate::progress::bar;
use crate::surface::{Surface, SurfaceArgs};
use clap::Args;
use raygrad::Error;
use raygrad::evaluation::{Evaluation, Measured, Metric, PublishedTable, Table, published_for};
use raygrad::run::files::{can_be_written, write_atomically};
use raygrad::run::{EVALUATION, RunFolder};
use raygrad::scene::Layout;
use raygrad::training::{Training, Watch};
use serde::Serialize;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

#[derive(Args)]
pub struct EvalArgs {
    #[command(flatten)]
    held: HeldRun,
    /// Weights of LPIPS, as scripts/convert_lpips.py writes them.
    #[arg(long, value_name = "WEIGHTS")]
    lpips: Option<PathBuf>,
    /// Write every view, and the mean, as comma-separated values.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write the table as LaTeX.
    #[arg(long, value_name = "FILE")]
    latex: Option<PathBuf>,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    surface: SurfaceArgs,
}

#[derive(Serialize)]
struct Json<'a> {
    /// Steps done, of how many.
    step: usize,
    steps: usize,
    #[serde(flatten)]
    evaluation: &'a Evaluation,
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<&'a Surface>,
    /// Of the papers, for the same scene, method and start.
    published: &'a [PublishedTable],
}

pub fn run(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let mut experiment = args.held.experiment()?;
    if let Some(weights) = &args.lpips {
        experiment = experiment.lpips(weights)?;
    }
    let checked = args.surface.checked()?;
    for path in [&args.csv, &args.latex, args.surface.mesh_file()].into_iter().flatten() {
        can_be_written(path).map_err(Error::from)?;
    }
    let folder = RunFolder::open(&args.held.run).map_err(Error::from)?;
    let written = folder.path().join(EVALUATION);
    can_be_written(&written).map_err(Error::from)?;
    let settings = experiment.layered.settings.clone();
    let earlier = std::fs::read_to_string(written).unwrap_or_default();
    let had = |metric: Metric| earlier.contains(&format!("\"{}\"", metric.key()));
    // Ctrl-C ends this command at once: what it writes is written as whole files.
    let never = AtomicBool::new(false);
    // As the run was asked to start: the experiment takes the copy that it keeps. Nor is a scene that has moved called otherwise.
    let own = RunFolder::settings_of_run(&args.held.run).map_err(Error::from)?.settings;
    let named = |evaluation: Evaluation| -> Result<Evaluation, Error> {
        let scene = own.scene_name();
        if evaluation.scene == scene {
            return Ok(evaluation);
        }
        let named = Evaluation { scene, ..evaluation };
        folder.write(EVALUATION, named.to_json().as_bytes())?;
        Ok(named)
    };
    let (mut evaluation, step, surface, layout);
    if settings.scene.is_some() || args.surface.wanted() {
        let mut explorer = experiment.restored_explorer()?;
        evaluation = named(measure(&mut explorer, &folder, &never)?)?;
        layout = Some(explorer.data.scene.layout);
        step = explorer.steps_done();
        // Of what was measured something is told in any case.
        surface = args.surface.wanted().then(|| args.surface.run(&mut explorer, &checked)).transpose();
        if let Some(distances) = surface.as_ref().ok().and_then(|s| s.as_ref()?.chamfer.as_ref()) {
            evaluation.cameras.mean.chamfer = Some(distances.mean);
            folder.write(EVALUATION, evaluation.to_json().as_bytes()).map_err(Error::from)?;
        }
    } else {
        let mut trainer = experiment.restored()?;
        evaluation = named(measure(&mut *trainer, &folder, &never)?)?;
        (step, surface, layout) = (trainer.steps_done(), Ok(None), None);
    }
    let dataset = layout.map_or("planar", Layout::name);
    let start = own.start_name();
    let scene = evaluation.scene.as_str();
    let published = published_for(dataset, start.as_deref(), &[scene], &[settings.method_name()]);
    let title = format!("{}, step {step} of {}", args.held.run.display(), settings.optim.taken());
    let table = Table { title, evaluations: vec![evaluation], published };
    for (path, text) in [(&args.csv, table.views_csv()), (&args.latex, table.to_latex())] {
        if let Some(path) = path {
            write_atomically(path, text.as_bytes()).map_err(Error::from)?;
        }
    }
    let evaluation = &table.evaluations[0];
    if args.json {
        let (steps, published) = (settings.optim.taken(), &table.published);
        let mesh = surface.as_ref().ok().and_then(Option::as_ref);
        let json = serde_json::to_string(&Json { step, steps, evaluation, mesh, published })?;
        print(&format!("{json}\n"))?;
        surface?;
        return Ok(ExitCode::SUCCESS);
    }
    let lacks = |m: &Option<Measured>| m.as_ref().is_some_and(|m| m.mean.psnr_db.is_some() && m.mean.lpips.is_none());
    if had(Metric::Lpips) && lacks(&evaluation.before) {
        note!("note: evaluation.json had LPIPS, which is measured with `--lpips` only");
    }
    if had(Metric::Chamfer) && evaluation.cameras.mean.chamfer.is_none() {
        note!("note: evaluation.json had a Chamfer distance, which is measured with `--cloud` only");
    }
    let mut text = table.to_text();
    if settings.scene.is_none() {
        let errors = evaluation.cameras.views.iter().filter_map(|v| v.scores.corner_error_px);
        text += &format!("patches (px)  {}\n", errors.map(|e| format!("{e:.3}")).collect::<Vec<_>>().join("  "));
    }
    if let Ok(Some(surface)) = &surface {
        text += &args.surface.text(surface);
    }
    print(&text)?;
    surface?;
    Ok(ExitCode::SUCCESS)
}

/// Measures a model and writes what it finds into its run's folder, with a bar over the views, unless `stop` is set before.
pub fn measure(model: &mut dyn Training, folder: &RunFolder, stop: &AtomicBool) -> Result<Evaluation, Error> {
    let shown = bar("evaluating", "views");
    let evaluation = model.write_evaluation(folder, Watch::new(&|done, all| shown.show(done, all), stop));
    shown.finish();
    evaluation
}
