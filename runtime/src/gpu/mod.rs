//! What the backends for GPUs share: where inputs lie, per-step inputs that the host collects, and reading back.
//!
//! Everything is made when a program is loaded: arenas, pipelines, bindings. A step only submits.

pub(crate) mod cache;
pub(crate) mod half;
pub(crate) mod rates;
pub(crate) mod tune;

use crate::device::Forms;
use crate::session::Executor;
use crate::{DeviceError, RunError};
use raygrad_compiler::Program;
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::plan::region::BufferId;
use raygrad_kernels::gpu::{
    Arena, ArenaId, GpuLaunch, GpuProgram, Half, Inputs, Limits, LowerError, Part, Place, lower,
};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::sync::Arc;

/// Steps that may be queued before the host waits for the oldest.
pub(crate) const QUEUED: usize = 4;

/// Most lanes that are read at a time, through memory that a session keeps: 32 MiB.
const READ: usize = 8 << 20;

/// What an API for GPUs does. Writes, submissions and reads take effect in the order of the calls.
pub(crate) trait Api: Send {
    /// Device memory of an arena.
    type Buffer: Send;
    /// Pipelines and bindings of a program.
    type Loaded: Send;

    /// The adapter's name.
    fn name(&self) -> String;
    fn limits(&self) -> Limits;
    /// A zeroed buffer.
    fn buffer(&mut self, arena: &Arena) -> Result<Self::Buffer, RunError>;
    /// Loads the kernels of a program, given the buffers of the inputs' arenas and of its own.
    fn load(
        &mut self,
        launches: Vec<GpuLaunch>,
        inputs: &[Self::Buffer],
        own: &[Self::Buffer],
    ) -> Result<Self::Loaded, RunError>;
    /// Sets the lanes of a buffer from lane `first` on.
    fn write(&mut self, buffer: &Self::Buffer, first: usize, lanes: &[u32]) -> Result<(), RunError>;
    /// Submits all dispatches of a program. Waits only if [`QUEUED`] steps are under way.
    fn submit(&mut self, program: &Self::Loaded) -> Result<(), RunError>;
    /// Runs a program and waits: seconds of every launch by the device's clock; `None` where it has none, and nothing ran.
    fn profile(&mut self, program: &Self::Loaded) -> Result<Option<Vec<f64>>, RunError>;
    /// Waits for all work, and reads.
    fn read(&mut self, buffer: &Self::Buffer, first: usize, lanes: usize) -> Result<Vec<u32>, RunError>;
}

/// An error of a device, for people.
pub(crate) fn device_error(name: &str, problem: impl Into<String>) -> RunError {
    RunError::Device { device: name.into(), problem: problem.into() }
}

/// What an adapter is; the best kind first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    Dedicated,
    Integrated,
    Virtual,
    Unknown,
    /// A driver that computes on the CPU.
    Software,
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            AdapterKind::Dedicated => "dedicated GPU",
            AdapterKind::Integrated => "integrated GPU",
            AdapterKind::Virtual => "virtual GPU",
            AdapterKind::Unknown => "unknown",
            AdapterKind::Software => "software",
        })
    }
}

/// An adapter as listed for people.
#[derive(Clone, Debug)]
pub struct Adapter {
    pub name: String,
    /// The API that drives it.
    pub api: &'static str,
    pub kind: AdapterKind,
    pub driver: String,
    /// What it has for half precision, if it stores halves.
    pub half: Option<Half>,
}

impl AdapterKind {
    /// Whether it computes on a GPU, as far as it says.
    pub fn is_gpu(self) -> bool {
        self <= AdapterKind::Virtual
    }
}

/// The adapter that `index` counts, or the first of the best kind.
pub(crate) fn choose<T>(all: Vec<T>, index: Option<usize>, kind: impl Fn(&T) -> AdapterKind) -> Result<T, DeviceError> {
    match index {
        Some(i) => all.into_iter().nth(i).ok_or_else(|| DeviceError::NoAdapter(format!("number {i}"))),
        None => all.into_iter().min_by_key(kind).ok_or_else(|| DeviceError::NoAdapter("found".into())),
    }
}

/// Per-step inputs as the host last set them; written to the device together when a step starts.
struct Mirror {
    lanes: Vec<u32>,
    changed: bool,
}

/// A program whose kernels are on the device.
struct OnDevice<A: Api> {
    loaded: A::Loaded,
    arenas: Vec<A::Buffer>,
    places: Vec<(Place, usize)>,
}

/// Programs on a GPU.
pub(crate) struct GpuExecutor<A: Api> {
    // First, so that a dropped session waits for its work before the buffers go.
    api: A,
    forms: Forms,
    inputs: Inputs,
    /// Device buffers of the input arenas.
    arenas: Vec<A::Buffer>,
    /// Host copies of the arenas that hold per-step inputs.
    mirrors: BTreeMap<usize, Mirror>,
    programs: Vec<OnDevice<A>>,
}

impl<A: Api> GpuExecutor<A> {
    pub fn new(api: A, forms: Forms) -> GpuExecutor<A> {
        GpuExecutor {
            api,
            forms,
            inputs: Inputs::default(),
            arenas: vec![],
            mirrors: BTreeMap::new(),
            programs: vec![],
        }
    }

    fn lower_error(&self, e: LowerError) -> RunError {
        match e {
            LowerError::TooLarge { buffer, bytes, limit } => {
                RunError::TooLarge { device: self.api.name(), buffer, bytes, limit }
            }
            other => device_error(&self.api.name(), other.to_string()),
        }
    }

    /// Where an input lies, with its length in lanes.
    fn input(&self, name: &str) -> Result<(&Place, usize), RunError> {
        let found = self.inputs.places.get(name).ok_or_else(|| RunError::UnknownInput(name.into()))?;
        Ok((&found.0, found.1.lanes()))
    }

