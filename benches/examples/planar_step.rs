//! One planar training step: raygrad against PyTorch and JAX, alternating in one run, with the multiply-add peak of the
//! same minutes and each program's memory.
//!
//! Speeds on a shared machine drift: every number is a median over rounds, and every ratio is taken within a round first.

use anyhow::{Context, bail};
use clap::Parser;
use raygrad_benches::{Table, median, quick};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::process::Command;

#[derive(Parser)]
struct Args {
    /// The command raygrad.
    #[arg(long)]
    raygrad: PathBuf,
    /// Python with torch, jax and numpy; what it lacks is left out.
    #[arg(long)]
    python: PathBuf,
    /// Folder of torch_step.py and jax_step.py.
    #[arg(long)]
    peers: PathBuf,
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    #[arg(long, default_value_t = 4096)]
    points: usize,
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// One timed program in one round.
#[derive(Clone, Copy)]
struct Timed {
    seconds: f64,
    gflop: f64,
    rss_mb: f64,
}

/// What `raygrad bench --json` prints.
#[derive(Deserialize)]
struct Bench {
    seconds_per_step: f64,
    gflop_per_step: f64,
    peak_gflops: f64,
    peak_rss_mb: f64,
}

/// Runs a script as `python script args` would, and prints the peak resident set at the end.
const MEASURED: &str = "import resource, runpy, sys
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name='__main__')
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, 'MB')";

const OWN: [&str; 2] = ["planar-l2g", "planar-barf"];

fn main() -> anyhow::Result<()> {
    let mut args = Args::parse();
    if quick() {
        (args.rounds, args.points) = (1, 64);
    }
    let peers: Vec<(&str, &str)> =
        [("PyTorch", "torch"), ("JAX", "jax")].into_iter().filter(|(_, module)| args.has(module)).collect();
    let mut own: Vec<Vec<(Timed, f64)>> = vec![vec![]; OWN.len()];
    let mut others: Vec<Vec<Timed>> = vec![vec![]; peers.len()];
    for round in 1..=args.rounds {
        for i in 0..OWN.len().max(peers.len()) {
            if let Some(preset) = OWN.get(i) {
                let (timed, peak) = args.own(preset)?;
                let share = 100.0 * timed.gflop / timed.seconds / peak;
                eprintln!("round {round}: {preset} {:.4} s, peak {peak:.0} GFLOP/s ({share:.0} %)", timed.seconds);
                own[i].push((timed, peak));
            }
            if let Some((name, module)) = peers.get(i) {
                let timed = args.peer(module)?;
                eprintln!("round {round}: {name} {:.4} s", timed.seconds);
                others[i].push(timed);
            }
        }
    }
    args.print(&peers, &own, &others);
    Ok(())
}

impl Args {
    fn has(&self, module: &str) -> bool {
        let found = Command::new(&self.python).args(["-c", &format!("import {module}, numpy")]).output();
        let there = found.is_ok_and(|o| o.status.success());
        if !there {
            eprintln!("{module} is left out: {} cannot import it", self.python.display());
        }
        there
    }

    fn own(&self, preset: &str) -> anyhow::Result<(Timed, f64)> {
        let mut command = Command::new(&self.raygrad);
        command.args(["bench", preset, "--json", "--device", "cpu", "--threads", &self.threads.to_string()]);
        command.args(["--set", &format!("data.points_per_patch={}", self.points)]);
        if quick() {
            command.args(["--steps", "2"]);
        }
        let bench: Bench = serde_json::from_str(&output(command)?)?;
        let timed = Timed { seconds: bench.seconds_per_step, gflop: bench.gflop_per_step, rss_mb: bench.peak_rss_mb };
        Ok((timed, bench.peak_gflops))
    }

    fn peer(&self, module: &str) -> anyhow::Result<Timed> {
        let script: &Path = &self.peers.join(format!("{module}_step.py"));
        let mut command = Command::new(&self.python);
        command.args(["-c", MEASURED]).arg(script).args(["planar", "--pixels", &self.points.to_string()]);
        if module == "torch" {
            command.args(["--threads", &self.threads.to_string()]);
        }
        let text = output(command)?;
        let words: Vec<&str> = text.split_whitespace().collect();
        let before = |unit: &str| -> anyhow::Result<f64> {
            let at = words.iter().position(|w| *w == unit).filter(|at| *at > 0);
            let word = words[at.with_context(|| format!("no `{unit}` in `{text}`"))? - 1];
            word.parse().with_context(|| format!("`{word}` is no number"))
        };
        Ok(Timed { seconds: before("s/step")?, gflop: before("GFLOP/step")?, rss_mb: before("MB")? })
    }

    fn print(&self, peers: &[(&str, &str)], own: &[Vec<(Timed, f64)>], others: &[Vec<Timed>]) {
        let of = |runs: &[Timed], f: &dyn Fn(&Timed) -> f64| median(&runs.iter().map(f).collect::<Vec<_>>());
        let peaks: Vec<Vec<f64>> = own.iter().map(|runs| runs.iter().map(|r| r.1).collect()).collect();
        let timed: Vec<Vec<Timed>> = own.iter().map(|runs| runs.iter().map(|r| r.0).collect()).collect();
        let ratios = |a: &[Timed], b: &[Timed], f: fn(&Timed) -> f64| {
            median(&a.iter().zip(b).map(|(a, b)| f(a) / f(b)).collect::<Vec<_>>())
        };
        let rate = |t: &Timed| t.gflop / t.seconds;
        println!(
            "5 x {} points, f32, {} threads, medians of {} rounds; peak {:.0} GFLOP/s (multiply-adds from registers)\n",
            self.points,
            self.threads,
            self.rounds,
            median(&peaks.concat())
        );
        let mut table = Table::new(&[
            "program",
            "s/step",
            "GFLOP/step",
            "GFLOP/s",
            "of the peak",
            "memory, MB",
            "against planar-l2g",
        ]);
        let mut row = |name: &str, runs: &[Timed], peaks: &[f64], against: String| {
            let shares: Vec<f64> = runs.iter().zip(peaks).map(|(t, peak)| 100.0 * rate(t) / peak).collect();
            table.row([
                name.to_string(),
                format!("{:.4}", of(runs, &|t| t.seconds)),
                format!("{:.1}", of(runs, &|t| t.gflop)),
                format!("{:.1}", of(runs, &rate)),
                format!("{:.0} %", median(&shares)),
                format!("{:.0}", of(runs, &|t| t.rss_mb)),
                against,
            ]);
        };
        for (i, preset) in OWN.iter().enumerate() {
            row(&format!("raygrad {preset}"), &timed[i], &peaks[i], String::new());
        }
        for ((name, _), runs) in peers.iter().zip(others) {
            let slower = ratios(runs, &timed[0], |t| t.seconds);
            let larger = ratios(runs, &timed[0], |t| t.rss_mb);
            row(name, runs, &peaks[0], format!("{slower:.2} x the time, {larger:.1} x the memory"));
        }
        println!("{table}");
    }
}

fn output(mut command: Command) -> anyhow::Result<String> {
    let done = command.output().with_context(|| format!("cannot start {command:?}"))?;
    if !done.status.success() {
        bail!("{command:?} failed: {}", String::from_utf8_lossy(&done.stderr));
    }
    Ok(String::from_utf8(done.stdout)?)
}
