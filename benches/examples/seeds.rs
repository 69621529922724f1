//! Registration over seeds: how often, and how well, each method finds the patches of the built-in photo.
//!
//! All methods of a seed see the same perturbation, initial neural image and pixel draws. A run succeeds as in
//! [`raygrad::evaluation::success_px`].

use anyhow::{Context, ensure};
use clap::Parser;
use raygrad::Experiment;
use raygrad::evaluation::{Cell, success_px};
use raygrad_benches::{Table, mean, median, quick, train};

#[derive(Parser)]
struct Args {
    /// First and one past the last seed.
    #[arg(long, default_value = "0..10", overrides_with = "seeds")]
    seeds: String,
    /// Presets to compare.
    #[arg(
        long,
        default_value = "planar-l2g-small,planar-barf-small,planar-naive-small",
        value_delimiter = ',',
        overrides_with = "presets"
    )]
    presets: Vec<String>,
    /// Override a setting of all of them.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

struct Run {
    corner: f64,
    psnr: f64,
    seconds: f64,
    success: bool,
}

fn main() -> anyhow::Result<()> {
    let mut args = Args::parse();
    if quick() {
        args.seeds = "0..1".into();
        args.set.extend(["optim.steps=2".into(), "data.points_per_patch=64".into()]);
    }
    let (first, end) = args.seeds.split_once("..").context("--seeds takes FIRST..END")?;
    let (first, end): (u32, u32) = (first.parse()?, end.parse()?);
    let mut runs: Vec<Vec<Run>> = args.presets.iter().map(|_| vec![]).collect();
    let mut head = vec!["seed"];
    head.extend(args.presets.iter().map(String::as_str));
    let mut table = Table::new(&head);
    for seed in first..end {
        let mut cells = vec![seed.to_string()];
        let mut perturbation = None;
        for (preset, runs) in args.presets.iter().zip(&mut runs) {
            let mut experiment = Experiment::preset(preset)?.set(&format!("run.seed={seed}"))?;
            for assignment in &args.set {
                experiment = experiment.set(assignment)?;
            }
            let (mut trainer, seconds) = train(preset, &experiment, |_| Ok(()))?;
            let found = trainer.evaluate()?.entry;
            let data = &trainer.data;
            let same = perturbation.get_or_insert_with(|| data.perturbation.clone()) == &data.perturbation;
            ensure!(same, "the perturbation of seed {seed} depends on the method");
            let allowed = success_px(data.grid.height, data.grid.width);
            let errors = found.corners().context("not a planar preset")?;
            let (corner, psnr) = (errors.mean, found.psnr_db());
            let run = Run { corner, psnr, seconds, success: corner < allowed };
            let per_patch: Vec<String> = errors.per_patch.iter().map(|e| format!("{e:.2}")).collect();
            eprintln!(
                "\r{preset} seed {seed}: {corner:.3} px ({}), {psnr:.2} dB, {seconds:.0} s",
                per_patch.join(", ")
            );
            cells.push(format!("{corner:.2} px, {psnr:.1} dB{}", if run.success { "" } else { " (fails)" }));
            runs.push(run);
        }
        table.row(cells);
    }
    println!("{table}");
    let mut table = Table::new(&["method", "successes", "median error, px", "error, px", "PSNR, dB", "mean seconds"]);
    for (preset, runs) in args.presets.iter().zip(&runs) {
        let of = |f: fn(&Run) -> f64| runs.iter().map(f).collect::<Vec<_>>();
        table.row([
            preset.clone(),
            format!("{} of {}", runs.iter().filter(|r| r.success).count(), runs.len()),
            format!("{:.2}", median(&of(|r| r.corner))),
            with_spread(&of(|r| r.corner)),
            with_spread(&of(|r| r.psnr)),
            format!("{:.0}", mean(&of(|r| r.seconds))),
        ]);
    }
    println!("{table}");
    Ok(())
}

/// Mean and standard deviation.
fn with_spread(values: &[f64]) -> String {
    match Cell::of(values) {
        Some(Cell { mean, spread: Some(spread) }) => format!("{mean:.2} +- {spread:.2}"),
        Some(Cell { mean, spread: None }) => format!("{mean:.2}"),
        None => String::new(),
    }
}