    /// Puts a program on the device, with the arenas of inputs that no earlier one has.
    fn load(&mut self, program: GpuProgram, inputs: &[Arena]) -> Result<OnDevice<A>, RunError> {
        for arena in inputs {
            self.arenas.push(self.api.buffer(arena)?);
        }
        let arenas = program.arenas.iter().map(|a| self.api.buffer(a)).collect::<Result<Vec<_>, _>>()?;
        let loaded = self.api.load(program.launches, &self.arenas, &arenas)?;
        Ok(OnDevice { loaded, arenas, places: program.places })
    }

    /// Writes what the host changed of the per-step inputs.
    fn flush(&mut self) -> Result<(), RunError> {
        for (arena, mirror) in &mut self.mirrors {
            if std::mem::take(&mut mirror.changed) {
                self.api.write(&self.arenas[*arena], 0, &mirror.lanes)?;
            }
        }
        Ok(())
    }
}

impl<A: Api> Executor for GpuExecutor<A> {
    fn add(&mut self, program: Arc<Program>) -> Result<usize, RunError> {
        if program.target.kind != TargetKind::Gpu {
            return Err(RunError::Target(program.target.kind));
        }
        let limits = self.forms.limits(&program.target, self.api.limits());
        let mut inputs = self.inputs.clone();
        let lowered = lower(&program, &mut inputs, &limits).map_err(|e| self.lower_error(e))?;
        let before = self.arenas.len();
        let loaded = self.load(lowered, &inputs.arenas[before..]);
        self.programs.push(loaded.inspect_err(|_| self.arenas.truncate(before))?);
        self.inputs = inputs;
        for (name, role, _) in program.inputs() {
            if role == Role::PerStep {
                let place = self.input(name)?.0.clone();
                for arena in place.parts.iter().filter_map(of_inputs) {
                    let lanes = self.inputs.arenas[arena].lanes as usize;
                    self.mirrors.entry(arena).or_insert_with(|| Mirror { lanes: vec![0; lanes], changed: false });
                }
            }
        }
        Ok(self.programs.len() - 1)
    }

    fn set(&mut self, input: &str, first: usize, lanes: &[u32]) -> Result<(), RunError> {
        let pieces = self.input(input)?.0.pieces(first..first + lanes.len());
        for (part, range) in pieces {
            let Some(arena) = of_inputs(&part) else { continue };
            let (at, lanes) = (part.offset as usize, &lanes[range]);
            match self.mirrors.get_mut(&arena) {
                Some(mirror) => {
                    mirror.lanes[at..at + lanes.len()].copy_from_slice(lanes);
                    mirror.changed = true;
                }
                None => self.api.write(&self.arenas[arena], at, lanes)?,
            }
        }
        Ok(())
    }

    fn get(&mut self, input: &str) -> Result<Vec<u32>, RunError> {
        self.flush()?;
        let (place, lanes) = self.input(input)?;
        let pieces = place.pieces(0..lanes);
        read(&mut self.api, &pieces, &self.arenas, &[])
    }

    fn run(&mut self, program: usize) -> Result<(), RunError> {
        self.flush()?;
        self.api.submit(&self.programs[program].loaded)
    }

    fn profile(&mut self, program: usize) -> Result<Option<Vec<f64>>, RunError> {
        self.flush()?;
        self.api.profile(&self.programs[program].loaded)
    }

    fn output(&mut self, program: usize, buffer: BufferId) -> Result<Vec<u32>, RunError> {
        self.flush()?;
        let program = &self.programs[program];
        let (place, lanes) = &program.places[buffer.0 as usize];
        read(&mut self.api, &place.pieces(0..*lanes), &self.arenas, &program.arenas)
    }
}

/// The arena of a part, if inputs lie there.
fn of_inputs(part: &Part) -> Option<usize> {
    match part.arena {
        ArenaId::Input(arena) => Some(arena),
        ArenaId::Own(_) | ArenaId::Workgroup => None,
    }
}

/// The lanes of pieces of a buffer.
fn read<A: Api>(
    api: &mut A,
    pieces: &[(Part, Range<usize>)],
    inputs: &[A::Buffer],
    own: &[A::Buffer],
) -> Result<Vec<u32>, RunError> {
    if let [(part, range)] = pieces
        && range.len() <= READ
    {
        return api.read(bound(part.arena, inputs, own), part.offset as usize, range.len());
    }
    let mut lanes = Vec::with_capacity(pieces.iter().map(|(_, range)| range.len()).sum());
    for (part, range) in pieces {
        for done in (0..range.len()).step_by(READ) {
            let count = READ.min(range.len() - done);
            lanes.extend(api.read(bound(part.arena, inputs, own), part.offset as usize + done, count)?);
        }
    }
    Ok(lanes)
}

/// What a test needs, unless `RAYGRAD_NO_GPU=1` says that there is none here.
#[cfg(test)]
pub(crate) fn expected<T>(opened: Result<T, DeviceError>) -> Option<T> {
    match opened {
        Ok(device) => Some(device),
        Err(e) if std::env::var_os("RAYGRAD_NO_GPU").is_some_and(|v| v == "1") => {
            println!("skipped, RAYGRAD_NO_GPU is set: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

/// The buffer of an arena.
pub(crate) fn bound<'a, B>(arena: ArenaId, inputs: &'a [B], own: &'a [B]) -> &'a B {
    match arena {
        ArenaId::Input(i) => &inputs[i],
        ArenaId::Own(i) => &own[i],
        ArenaId::Workgroup => unreachable!("workgroup memory is inside kernels, which bind none of it"),
    }
}
