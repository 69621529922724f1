//! The wgpu backend: programs on any Vulkan, Metal or DX12 adapter.
//!
//! Everything is made when a program is loaded: arenas, pipelines, bind groups, the staging buffer. A step only encodes
//! dispatches and submits them; nothing is allocated and nobody waits, except to keep the queue short.

mod gpu;
mod program;
mod transfer;

pub use gpu::{Adapter, Gpu};

use crate::RunError;
use crate::session::Executor;
use ::wgpu as api;
use program::Loaded;
use raygrad_compiler::Program;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::plan::region::BufferId;
use raygrad_kernels::gpu::{Arena, ArenaId, Inputs, LowerError, Place, lower};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use transfer::Staging;

/// Steps that may be queued before the host waits for the oldest.
const QUEUED: usize = 4;

/// Per-step inputs as the host last set them; written to the device together when a step starts.
struct Mirror {
    lanes: Vec<u32>,
    changed: bool,
}

pub(crate) struct WgpuExecutor {
    gpu: Arc<Gpu>,
    inputs: Inputs,
    /// Device buffers of the input arenas.
    arenas: Vec<api::Buffer>,
    /// Host copies of the arenas that hold per-step inputs.
    mirrors: BTreeMap<usize, Mirror>,
    programs: Vec<Loaded>,
    staging: Staging,
    queued: VecDeque<api::SubmissionIndex>,
}

impl WgpuExecutor {
    pub fn new(gpu: Arc<Gpu>) -> WgpuExecutor {
        WgpuExecutor {
            gpu,
            inputs: Inputs::default(),
            arenas: vec![],
            mirrors: BTreeMap::new(),
            programs: vec![],
            staging: Staging::default(),
            queued: VecDeque::new(),
        }
    }

    fn lower_error(&self, e: LowerError) -> RunError {
        match e {
            LowerError::TooLarge { buffer, bytes, limit } => {
                RunError::TooLarge { device: self.gpu.name(), buffer, bytes, limit }
            }
            other => self.gpu.problem(other.to_string()),
        }
    }

    /// Where an input lies, with its length in lanes.
    fn input(&self, name: &str) -> Result<(usize, Place, usize), RunError> {
        let (place, shape) = self.inputs.places.get(name).ok_or_else(|| RunError::UnknownInput(name.into()))?;
        match place.arena {
            ArenaId::Input(arena) => Ok((arena, *place, shape.lanes())),
            ArenaId::Own(_) => Err(RunError::UnknownInput(name.into())),
        }
    }

    /// Writes what the host changed of the per-step inputs.
    fn flush(&mut self) {
        for (arena, mirror) in &mut self.mirrors {
            if std::mem::take(&mut mirror.changed) {
                self.gpu.queue.write_buffer(&self.arenas[*arena], 0, bytemuck::cast_slice(&mirror.lanes));
            }
        }
    }

    fn read(&mut self, arena: ArenaId, program: usize, offset: u32, lanes: usize) -> Result<Vec<u32>, RunError> {
        self.flush();
        let buffer = match arena {
            ArenaId::Input(i) => &self.arenas[i],
            ArenaId::Own(i) => &self.programs[program].arenas[i],
        };
        self.staging.read(&self.gpu, buffer, offset, lanes)
    }
}

impl Executor for WgpuExecutor {
    fn add(&mut self, program: Arc<Program>) -> Result<usize, RunError> {
        if program.target.kind != raygrad_compiler::fuse::TargetKind::Gpu {
            return Err(RunError::Target(program.target.kind));
        }
        let lowered = lower(&program, &mut self.inputs, &self.gpu.limits()).map_err(|e| self.lower_error(e))?;
        for arena in &self.inputs.arenas[self.arenas.len()..] {
            self.arenas.push(self.gpu.buffer(arena)?);
        }
        for (name, role, _) in program.inputs() {
            if role == Role::PerStep {
                let (arena, _, _) = self.input(name)?;
                let lanes = self.inputs.arenas[arena].lanes as usize;
                self.mirrors.entry(arena).or_insert_with(|| Mirror { lanes: vec![0; lanes], changed: false });
            }
        }
        self.programs.push(Loaded::new(&self.gpu, lowered, &self.arenas)?);
        Ok(self.programs.len() - 1)
    }

    fn set(&mut self, input: &str, first: usize, lanes: &[u32]) -> Result<(), RunError> {
        let (arena, place, _) = self.input(input)?;
        let first = place.offset as usize + first;
        match self.mirrors.get_mut(&arena) {
            Some(mirror) => {
                mirror.lanes[first..first + lanes.len()].copy_from_slice(lanes);
                mirror.changed = true;
            }
            None => {
                let bytes = bytemuck::cast_slice(lanes);
                self.gpu.queue.write_buffer(&self.arenas[arena], 4 * first as u64, bytes);
            }
        }
        self.gpu.check()
    }

    fn get(&mut self, input: &str) -> Result<Vec<u32>, RunError> {
        let (arena, place, lanes) = self.input(input)?;
        self.read(ArenaId::Input(arena), 0, place.offset, lanes)
    }

    fn run(&mut self, program: usize) -> Result<(), RunError> {
        self.flush();
        if self.queued.len() >= QUEUED
            && let Some(oldest) = self.queued.pop_front()
        {
            self.gpu.wait(Some(oldest))?;
        }
        let submission = self.programs[program].submit(&self.gpu);
        self.queued.push_back(submission);
        self.gpu.check()
    }

    fn output(&mut self, program: usize, buffer: BufferId) -> Result<Vec<u32>, RunError> {
        let (place, lanes) = self.programs[program].place(buffer);
        self.read(place.arena, program, place.offset, lanes)
    }
}

/// Size of an arena's device buffer in bytes.
fn bytes(arena: &Arena) -> u64 {
    4 * arena.lanes.max(1)
}
