//! The command `raygrad`.
//!
//! Exit codes: 0 done, 1 the computation failed, 2 something given was wrong (or could not be written), 130 interrupted
//! with a checkpoint.

/// Tells people something on standard error; a run goes on where nobody can hear it.
macro_rules! note {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}

mod bench;
mod data;
mod eval;
mod explain;
mod export;
mod held;
mod launches;
mod make_scene;
mod progress;
mod surface;
mod sweep;
mod train;
mod video;

use anyhow::Context;
use clap::{Args, Parser, Subcommand};
use raygrad::config::PRESETS;
use raygrad::run::files::WriteError;
use raygrad::{Error, Experiment};
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Differentiable rendering: train, explain and time neural fields and warps.
#[derive(Parser)]
#[command(version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train an experiment and write its results into a run folder.
    Train(train::TrainArgs),
    /// Measure a run at its last checkpoint: errors, pictures, the papers' numbers beside them, and its surface.
    Eval(eval::EvalArgs),
    /// Train every preset on every scene with every seed of a file, and print the papers' tables of the results.
    Sweep(sweep::SweepArgs),
    /// Write the cameras that a run found for other programs.
    Export(export::ExportArgs),
    /// Render the papers' novel views of a run as a video.
    Video(video::VideoArgs),
    /// List what programs can run on.
    Devices,
    /// List the built-in experiments.
    Presets,
    /// Print what an experiment compiles to: launches, what is fused, stored and recomputed, operations and bytes.
    Explain(explain::ExplainArgs),
    /// Time the training step of an experiment.
    Bench(bench::BenchArgs),
    /// Print what a folder of images and cameras holds: layout, views, intrinsics, depths, where the cameras are.
    Data(data::DataArgs),
    /// Make a small scene with exact cameras and depths, to try things on.
    MakeScene(make_scene::MakeSceneArgs),
}

/// What names an experiment.
#[derive(Args)]
struct Choice {
    /// A preset (see `raygrad presets`) or a settings file ending in `.toml`.
    preset: String,
    /// Override a setting, as in `--set optim.steps=1000`. May be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// PNG or JPEG file to take the patches from, instead of the built-in photo.
    #[arg(long, value_name = "FILE")]
    image: Option<String>,
    /// Folder of a scene, for experiments in space.
    #[arg(long, value_name = "DIR")]
    data: Option<String>,
    /// Seed of perturbation, initial weights and pixel draws.
    #[arg(long, value_name = "N")]
    seed: Option<String>,
    /// Where to compute: `auto`, `cpu`, `wgpu` or `vulkan`, the latter two with `:N` for the Nth adapter.
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// Threads of the CPU backend. Results do not depend on them.
    #[arg(long, value_name = "N")]
    threads: Option<String>,
    /// `f32`, or `mixed`: matrix products of halves, f16 on GPUs that have it and bf16 on the CPU.
    #[arg(long, value_name = "PRECISION")]
    precision: Option<String>,
    /// On GPUs, first try which tiles and forms of networks are fastest. What is found is kept, so that later runs begin at once.
    #[arg(long)]
    autotune: bool,
}

/// Refuses the photo of an experiment in space and the scene of one in the plane; `what` it is, for the message.
fn place(experiment: &Experiment, what: &str, image: bool, data: bool) -> Result<(), Error> {
    let in_space = experiment.layered.settings.scene.is_some();
    let (option, text) = match (image && in_space, data && !in_space) {
        (true, _) => ("--image", format!("{what} is in space; `--data` names its scene")),
        (_, true) => ("--data", format!("{what} is in the plane; `--image` names its photo")),
        _ => return Ok(()),
    };
    Err(experiment.layered.refuse(option, text).into())
}

impl Choice {
    /// The experiment with all overrides; options of their own win over `--set`.
    fn experiment(&self) -> Result<Experiment, Error> {
        let mut experiment = Experiment::preset(&self.preset)?;
        for assignment in &self.set {
            experiment = experiment.set(assignment)?;
        }
        place(&experiment, "the preset", self.image.is_some(), self.data.is_some())?;
        let options = [
            ("--image", "data.image", &self.image),
            ("--data", "scene.path", &self.data),
            ("--seed", "run.seed", &self.seed),
            ("--device", "run.device", &self.device),
            ("--threads", "run.threads", &self.threads),
            ("--precision", "run.precision", &self.precision),
        ];
        set_options(&mut experiment, &options)?;
        if self.autotune {
            experiment.set_option("--autotune", "run.autotune", "true")?;
        }
        Ok(experiment)
    }
}

/// Sets what options of their own say: option, key, value.
fn set_options(experiment: &mut Experiment, options: &[(&str, &str, &Option<String>)]) -> Result<(), Error> {
    for (option, key, value) in options {
        if let Some(value) = value {
            experiment.set_option(option, key, value)?;
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    quiet_drivers();
    let done = match Cli::parse().command {
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Sweep(args) => sweep::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Video(args) => video::run(&args),
        Command::Devices => devices(),
        Command::Presets => presets(),
        Command::Explain(args) => explain::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Data(args) => data::run(&args),
        Command::MakeScene(args) => make_scene::run(&args),
    };
    match done {
        Ok(code) => code,
        Err(error) => {
            let bad_input = error.downcast_ref::<Error>().map(Error::is_bad_input);
            match bad_input {
                // These name their causes themselves.
                Some(_) => note!("error: {error}"),
                None => note!("error: {error:#}"),
            }
            ExitCode::from(if bad_input == Some(true) { 2 } else { 1 })
        }
    }
}

/// Mesa's drivers print an error, for windows that nobody asked for, where this variable is not set: in containers, as
/// root.
fn quiet_drivers() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the first thing the program does; no other thread runs that could read the environment.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
}

fn devices() -> anyhow::Result<ExitCode> {
    for device in raygrad::Device::list() {
        print(&format!("{:<10} {}  ({}; {})\n", device.id, device.name, device.backend, device.details))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn presets() -> anyhow::Result<ExitCode> {
    let width = PRESETS.iter().map(|p| p.name.len()).max().unwrap_or(0);
    for preset in PRESETS {
        print(&format!("{:width$}  {}\n", preset.name, preset.summary()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Set by the first Ctrl-C, which asks for a checkpoint; the second does not wait for it.
fn listen() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let handler = stop.clone();
    ctrlc::set_handler(move || {
        if handler.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })
    .context("cannot listen for Ctrl-C")?;
    Ok(stop)
}

/// Prints to standard output. A reader that has had enough, as `head`, is no error.
fn print(text: &str) -> anyhow::Result<()> {
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(e).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// A folder given for output, made if it is not there.
fn output_folder(path: &PathBuf) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|source| WriteError { path: path.clone(), source }.into())
}
