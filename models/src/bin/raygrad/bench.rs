//! `raygrad bench`: how long a training step takes, launch by launch, against what the device could do at best.

use crate::launches::{medians, profile, training, warm_up};
use crate::{Choice, print};
use clap::Args;
use raygrad::config::ConfigError;
use raygrad::report::median;
use raygrad::run::files::WriteError;
use raygrad::training::Training;
use raygrad_compiler::Program;
use raygrad_runtime::Device;
use serde::Serialize;
use serde_json::json;
use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

#[derive(Args)]
pub struct BenchArgs {
    #[command(flatten)]
    choice: Choice,
    /// Steps to time, after three that are not; by default as many as take about five seconds, at least ten.
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Also say what every launch takes, by the device's clock, against what the device does at best.
    #[arg(long)]
    launches: bool,
    /// Write the launches of a few steps as a trace for Perfetto (ui.perfetto.dev) or chrome://tracing.
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
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
    /// Multiply-adds from registers, on as many threads, measured in this run.
    peak_gflops: f64,
    /// Of cooperative matrices in registers, where the run uses them, measured in this run.
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_matrix_gflops: Option<f64>,
    peak_rss_mb: f64,
    /// Median time of the host for a step that it does not wait for; where it computes itself, there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    host_seconds_per_step: Option<f64>,
    /// With `--launches`: 10^9 bytes a second to and from memory, measured in this run.
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_gbytes: Option<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    per_launch: Vec<Launch>,
}

/// A launch of a step.
#[derive(Serialize)]
struct Launch {
    name: String,
    /// Median over the profiled steps, by the device's clock.
    seconds: f64,
    /// Of what it computes, and of every buffer it touches, once.
    gflop: f64,
    gbytes: f64,
    /// By the cost model.
    predicted_seconds: f64,
}

const SECONDS: f64 = 5.0;
const LEAST: usize = 10;
/// Steps that the host runs ahead.
const AHEAD: usize = 2;
/// How often the host's time is taken.
const HOST_STEPS: usize = 7;

