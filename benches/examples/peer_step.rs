//! One training step, planar or in space: raygrad against PyTorch and JAX, alternating in one run, in f32 and, if asked for, in
//! bf16, with the peak of the same minutes and each program's memory.
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
    /// Also the first step in mixed precision, against PyTorch's bf16 autocast and JAX in bf16. For CPUs with dot products of
    /// bfloat16; elsewhere raygrad computes them from single precision, and slower.
    #[arg(long)]
    mixed: bool,
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

/// A program that takes a step.
struct Program {
    name: String,
    kind: Kind,
    /// Compared with this one, by its place in the list.
    against: Option<usize>,
    runs: Vec<Timed>,
    /// What this device did at best while it ran; raygrad measures it.
    peaks: Vec<f64>,
}

#[derive(Clone, Copy)]
enum Kind {
    Raygrad { preset: &'static str, precision: &'static str },
    Peer { module: &'static str, dtype: &'static str },
}

fn main() -> anyhow::Result<()> {
    let mut args = Args::parse();
    if quick() {
        (args.rounds, args.rows) = (1, Some(64));
    }
    let mut programs = args.list();
    for round in 1..=args.rounds {
        for program in &mut programs {
            let (timed, peak) = match program.kind {
                Kind::Raygrad { preset, precision } => args.own(preset, precision)?,
                Kind::Peer { module, dtype } => (args.peer(module, dtype)?, f64::NAN),
            };
            let of_peak = if peak.is_nan() { String::new() } else { format!(", peak {peak:.0} GFLOP/s") };
            eprintln!("round {round}: {} {:.4} s{of_peak}", program.name, timed.seconds);
            program.runs.push(timed);
            program.peaks.push(peak);
        }
    }
    args.print(&programs);
    Ok(())
}

impl Args {
    fn rows(&self) -> usize {
        self.rows.unwrap_or(self.work.rows())
    }

    /// What takes turns: the steps of raygrad and its peers, in single precision and, if asked for, in mixed.
    fn list(&self) -> Vec<Program> {
        let mut all: Vec<Program> = vec![];
        let mut add = |name: String, kind, against| {
            all.push(Program { name, kind, against, runs: vec![], peaks: vec![] });
            all.len() - 1
        };
        let presets = self.work.presets();
        let there = |(_, module): &(&str, &'static str)| self.programs.has(module, &format!("import {module}, numpy"));
        let peers: Vec<(&str, &'static str)> =
            [("PyTorch", "torch"), ("JAX", "jax")].into_iter().filter(there).collect();
        let first =
            add(format!("raygrad {}", presets[0]), Kind::Raygrad { preset: presets[0], precision: "f32" }, None);
        for (name, module) in &peers {
            add(name.to_string(), Kind::Peer { module, dtype: "f32" }, Some(first));
        }
        for preset in &presets[1..] {
            add(format!("raygrad {preset}"), Kind::Raygrad { preset, precision: "f32" }, None);
        }
        if self.mixed {
            let kind = Kind::Raygrad { preset: presets[0], precision: "mixed" };
            let mixed = add(format!("raygrad {}, mixed", presets[0]), kind, Some(first));
            for (name, module) in &peers {
                add(format!("{name}, bf16"), Kind::Peer { module, dtype: "bf16" }, Some(mixed));
            }
        }
        all
    }

    fn own(&self, preset: &str, precision: &str) -> anyhow::Result<(Timed, f64)> {
        let mut command = self.programs.bench(preset);
        command.args(["--device", "cpu", "--precision", precision, "--threads", &self.threads.to_string()]);
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

    fn peer(&self, module: &str, dtype: &str) -> anyhow::Result<Timed> {
        let script = self.programs.script(&format!("{module}_step.py"));
        let mut command = self.programs.python();
        command.args(["-c", MEASURED]).arg(script).args(self.work.of_peers()).arg(self.rows().to_string());
        command.args(["--dtype", dtype]);
        if module == "torch" {
            command.args(["--threads", &self.threads.to_string()]);
        }
        let text = output(command)?;
        let before = |unit| number_before(&text, unit);
        Ok(Timed { seconds: before("s/step")?, gflop: before("GFLOP/step")?, rss_mb: before("MB")? })
    }

    fn print(&self, programs: &[Program]) {
        let ratios = |a: &Program, b: &Program, f: fn(&Timed) -> f64| {
            median(&a.runs.iter().zip(&b.runs).map(|(a, b)| f(a) / f(b)).collect::<Vec<_>>())
        };
        let rate = |t: &Timed| t.gflop / t.seconds;
        println!(
            "{}, {} threads, medians of {} rounds; peak of f32 {:.0} GFLOP/s (multiply-adds from registers)\n",
            self.work.title(self.rows()),
            self.threads,
            self.rounds,
            median(&programs[0].peaks)
        );
        let mut table =
            Table::new(&["program", "s/step", "GFLOP/step", "GFLOP/s", "of the peak", "memory, MB", "compared"]);
        for program in programs {
            let of = |f: &dyn Fn(&Timed) -> f64| median(&program.runs.iter().map(f).collect::<Vec<_>>());
            let against = program.against.map(|i| &programs[i]);
            // A peer's rate is compared with what raygrad found beside it, of the same products.
            let peaks = if let Kind::Peer { .. } = program.kind { against.unwrap_or(program) } else { program };
            let shares: Vec<f64> =
                program.runs.iter().zip(&peaks.peaks).map(|(t, peak)| 100.0 * rate(t) / peak).collect();
            let compared = against.map_or(String::new(), |other| {
                let (slower, larger) = (ratios(program, other, |t| t.seconds), ratios(program, other, |t| t.rss_mb));
                format!("{slower:.2} x the time, {larger:.1} x the memory of {}", other.name)
            });
            table.row([
                program.name.clone(),
                format!("{:.4}", of(&|t| t.seconds)),
                format!("{:.1}", of(&|t| t.gflop)),
                format!("{:.1}", of(&rate)),
                format!("{:.0} %", median(&shares)),
                format!("{:.0}", of(&|t| t.rss_mb)),
                compared,
            ]);
        }
        println!("{table}");
    }
}
