//! One training step, planar or in space: raygrad against PyTorch and JAX, alternating in one run, with the multiply-add peak of the
//! same minutes and each program's memory.
//!
//! Speeds on a shared machine drift: every number is a median over rounds, and every ratio is taken within a round first.

use clap::{Parser, ValueEnum};
use raygrad_benches::{Programs, Table, median, number_before, output, quick};
use serde::Deserialize;

#[derive(Parser)]
struct Args {
    work: Work,
    #[command(flatten)]
    programs: Programs,
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Points of a patch, or rays of a step; by default 4096 and 200 (two of each of the scene's 100 views).
    #[arg(long)]
    rows: Option<usize>,
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// A step that raygrad and its peers take.
#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Work {
    /// Five patches, registered by L2G; BARF's step, which has no fit, beside it.
    Planar,
    /// Rays of 128 samples, L2G at the paper's width.
    Space,
}

impl Work {
    /// What raygrad trains; the first is what peers train too.
    fn presets(self) -> &'static [&'static str] {
        match self {
            Work::Planar => &["planar-l2g", "planar-barf"],
            Work::Space => &["l2g-blender"],
        }
    }
    fn rows(self) -> usize {
        match self {
            Work::Planar => 4096,
            Work::Space => 200,
        }
    }
    fn setting(self) -> &'static str {
        match self {
            Work::Planar => "data.points_per_patch",
            Work::Space => "train.rays",
        }
    }
    /// The same for the peers' scripts.
    fn of_peers(self) -> [&'static str; 2] {
        match self {
            Work::Planar => ["planar", "--pixels"],
            Work::Space => ["l2g", "--rays"],
        }
    }
    fn title(self, rows: usize) -> String {
        match self {
            Work::Planar => format!("5 x {rows} points"),
            Work::Space => format!("{rows} rays x 128 samples"),
        }
    }
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

fn main() -> anyhow::Result<()> {
    let mut args = Args::parse();
    if quick() {
        (args.rounds, args.rows) = (1, Some(64));
    }
    let presets = args.work.presets();
    let there = |(_, module): &(&str, &str)| args.programs.has(module, &format!("import {module}, numpy"));
    let peers: Vec<(&str, &str)> = [("PyTorch", "torch"), ("JAX", "jax")].into_iter().filter(there).collect();
    let mut own: Vec<Vec<(Timed, f64)>> = vec![vec![]; presets.len()];
    let mut others: Vec<Vec<Timed>> = vec![vec![]; peers.len()];
    for round in 1..=args.rounds {
        for i in 0..presets.len().max(peers.len()) {
            if let Some(preset) = presets.get(i) {
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
    fn rows(&self) -> usize {
        self.rows.unwrap_or(self.work.rows())
    }

    fn own(&self, preset: &str) -> anyhow::Result<(Timed, f64)> {
        let mut command = self.programs.bench(preset);
        command.args(["--device", "cpu", "--threads", &self.threads.to_string()]);
        command.args(["--set", &format!("{}={}", self.work.setting(), self.rows())]);
        if quick() {
            command.args(["--steps", "2"]);
            if self.work == Work::Space {
                command.args(["--set", "scene.image_size=[16,16]", "--set", "scene.train_views=4"]);
            }
        }
        let bench: Bench = serde_json::from_str(&output(command)?)?;
        let timed = Timed { seconds: bench.seconds_per_step, gflop: bench.gflop_per_step, rss_mb: bench.peak_rss_mb };
        Ok((timed, bench.peak_gflops))
    }

    fn peer(&self, module: &str) -> anyhow::Result<Timed> {
        let script = self.programs.script(&format!("{module}_step.py"));
        let mut command = self.programs.python();
        command.args(["-c", MEASURED]).arg(script).args(self.work.of_peers()).arg(self.rows().to_string());
        if module == "torch" {
            command.args(["--threads", &self.threads.to_string()]);
        }
        let text = output(command)?;
        let before = |unit| number_before(&text, unit);
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
            "{}, f32, {} threads, medians of {} rounds; peak {:.0} GFLOP/s (multiply-adds from registers)\n",
            self.work.title(self.rows()),
            self.threads,
            self.rounds,
            median(&peaks.concat())
        );
        let mut table =
            Table::new(&["program", "s/step", "GFLOP/step", "GFLOP/s", "of the peak", "memory, MB", "against raygrad"]);
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
        for (i, preset) in self.work.presets().iter().enumerate() {
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
