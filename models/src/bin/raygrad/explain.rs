//! `raygrad explain`: what an experiment compiles to. With `--device` what it compiles to there, and what every launch takes;
//! otherwise no device is asked.

use crate::launches::{medians, profile, training, warm_up};
use crate::{Choice, output_folder, print};
use clap::{Args, ValueEnum};
use raygrad::Experiment;
use raygrad::planar::{PlanarData, PlanarModel};
use raygrad::radiance::data::SpaceDataError;
use raygrad::radiance::{RadianceModel, SpaceData};
use raygrad::run::files::{WriteError, write_atomically};
use raygrad::training::learner::{compiled, untried};
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::graph::topological;
use raygrad_compiler::plan::explain::Measured;
use raygrad_compiler::{Program, Step, Target};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};
#[cfg(feature = "gpu")]
use {
    raygrad::config::Precision,
    raygrad_kernels::gpu::{Half, Inputs, Limits, Matrices, lower},
    raygrad_runtime::Forms,
};

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
    /// Which kind of device to plan for, where none is named; with `--device` the plan is for that one, and a few steps there
    /// say how long every launch takes.
    #[arg(long, value_enum, default_value = "cpu", conflicts_with = "device")]
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
    let mut experiment = args.choice.experiment()?;
    experiment.layered.validate().map_err(raygrad::Error::from)?;
    let (plan, step, recorded) = match args.choice.device {
        Some(_) => on_device(&mut experiment, args.emit)?,
        None => untested(&experiment, args)?,
    };
    let files = match args.emit {
        None => {
            let of_lanes = &plan.of_lanes;
            let page = plan.program.explained(|b| of_lanes[b.0 as usize], plan.measured.as_ref());
            vec![("explain.txt".to_string(), page.into_bytes())]
        }
        Some(Artefact::Graph) => vec![("graph.txt".to_string(), graph(&step).into_bytes())],
        Some(Artefact::Plan) => vec![("plan.txt".to_string(), format!("{:#?}\n", plan.program).into_bytes())],
        Some(artefact @ (Artefact::Wgsl | Artefact::Spirv)) => kernels(&experiment, &plan, artefact)?,
    };
    match &args.out {
        Some(folder) => {
            output_folder(folder)?;
            remove_kernels(folder)?;
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
        timing(recorded, &plan.program)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The program of a training step, for a device or a kind of device.
struct Plan {
    program: Program,
    /// Bytes of a lane of each buffer, by id.
    of_lanes: Vec<u64>,
    measured: Option<Measured>,
    /// What kernels keep to; none on the CPU.
    #[cfg(feature = "gpu")]
    limits: Option<Limits>,
}

/// What the device of an experiment runs, and how fast unless something else is asked for.
fn on_device(experiment: &mut Experiment, emit: Option<Artefact>) -> anyhow::Result<(Plan, Step, Duration)> {
    let mut trainer = training(experiment)?;
    let device = trainer.learner().device().clone();
    let program = trainer.learner().program(trainer.training_program()).clone();
    let measured = match emit {
        Some(_) => None,
        None => {
            warm_up(&mut *trainer)?;
            let seconds = medians(&profile(&mut *trainer)?);
            let gflops = device.peak_matrix_gflops()?.map_or_else(|| device.peak_gflops(), Ok)?;
            Some(Measured { seconds, gflops, gbytes: device.peak_gbytes()? })
        }
    };
    let of_lanes = device.lane_bytes(&program);
    let (step, recorded) = record(experiment, program.target.kind)?;
    #[cfg(feature = "gpu")]
    let limits = device.limits(&program.target);
    let plan = Plan {
        program,
        of_lanes,
        measured,
        #[cfg(feature = "gpu")]
        limits,
    };
    Ok((plan, step, recorded))
}

/// What a device of some kind would run, none being asked.
#[cfg(feature = "gpu")]
fn untested(experiment: &Experiment, args: &ExplainArgs) -> anyhow::Result<(Plan, Step, Duration)> {
    let gpu = args.target == TargetChoice::Gpu || matches!(args.emit, Some(Artefact::Wgsl | Artefact::Spirv));
    let run = &experiment.layered.settings.run;
    // A large GPU multiplies matrices of 16 x 16 halves.
    let half = (run.precision == Precision::Mixed).then(|| Half { matrices: Matrices::new(16, 32) });
    let forms = Forms { half, ..Forms::default() };
    let target = if gpu { forms.target() } else { Target::cpu() };
    let (step, recorded) = record(experiment, target.kind)?;
    let of_lanes = |program: &Program| if gpu { forms.lane_bytes(program) } else { vec![4; program.buffers.len()] };
    let seconds = |program: &Program| {
        let of_lanes = of_lanes(program);
        program.predicted(|b| of_lanes[b.0 as usize])
    };
    let program = compiled(&step, &target, run.networks, |both| Ok(untried(both, seconds)))?;
    // What a given device cannot bind is refused when the program is loaded onto it.
    let limits = gpu.then(|| forms.limits(&target, Limits { max_binding: u64::MAX, ..Limits::default() }));
    Ok((Plan { of_lanes: of_lanes(&program), program, measured: None, limits }, step, recorded))
}

/// What a CPU would run: this build has no kernels for GPUs.
#[cfg(not(feature = "gpu"))]
fn untested(experiment: &Experiment, args: &ExplainArgs) -> anyhow::Result<(Plan, Step, Duration)> {
    let target = if args.target == TargetChoice::Gpu { Target::gpu() } else { Target::cpu() };
    let (step, recorded) = record(experiment, target.kind)?;
    let networks = experiment.layered.settings.run.networks;
    let program = compiled(&step, &target, networks, |both| Ok(untried(both, |p| p.predicted(|_| 4))))?;
    Ok((Plan { of_lanes: vec![4; program.buffers.len()], program, measured: None }, step, recorded))
}

/// The training step, and how long it took to record and differentiate it.
fn record(experiment: &Experiment, target: TargetKind) -> Result<(Step, Duration), raygrad::Error> {
    let settings = &experiment.layered.settings;
    if settings.scene.is_some() {
        let data = SpaceData::outline(&experiment.layered)?;
        let settings = &data.with_depths(settings);
        let views = data.scene.train.len();
        let begun = Instant::now();
        let warp = experiment.layered.built_in_warp(views).map_err(raygrad::Error::from)?;
        let model = RadianceModel::new(settings, data.size, views, warp).map_err(SpaceDataError::from)?;
        return Ok((model.for_target(target).train_step(), begun.elapsed()));
    }
    let data = PlanarData::load(&experiment.layered)?;
    let begun = Instant::now();
    let warp = experiment.layered.built_in_warp(settings.data.patches).map_err(raygrad::Error::from)?;
    Ok((PlanarModel::new(settings, data.grid, warp).for_target(target).train_step(), begun.elapsed()))
}

/// A file a kernel, numbered in the order in which they run.
#[cfg(feature = "gpu")]
fn kernels(experiment: &Experiment, plan: &Plan, artefact: Artefact) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    let Some(limits) = &plan.limits else {
        let problem = "expected a GPU, which alone runs kernels that could be shown, found the CPU";
        return Err(raygrad::Error::from(experiment.layered.refuse("--device", problem)).into());
    };
    let lowered = lower(&plan.program, &mut Inputs::default(), limits)?;
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
fn kernels(_: &Experiment, _: &Plan, _: Artefact) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    anyhow::bail!("this build has no GPU kernels (feature `wgpu` or `vulkan`)")
}

/// Removes the kernels that an earlier call left in a folder: they are of another program.
fn remove_kernels(folder: &Path) -> Result<(), raygrad::Error> {
    let failed = |source| WriteError { path: folder.to_path_buf(), source };
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let kernel = name.ends_with(".wgsl") || name.ends_with(".spv");
        let number = name.split('_').next().unwrap_or_default();
        if kernel && number.len() == 3 && number.bytes().all(|b| b.is_ascii_digit()) {
            std::fs::remove_file(&path).map_err(|source| WriteError { path, source })?;
        }
    }
    Ok(())
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
