//! `raygrad explain`: what an experiment compiles to. Needs no device.

use crate::{Choice, output_folder, print};
use clap::{Args, ValueEnum};
use raygrad::Experiment;
use raygrad::planar::{PlanarData, PlanarModel};
use raygrad::radiance::data::SpaceDataError;
use raygrad::radiance::{RadianceModel, SpaceData};
use raygrad::run::files::write_atomically;
use raygrad::training::learner::{compiled, untried};
use raygrad::warps;
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::graph::topological;
use raygrad_compiler::{Program, Step, Target};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

#[derive(Args)]
pub struct ExplainArgs {
    #[command(flatten)]
    choice: Choice,
    /// Print or write an artefact instead of the explanation; SPIR-V is binary and needs a folder.
    #[arg(long, value_enum, requires_if("spirv", "out"))]
    emit: Option<Artefact>,
    /// Folder for the artefacts, a file a kernel; without it they are printed.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Which kind of device to plan for.
    #[arg(long, value_enum, default_value = "cpu")]
    target: TargetChoice,
    /// Print how long each stage takes.
    #[arg(long)]
    timing: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Artefact {
    /// The recorded ops, forward, backward and optimiser.
    Graph,
    /// The launches with every instruction.
    Plan,
    /// The GPU kernels as WGSL.
    Wgsl,
    /// The GPU kernels as SPIR-V.
    Spirv,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum TargetChoice {
    Cpu,
    Gpu,
}

pub fn run(args: &ExplainArgs) -> anyhow::Result<ExitCode> {
    let experiment = args.choice.experiment()?;
    experiment.layered.validate().map_err(raygrad::Error::from)?;
    let gpu = args.target == TargetChoice::Gpu || matches!(args.emit, Some(Artefact::Wgsl | Artefact::Spirv));
    let target = if gpu { Target::gpu() } else { Target::cpu() };
    let (step, recorded) = record(&experiment, target.kind)?;
    let networks = experiment.layered.settings.run.networks;
    let program = compiled(&step, &target, networks, |both| Ok(untried(both, |p| p.predicted(|_| 4))))?;
    let files = match args.emit {
        None => vec![("explain.txt".to_string(), program.to_string().into_bytes())],
        Some(Artefact::Graph) => vec![("graph.txt".to_string(), graph(&step).into_bytes())],
        Some(Artefact::Plan) => vec![("plan.txt".to_string(), format!("{program:#?}\n").into_bytes())],
        Some(artefact @ (Artefact::Wgsl | Artefact::Spirv)) => kernels(&program, artefact)?,
    };
    match &args.out {
        Some(folder) => {
            output_folder(folder)?;
            for (name, bytes) in &files {
                write_atomically(&folder.join(name), bytes).map_err(raygrad::Error::from)?;
            }
            print(&format!("{} files in {}\n", files.len(), folder.display()))?;
        }
        None => {
            for (name, bytes) in &files {
                if files.len() > 1 {
                    print(&format!("// {name}\n"))?;
                }
                print(&String::from_utf8_lossy(bytes))?;
            }
        }
    }
    if args.timing {
        timing(recorded, &program)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The training step, and how long it took to record and differentiate it.
fn record(experiment: &Experiment, target: TargetKind) -> Result<(Step, Duration), raygrad::Error> {
    let settings = &experiment.layered.settings;
    if settings.scene.is_some() {
        let data = SpaceData::outline(&experiment.layered)?;
        let settings = &data.with_depths(settings);
        let views = data.scene.train.len();
        let begun = Instant::now();
        let warp = warps::of_settings(settings, views);
        let model = RadianceModel::new(settings, data.size, views, warp).map_err(SpaceDataError::from)?;
        return Ok((model.for_target(target).train_step(), begun.elapsed()));
    }
    let data = PlanarData::load(&experiment.layered)?;
    let begun = Instant::now();
    let warp = warps::of_settings(settings, settings.data.patches);
    Ok((PlanarModel::new(settings, data.grid, warp).for_target(target).train_step(), begun.elapsed()))
}

/// A file a kernel, numbered in the order in which they run.
#[cfg(feature = "gpu")]
fn kernels(program: &Program, artefact: Artefact) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    use raygrad_kernels::gpu::{Inputs, Limits, lower};
    // No adapter is asked: what a given one cannot bind is refused when the program is loaded onto it.
    let limits = Limits { max_binding: u64::MAX, ..Limits::default() };
    let lowered = lower(program, &mut Inputs::default(), &limits)?;
    let mut files = vec![];
    for (i, kernel) in lowered.launches.iter().flat_map(|l| &l.kernels).enumerate() {
        let name: String = kernel.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        files.push(match artefact {
            Artefact::Spirv => {
                let bytes = kernel.spirv()?.iter().flat_map(|word| word.to_le_bytes()).collect();
                (format!("{i:03}_{name}.spv"), bytes)
            }
            _ => (format!("{i:03}_{name}.wgsl"), kernel.wgsl()?.into_bytes()),
        });
    }
    Ok(files)
}

#[cfg(not(feature = "gpu"))]
fn kernels(_: &Program, _: Artefact) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    anyhow::bail!("this build has no GPU kernels (feature `wgpu` or `vulkan`)")
}

/// One line an op, operands before users.
fn graph(step: &Step) -> String {
    let mut text: String = topological(step.roots()).iter().map(|t| format!("{t:?}  // {}\n", t.source())).collect();
    for (name, tensor) in &step.outputs {
        text += &format!("output {name} = %{}\n", tensor.id());
    }
    for (input, value) in &step.updates {
        text += &format!("update {} = %{}\n", input.input_name().unwrap_or_default(), value.id());
    }
    text
}

fn timing(recorded: Duration, program: &Program) -> anyhow::Result<()> {
    let t = &program.timing;
    let stages = [("record, differentiate", recorded), ("simplify", t.simplify), ("fuse", t.fuse), ("plan", t.plan)];
    for (stage, time) in stages {
        print(&format!("{stage:<22} {:8.2} ms\n", 1e3 * time.as_secs_f64()))?;
    }
    let total: Duration = stages.iter().map(|s| s.1).sum();
    print(&format!("{:<22} {:8.2} ms\n", "total", 1e3 * total.as_secs_f64()))
}
