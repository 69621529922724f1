//! Training steps at the papers' sizes on this machine's GPU: raygrad through wgpu and Vulkan, in single and in mixed
//! precision, against PyTorch on the same device, alternating in one run, and against the rates that the device reaches at
//! best. Writes one Markdown file.
//!
//! Every number is a median over rounds. PyTorch runs f32 with TF32 off, which is its default.

use anyhow::{Context, ensure};
use clap::Parser;
use raygrad_benches::{Programs, Table, median, number_before, output, quick};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;

#[derive(Parser)]
struct Args {
    #[command(flatten)]
    programs: Programs,
    /// Folder of the result, `<device>.md`.
    #[arg(long)]
    out: PathBuf,
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    /// What `raygrad --device` takes.
    #[arg(long, default_value = "wgpu,vulkan", value_delimiter = ',')]
    devices: Vec<String>,
    /// What `raygrad --precision` takes.
    #[arg(long, default_value = "f32,mixed", value_delimiter = ',')]
    precisions: Vec<String>,
    /// Steps of a measurement, by default as many as take about five seconds.
    #[arg(long)]
    steps: Option<usize>,
    /// A share of the papers' sizes, where the device is slow or small.
    #[arg(long, default_value_t = 1.0)]
    scale: f64,
}

/// A step that raygrad and PyTorch take.
struct Work {
    preset: &'static str,
    title: &'static str,
    setting: &'static str,
    rows: f64,
    /// Name and size in torch_step.py.
    peer: [&'static str; 2],
    /// Steps of the paper's run.
    steps: f64,
}

const WORKS: [Work; 2] = [
    Work {
        preset: "planar-l2g",
        title: "planar L2G, 5 patches x points",
        setting: "data.points_per_patch",
        rows: 32400.0,
        peer: ["planar", "--pixels"],
        steps: 5000.0,
    },
    Work {
        preset: "l2g-blender",
        title: "L2G in space, rays x 128 samples, 8 x 256",
        setting: "train.rays",
        rows: 1024.0,
        peer: ["l2g", "--rays"],
        steps: 200_000.0,
    },
];

/// Steps of narrow networks, which a GPU runs layer by layer or in a workgroup each.
const NARROW: [&str; 3] = ["nerf-small", "l2g-small", "planar-inn-small"];
const NETWORKS: [&str; 2] = ["layered", "resident"];

/// How PyTorch runs.
const PEERS: [(&str, &[&str]); 5] = [
    ("PyTorch f32", &[]),
    ("PyTorch f32, compiled", &["--compile"]),
    ("PyTorch bf16", &["--dtype", "bf16"]),
    ("PyTorch bf16, compiled", &["--dtype", "bf16", "--compile"]),
    ("PyTorch f16, compiled", &["--dtype", "f16", "--compile"]),
];

/// What `raygrad bench --json --launches` prints.
#[derive(Deserialize)]
struct Bench {
    device: String,
    rows: usize,
    launches: usize,
    seconds_per_step: f64,
    gflop_per_step: f64,
    peak_gflops: f64,
    peak_matrix_gflops: Option<f64>,
    peak_gbytes: f64,
    host_seconds_per_step: f64,
    per_launch: Vec<Launch>,
}

#[derive(Deserialize)]
struct Launch {
    name: String,
    seconds: f64,
    gflop: f64,
    gbytes: f64,
}

fn main() -> anyhow::Result<()> {
    let mut args = Args::parse();
    if quick() {
        (args.rounds, args.devices, args.steps) = (1, vec!["vulkan".into()], Some(1));
    }
    let has_gpu = args.programs.has("PyTorch", "import torch; assert torch.cuda.is_available()");
    let peers = if has_gpu { &PEERS[..] } else { &[] };
    let (mut text, mut device) = (String::new(), String::new());
    for work in &WORKS {
        let mut own: BTreeMap<String, Vec<Bench>> = BTreeMap::new();
        let mut others: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for round in 1..=args.rounds {
            for backend in &args.devices {
                for precision in &args.precisions {
                    let Some(bench) = args.own(work, backend, precision)? else { continue };
                    let name = format!("{backend}, {precision}");
                    eprintln!("round {round}: {} on {name} {:.4} s", work.preset, bench.seconds_per_step);
                    device.clone_from(&bench.device);
                    own.entry(name).or_default().push(bench);
                    args.write(&device, &reported(&text, work, &own, &others)?)?;
                }
            }
            ensure!(!device.is_empty(), "no device was asked for");
            let rows = own.values().flatten().last().map_or(0, |b| b.rows);
            for (name, options) in peers {
                let seconds = args.peer(work, rows, options)?;
                eprintln!("round {round}: {} in {name} {seconds:.4} s", work.preset);
                others.entry(name).or_default().push(seconds);
                args.write(&device, &reported(&text, work, &own, &others)?)?;
            }
        }
        text = reported(&text, work, &own, &others)?;
    }
    args.narrow(&mut text)?;
    let file = args.write(&device, &text)?;
    print!("{text}");
    println!("written to {}", file.display());
    Ok(())
}

impl Args {
    /// Writes what there is so far.
    fn write(&self, device: &str, text: &str) -> anyhow::Result<PathBuf> {
        let words: Vec<&str> = device.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty()).collect();
        let file = self.out.join(format!("{}.md", words.join("-")));
        let steps = self.steps.map_or(String::new(), |n| format!(" --steps {n}"));
        let devices = self.devices.join(",");
        let (rounds, scale) = (self.rounds, self.scale);
        let head = format!(
            "# {device}\n\n`benches/gpu.sh --rounds {rounds} --scale {scale}{steps} --devices {devices}`, medians.\n"
        );
        std::fs::create_dir_all(&self.out).with_context(|| format!("cannot make {}", self.out.display()))?;
        std::fs::write(&file, head + text).with_context(|| format!("cannot write {}", file.display()))?;
        Ok(file)
    }