pub fn run(args: &BenchArgs) -> anyhow::Result<ExitCode> {
    let mut experiment = args.choice.experiment()?;
    if args.steps == Some(0) {
        let refused: ConfigError = experiment.layered.refuse("--steps", "expected 1 or more, found 0");
        return Err(raygrad::Error::from(refused).into());
    }
    // A file that cannot be written is found out before the steps.
    let trace = args.trace.as_deref().map(trace_file).transpose()?;
    let mut trainer = training(&mut experiment)?;
    warm_up(&mut *trainer)?;
    let settings = &experiment.layered.settings;
    let threads = settings.run.threads.of(std::thread::available_parallelism().map_or(1, usize::from));
    let device = trainer.learner().device().clone();
    // The peak is looked at before the steps and after: the clock may change in between.
    let before = device.peak_gflops()?;
    let begun = Instant::now();
    let mut times = vec![];
    while args.steps.map_or(times.len() < LEAST || begun.elapsed().as_secs_f64() < SECONDS, |n| times.len() < n) {
        let step = Instant::now();
        trainer.step()?;
        trainer.wait()?;
        times.push(step.elapsed().as_secs_f64());
    }
    let peak = before.max(device.peak_gflops()?);
    let peak_matrix = device.peak_matrix_gflops()?;
    let on_cpu = matches!(device, Device::Cpu { .. });
    let host = if on_cpu { None } else { Some(host_seconds(&mut *trainer)?) };
    let profiled = if args.launches || args.trace.is_some() { profile(&mut *trainer)? } else { vec![] };
    // Before the buffer that passes through memory takes some of it.
    let peak_rss_mb = peak_rss_mb();
    let peak_gbytes = if args.launches { Some(device.peak_gbytes()?) } else { None };
    let program = trainer.learner().program(trainer.training_program());
    let of_lanes = device.lane_bytes(program);
    if let Some(file) = trace {
        write_trace(file, program, &of_lanes, &profiled)?;
    }
    let seconds = median(&times);
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
        peak_matrix_gflops: peak_matrix,
        peak_rss_mb,
        host_seconds_per_step: host,
        peak_gbytes,
        per_launch: if args.launches {
            launches(program, &of_lanes, &device.predicted(program), &profiled)
        } else {
            vec![]
        },
    };
    if args.json {
        print(&format!("{}\n", serde_json::to_string(&result)?))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut text = String::new();
    writeln!(text, "{} on {}, {}", result.preset, result.device, trainer.work())?;
    writeln!(text, "step      {:.2} ms (median of {}), {} launches", 1e3 * seconds, result.steps, result.launches)?;
    let best = peak_matrix.unwrap_or(peak);
    writeln!(text, "rate      {:.1} GFLOP/s of {:.1} ({:.0} %)", result.gflops, best, 100.0 * result.gflops / best)?;
    writeln!(text, "memory    {:.0} MB at most", result.peak_rss_mb)?;
    if let Some(host) = result.host_seconds_per_step {
        writeln!(text, "host      {:.0} us a step, beside the device", 1e6 * host)?;
    }
    if let Some(peak_gbytes) = peak_gbytes {
        write_launches(&mut text, &result.per_launch, best, peak_gbytes)?;
    }
    print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// Seconds that the host is busy with a step, a few of which it may leave to the device without waiting.
fn host_seconds(trainer: &mut dyn Training) -> anyhow::Result<f64> {
    let mut times = vec![];
    for _ in 0..HOST_STEPS {
        for _ in 0..AHEAD {
            let begun = Instant::now();
            trainer.step()?;
            times.push(begun.elapsed().as_secs_f64());
        }
        trainer.wait()?;
    }
    Ok(median(&times))
}

fn launches(program: &Program, of_lanes: &[u64], predicted: &[f64], profiled: &[Vec<f64>]) -> Vec<Launch> {
    let seconds = medians(profiled);
    let one = |(i, launch): (usize, &raygrad_compiler::plan::Launch)| Launch {
        name: launch.name.clone(),
        seconds: seconds[i],
        gflop: launch.region.flops() as f64 * 1e-9,
        gbytes: program.launch_bytes_of(i, |b| of_lanes[b.0 as usize]) as f64 * 1e-9,
        predicted_seconds: predicted[i],
    };
    program.launches.iter().enumerate().map(one).collect()
}

/// A line a launch: its share of the step, and its rates, absolute and in per cent of the best.
fn write_launches(text: &mut String, launches: &[Launch], peak: f64, peak_gbytes: f64) -> std::fmt::Result {
    let total: f64 = launches.iter().map(|l| l.seconds).sum();
    let width = launches.iter().map(|l| l.name.len()).max().unwrap_or(0).max(6);
    let predicted: f64 = launches.iter().map(|l| l.predicted_seconds).sum();
    writeln!(
        text,
        "\n{:width$}  {:>9}  {:>9}  {:>6}  {:>16}  {:>14}",
        "launch", "ms", "predicted", "share", "GFLOP/s", "GB/s"
    )?;
    for l in launches {
        let (flops, bytes) = (l.gflop / l.seconds.max(1e-9), l.gbytes / l.seconds.max(1e-9));
        writeln!(
            text,
            "{:width$}  {:>9.3}  {:>9.3}  {:>4.0} %  {:>9.1} ({:>2.0} %)  {:>7.1} ({:>2.0} %)",
            l.name,
            1e3 * l.seconds,
            1e3 * l.predicted_seconds,
            100.0 * l.seconds / total,
            flops,
            100.0 * flops / peak,
            bytes,
            100.0 * bytes / peak_gbytes,
        )?;
    }
    writeln!(
        text,
        "{:width$}  {:>9.3}  {:>9.3}          {:>9.1} at best   {:>7.1} at best",
        "all",
        1e3 * total,
        1e3 * predicted,
        peak,
        peak_gbytes
    )
}

/// A new file for a trace.
fn trace_file(path: &Path) -> anyhow::Result<(&Path, File)> {
    let file = File::create(path).map_err(|source| WriteError { path: path.to_path_buf(), source });
    Ok((path, file.map_err(raygrad::Error::from)?))
}

/// Complete events of the trace event format (times in microseconds), the steps one after the other.
fn write_trace(
    (path, mut file): (&Path, File),
    program: &Program,
    of_lanes: &[u64],
    profiled: &[Vec<f64>],
) -> anyhow::Result<()> {
    let mut events = vec![];
    let mut at = 0.0;
    for (number, step) in profiled.iter().enumerate() {
        let length: f64 = step.iter().sum();
        let name = format!("step {}", number + 1);
        events.push(json!({ "name": name, "ph": "X", "pid": 1, "tid": 1, "ts": at * 1e6, "dur": length * 1e6 }));
        for (i, (launch, seconds)) in program.launches.iter().zip(step).enumerate() {
            let megaflop = launch.region.flops() as f64 * 1e-6;
            let megabytes = program.launch_bytes_of(i, |b| of_lanes[b.0 as usize]) as f64 * 1e-6;
            events.push(json!({
                "name": launch.name, "ph": "X", "pid": 1, "tid": 1, "ts": at * 1e6, "dur": seconds * 1e6,
                "args": { "MFLOP": megaflop, "MB": megabytes },
            }));
            at += seconds;
        }
    }
    let text = serde_json::to_string(&json!({ "traceEvents": events, "displayTimeUnit": "ms" }))?;
    let written = file.write_all(text.as_bytes()).map_err(|source| WriteError { path: path.to_path_buf(), source });
    Ok(written.map_err(raygrad::Error::from)?)
}

/// Largest resident set of this process so far, in 10^6 bytes; 0 where the system does not tell.
fn peak_rss_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0 / 1e6
}
