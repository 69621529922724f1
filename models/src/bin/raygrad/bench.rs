//! `raygrad bench`: how long a training step takes, against what the machine could do at best.

use crate::Choice;
use clap::Args;
use raygrad::config::{ConfigError, Count};
use raygrad_kernels::cpu::peak::peak_gflops;
use serde::Serialize;
use std::process::ExitCode;
use std::time::Instant;

#[derive(Args)]
pub struct BenchArgs {
    #[command(flatten)]
    choice: Choice,
    /// Steps to time, after three that are not; by default as many as take about five seconds, at least ten.
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Result {
    preset: String,
    device: String,
    threads: usize,
    /// Points of a patch, or rays, of a step.
    rows: usize,
    steps: usize,
    launches: usize,
    /// Median over the timed steps.
    seconds_per_step: f64,
    /// Six operations a weight and row.
    gflop_per_step: f64,
    gflops: f64,
    /// Fused multiply-adds from registers on as many threads, measured in this run.
    peak_gflops: f64,
    peak_rss_mb: f64,
}

const WARM_UP: usize = 3;
const SECONDS: f64 = 5.0;
const LEAST: usize = 10;

pub fn run(args: &BenchArgs) -> anyhow::Result<ExitCode> {
    let mut experiment = args.choice.experiment()?;
    if let Some(scene) = &mut experiment.layered.settings.scene {
        // A step needs the training views alone.
        (scene.val_views, scene.test_views) = (Count::Of(0), Count::Of(0));
    }
    let mut trainer = experiment.training()?;
    let settings = &experiment.layered.settings;
    let threads = settings.run.threads.of(std::thread::available_parallelism().map_or(1, usize::from));
    if args.steps == Some(0) {
        let refused: ConfigError = experiment.layered.refuse("--steps", "expected 1 or more, found 0");
        return Err(raygrad::Error::from(refused).into());
    }
    for _ in 0..WARM_UP {
        trainer.step()?;
        trainer.wait()?;
    }
    // Half of the peak before the steps and half after: the clock may change in between.
    let mut peak = peak_gflops(threads, 150.0);
    let begun = Instant::now();
    let mut times = vec![];
    while args.steps.map_or(times.len() < LEAST || begun.elapsed().as_secs_f64() < SECONDS, |n| times.len() < n) {
        let step = Instant::now();
        trainer.step()?;
        trainer.wait()?;
        times.push(step.elapsed().as_secs_f64());
    }
    peak = peak.max(peak_gflops(threads, 150.0));
    times.sort_by(f64::total_cmp);
    let seconds = times[times.len() / 2];
    let gflop = trainer.flops() / 1e9;
    let result = Result {
        preset: args.choice.preset.clone(),
        device: trainer.learner().device_name(),
        threads,
        rows: trainer.rows(),
        steps: times.len(),
        launches: trainer.launches(),
        seconds_per_step: seconds,
        gflop_per_step: gflop,
        gflops: gflop / seconds,
        peak_gflops: peak,
        peak_rss_mb: peak_rss_mb(),
    };
    if args.json {
        println!("{}", serde_json::to_string(&result)?);
        return Ok(ExitCode::SUCCESS);
    }
    println!("{} on {}, {}", result.preset, result.device, trainer.work());
    println!("step      {:.2} ms (median of {}), {} launches", 1e3 * seconds, result.steps, result.launches);
    println!("rate      {:.1} GFLOP/s of {:.1} ({:.0} %)", result.gflops, peak, 100.0 * result.gflops / peak);
    println!("memory    {:.0} MB at most", result.peak_rss_mb);
    Ok(ExitCode::SUCCESS)
}

/// Largest resident set of this process so far, in 10^6 bytes; 0 where the system does not tell.
fn peak_rss_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0 / 1e6
}