    /// `None` where the device lacks the precision.
    fn own(&self, work: &Work, device: &str, precision: &str) -> anyhow::Result<Option<Bench>> {
        let rows = if quick() { 64.0 } else { (work.rows * self.scale).round() };
        let rows = format!("{}={rows}", work.setting);
        let mut options = vec!["--set", &rows];
        if !work.preset.starts_with("planar") {
            // A step takes as long for small pictures, and its scene is made sooner.
            options.extend(["--set", "scene.image_size=[64,64]"]);
        }
        self.bench(work.preset, device, precision, &options)
    }

    fn bench(&self, preset: &str, device: &str, precision: &str, options: &[&str]) -> anyhow::Result<Option<Bench>> {
        let mut command = self.programs.bench(preset);
        command.args(["--launches", "--device", device, "--precision", precision]).args(options);
        if quick() {
            command.args(["--set", "field.layers=[16,16]"]);
            command.args(["--set", "warp.layers=[16,16]", "--set", "warp.skip=[]"]);
            if !preset.starts_with("planar") {
                command.args(["--set", "scene.image_size=[16,16]", "--set", "scene.train_views=4"]);
                command.args(["--set", "radiance.skip=[]", "--set", "train.samples=8"]);
            }
        }
        if let Some(steps) = self.steps {
            command.args(["--steps", &steps.to_string()]);
        }
        match output(command) {
            Err(e) if format!("{e:#}").contains("no half precision") => Ok(None),
            found => Ok(Some(serde_json::from_str(&found?)?)),
        }
    }

    /// Steps of narrow networks in both forms, alternating.
    fn narrow(&self, text: &mut String) -> anyhow::Result<()> {
        writeln!(text, "\n## Narrow networks, ms a step\n")?;
        let mut table = Table::new(&["preset", "device", "layered", "launches", "resident", "launches", "ratio"]);
        // A software driver takes a minute to compile the kernels of all.
        let (presets, precisions) = if quick() { (1, 1) } else { (NARROW.len(), self.precisions.len()) };
        let precisions = &self.precisions[..precisions];
        for preset in &NARROW[..presets] {
            for (device, precision) in self.devices.iter().flat_map(|d| precisions.iter().map(move |p| (d, p))) {
                let mut runs: [Vec<Bench>; 2] = Default::default();
                for round in 1..=self.rounds {
                    for (form, runs) in NETWORKS.iter().zip(&mut runs) {
                        let set = format!("run.networks={form}");
                        let Some(bench) = self.bench(preset, device, precision, &["--set", &set])? else { continue };
                        eprintln!(
                            "round {round}: {preset}, {form}, on {device}, {precision} {:.4} s",
                            bench.seconds_per_step
                        );
                        runs.push(bench);
                    }
                }
                let seconds = |runs: &[Bench]| median(&runs.iter().map(|b| b.seconds_per_step).collect::<Vec<_>>());
                let [Some(a), Some(b)] = [runs[0].last(), runs[1].last()] else { continue };
                let (layered, resident) = (seconds(&runs[0]), seconds(&runs[1]));
                table.row([
                    preset.to_string(),
                    format!("{device}, {precision}"),
                    format!("{:.2}", 1e3 * layered),
                    a.launches.to_string(),
                    format!("{:.2}", 1e3 * resident),
                    b.launches.to_string(),
                    format!("{:.2}", layered / resident),
                ]);
            }
        }
        Ok(write!(text, "{table}")?)
    }

