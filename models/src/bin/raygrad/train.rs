//! `raygrad train`.

use crate::progress::Progress;
use crate::{Choice, listen, print};
use clap::Args;
use raygrad::Outcome;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct TrainArgs {
    #[command(flatten)]
    choice: Choice,
    /// Number of training steps.
    #[arg(long, value_name = "N")]
    steps: Option<String>,
    /// Perturbation file to register, instead of a drawn one.
    #[arg(long, value_name = "FILE")]
    perturbation: Option<String>,
    /// Weights of LPIPS, as scripts/convert_lpips.py writes them, to measure test views with.
    #[arg(long, value_name = "WEIGHTS")]
    lpips: Option<PathBuf>,
    /// Run folder; by default the first free one of runs/PRESET, runs/PRESET-2, ...
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Continue the run that the folder holds, bit by bit where it was left.
    #[arg(long)]
    resume: bool,
}

pub fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let mut experiment = args.choice.experiment()?.resume(args.resume);
    let options =
        [("--steps", "optim.steps", &args.steps), ("--perturbation", "data.perturbation", &args.perturbation)];
    crate::set_options(&mut experiment, &options)?;
    if let Some(weights) = &args.lpips {
        experiment = experiment.lpips(weights)?;
    }
    if let Some(out) = &args.out {
        experiment = experiment.out(out);
    }
    let layered = &experiment.layered;
    let own: Vec<String> = layered.of_scene().iter().map(|(key, value)| format!("{key} = {value}")).collect();
    if !own.is_empty() {
        note!("{} sets for {}: {}", layered.name, layered.settings.scene_name(), own.join(", "));
    }
    let stop = listen()?;
    let outcome = experiment.train_observed(&mut Progress::new(), &stop)?;
    tell(&outcome)
}

fn tell(outcome: &Outcome) -> anyhow::Result<ExitCode> {
    let folder = outcome.folder.display();
    if outcome.interrupted && outcome.trained {
        print(&format!(
            "stopped after the last step; `raygrad eval {folder}` measures the run, and the same command with \
             `--out {folder} --resume` writes its report as well\n"
        ))?;
        return Ok(ExitCode::from(130));
    }
    if outcome.interrupted {
        print(&format!("stopped; continue with the same command and `--out {folder} --resume`\n"))?;
        return Ok(ExitCode::from(130));
    }
    print(&format!("{}results       {folder}/report.html\n", outcome.summary))?;
    Ok(ExitCode::SUCCESS)
}