    /// Seconds of a step in PyTorch, on as many points of a patch, or rays.
    fn peer(&self, work: &Work, rows: usize, options: &[&str]) -> anyhow::Result<f64> {
        let mut command = self.programs.python();
        command.arg(self.programs.script("torch_step.py")).args(work.peer).arg(rows.to_string());
        command.args(["--device", "cuda", "--iters", "20"]).args(options);
        number_before(&output(command)?, "s/step")
    }
}

/// The text with what was measured of one step.
fn reported(
    text: &str,
    work: &Work,
    own: &BTreeMap<String, Vec<Bench>>,
    others: &BTreeMap<&str, Vec<f64>>,
) -> Result<String, std::fmt::Error> {
    let mut text = text.to_string();
    report(&mut text, work, own, others)?;
    Ok(text)
}

fn report(
    text: &mut String,
    work: &Work,
    own: &BTreeMap<String, Vec<Bench>>,
    others: &BTreeMap<&str, Vec<f64>>,
) -> std::fmt::Result {
    let of = |runs: &[Bench], f: fn(&Bench) -> f64| median(&runs.iter().map(f).collect::<Vec<_>>());
    let all: Vec<&Bench> = own.values().flatten().collect();
    let Some(last) = all.last() else { return Ok(()) };
    let best = |f: fn(&Bench) -> f64| median(&all.iter().map(|b| f(b)).collect::<Vec<_>>());
    let (peak, bytes) = (best(|b| b.peak_gflops), best(|b| b.peak_gbytes));
    writeln!(text, "\n## {} ({} rows)\n", work.title, last.rows)?;
    let matrices: Vec<f64> = all.iter().filter_map(|b| b.peak_matrix_gflops).collect();
    let matrices = (!matrices.is_empty()).then(|| median(&matrices));
    let products = matrices.map_or(String::new(), |m| format!("{m:.0} GFLOP/s of cooperative matrices, "));
    writeln!(
        text,
        "At best: {peak:.0} GFLOP/s of f32 multiply-adds, {products}{bytes:.0} GB/s of memory, all measured here.\n"
    )?;
    let hours = format!("{:.0} steps, min", work.steps);
    let heads = ["program", "ms a step", "GFLOP/s", "of f32 at best", "of matrices at best", "host, us", &hours];
    let mut table = Table::new(&heads);
    let mut row = |name: String, seconds: f64, host: Option<f64>| {
        let rate = last.gflop_per_step / seconds;
        table.row([
            name,
            format!("{:.2}", 1e3 * seconds),
            format!("{rate:.0}"),
            format!("{:.0} %", 100.0 * rate / peak),
            matrices.map_or(String::new(), |m| format!("{:.0} %", 100.0 * rate / m)),
            host.map_or(String::new(), |s| format!("{:.0}", 1e6 * s)),
            format!("{:.1}", seconds * work.steps / 60.0),
        ]);
    };
    for (device, runs) in own {
        let host = of(runs, |b| b.host_seconds_per_step);
        row(format!("raygrad, {device}"), of(runs, |b| b.seconds_per_step), Some(host));
    }
    for (name, runs) in others {
        row(name.to_string(), median(runs), None);
    }
    write!(text, "{table}")?;
    for (device, runs) in own {
        let last = &runs[runs.len() - 1];
        launches(text, device, last, last.peak_matrix_gflops.unwrap_or(peak), bytes)?;
    }
    Ok(())
}

/// The launches that take most of a step.
fn launches(text: &mut String, device: &str, bench: &Bench, peak: f64, bytes: f64) -> std::fmt::Result {
    const SHOWN: usize = 12;
    let total: f64 = bench.per_launch.iter().map(|l| l.seconds).sum();
    let mut slowest: Vec<&Launch> = bench.per_launch.iter().collect();
    slowest.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
    writeln!(
        text,
        "\n{device}: {} launches, {:.2} ms by the device's clock; the slowest\n",
        bench.launches,
        1e3 * total
    )?;
    let arithmetic = if bench.peak_matrix_gflops.is_some() { "of matrices at best" } else { "of f32 at best" };
    let mut table = Table::new(&["launch", "ms", "share", arithmetic, "of memory at best"]);
    for l in slowest.into_iter().take(SHOWN) {
        table.row([
            l.name.clone(),
            format!("{:.3}", 1e3 * l.seconds),
            format!("{:.0} %", 100.0 * l.seconds / total),
            format!("{:.0} %", 100.0 * l.gflop / l.seconds / peak),
            format!("{:.0} %", 100.0 * l.gbytes / l.seconds / bytes),
        ]);
    }
    write!(text, "{table}")
}
