//! Sessions: programs that share inputs by name, on one device.

use crate::cpu::CpuExecutor;
#[cfg(feature = "gpu")]
use crate::gpu::GpuExecutor;
use crate::{Device, RunError};
use raygrad_compiler::Program;
use raygrad_compiler::graph::Shape;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::plan::region::BufferId;
use raygrad_compiler::scalar::DType;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// What a backend does. Lanes are in buffer order: channel by channel, each over all elements.
pub(crate) trait Executor: Send {
    /// Loads a program; inputs it shares by name with earlier ones share their buffers. New inputs are zero.
    fn add(&mut self, program: Arc<Program>) -> Result<usize, RunError>;
    /// Sets the lanes of an input from lane `first` on.
    fn set(&mut self, input: &str, first: usize, lanes: &[u32]) -> Result<(), RunError>;
    fn get(&mut self, input: &str) -> Result<Vec<u32>, RunError>;
    /// Runs a program once; need not wait for it.
    fn run(&mut self, program: usize) -> Result<(), RunError>;
    /// Runs a program once and waits: seconds of every launch, or `None` (and nothing ran) where the device has no clock.
    fn profile(&mut self, program: usize) -> Result<Option<Vec<f64>>, RunError>;
    /// An output of a program's last run.
    fn output(&mut self, program: usize, buffer: BufferId) -> Result<Vec<u32>, RunError>;
}

/// A program loaded into a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ProgramId {
    session: u64,
    number: usize,
}

/// An input of a session.
#[derive(Clone, Debug)]
pub struct InputInfo {
    pub role: Role,
    pub shape: Shape,
}

/// Programs on a device and the inputs they share.
pub struct Session {
    /// No other session of this process has it.
    id: u64,
    executor: Box<dyn Executor>,
    programs: Vec<Arc<Program>>,
    inputs: BTreeMap<String, InputInfo>,
}

impl Session {
    /// An empty session on `device`.
    pub fn new(device: Device) -> Result<Session, RunError> {
        let executor: Box<dyn Executor> = match device {
            Device::Cpu { pool, products } => Box::new(CpuExecutor::new(pool, products)),
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, forms } => Box::new(GpuExecutor::new(crate::wgpu::WgpuApi::new(gpu), forms)),
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, forms } => Box::new(GpuExecutor::new(crate::vulkan::VulkanApi::new(gpu)?, forms)),
        };
        static SESSIONS: AtomicU64 = AtomicU64::new(0);
        let id = SESSIONS.fetch_add(1, Ordering::Relaxed);
        Ok(Session { id, executor, programs: vec![], inputs: BTreeMap::new() })
    }

    /// Loads a program. All inputs it does not share with earlier programs start as zeros. If it fails, the session is as before.
    pub fn add(&mut self, program: Program) -> Result<ProgramId, RunError> {
        let mut inputs = self.inputs.clone();
        for (name, role, shape) in program.inputs() {
            match inputs.get(name) {
                Some(known) if !same_layout(&known.shape, shape) => {
                    let (first, second) = (known.shape.clone(), shape.clone());
                    return Err(RunError::Conflict { name: name.into(), first, second });
                }
                Some(known) if (known.role == Role::PerStep) != (role == Role::PerStep) => {
                    return Err(RunError::Roles { name: name.into(), first: known.role, second: role });
                }
                _ => inputs.insert(name.into(), InputInfo { role, shape: shape.clone() }),
            };
        }
        let program = Arc::new(program);
        let number = self.executor.add(program.clone())?;
        self.inputs = inputs;
        self.programs.push(program);
        Ok(ProgramId { session: self.id, number })
    }

    /// Inputs by name.
    pub fn inputs(&self) -> impl Iterator<Item = (&str, &InputInfo)> {
        self.inputs.iter().map(|(name, info)| (name.as_str(), info))
    }

    /// Sets a float input. Values are in the order of the axes, each element with its channels side by side.
    pub fn set(&mut self, name: &str, values: &[f32]) -> Result<(), RunError> {
        self.set_lanes(name, bytemuck::cast_slice(values), DType::F32)
    }

    /// Sets an integer input, ordered as in [`Session::set`].
    pub fn set_u32(&mut self, name: &str, values: &[u32]) -> Result<(), RunError> {
        self.set_lanes(name, values, DType::U32)
    }

    fn set_lanes(&mut self, name: &str, values: &[u32], dtype: DType) -> Result<(), RunError> {
        let info = self.inputs.get(name).ok_or_else(|| RunError::UnknownInput(name.into()))?;
        let shape = &info.shape;
        if shape.dtype != dtype {
            let found = if dtype == DType::F32 { "f32" } else { "u32" };
            return Err(RunError::Type { name: name.into(), shape: shape.clone(), found });
        }
        if values.len() != shape.lanes() {
            let (expected, found) = (shape.lanes(), values.len());
            return Err(RunError::Length { name: name.into(), shape: shape.clone(), expected, found });
        }
        self.executor.set(name, 0, &to_channel_major(values, shape))
    }

    /// Sets some elements of an integer input of one channel, from element `first` on.
    pub fn set_u32_from(&mut self, name: &str, first: usize, values: &[u32]) -> Result<(), RunError> {
        let info = self.inputs.get(name).ok_or_else(|| RunError::UnknownInput(name.into()))?;
        let shape = &info.shape;
        let lanes = shape.lanes();
        if shape.dtype != DType::U32 || shape.channels.count() != 1 {
            return Err(RunError::Type { name: name.into(), shape: shape.clone(), found: "u32, one channel" });
        }
        if first.checked_add(values.len()).is_none_or(|end| end > lanes) {
            let (expected, found) = (lanes.saturating_sub(first), values.len());
            return Err(RunError::Length { name: name.into(), shape: shape.clone(), expected, found });
        }
        self.executor.set(name, first, values)
    }

    /// The current value of a float input, in host order; waits for the device.
    pub fn get(&mut self, name: &str) -> Result<Vec<f32>, RunError> {
        let (shape, lanes) = self.input(name)?;
        floats(name, shape, lanes)
    }

    /// The current lanes of any input, in host order; waits for the device.
    pub fn get_lanes(&mut self, name: &str) -> Result<Vec<u32>, RunError> {
        Ok(self.input(name)?.1)
    }

    fn input(&mut self, name: &str) -> Result<(&Shape, Vec<u32>), RunError> {
        let info = self.inputs.get(name).ok_or_else(|| RunError::UnknownInput(name.into()))?;
        let lanes = self.executor.get(name)?;
        Ok((&info.shape, to_host(lanes, &info.shape)))
    }

    /// Runs a program once. On a GPU this only submits.
    pub fn run(&mut self, program: ProgramId) -> Result<(), RunError> {
        let number = self.own(program)?;
        self.executor.run(number)
    }

    /// Runs a program once, by the device's clock: seconds of each of its launches. `None` where the device has no clock;
    /// then nothing ran. Waits for the device.
    pub fn profile(&mut self, program: ProgramId) -> Result<Option<Vec<f64>>, RunError> {
        let number = self.own(program)?;
        self.executor.profile(number)
    }

    /// A float output of the program's last run, in host order; waits for the device.
    pub fn read(&mut self, program: ProgramId, output: &str) -> Result<Vec<f32>, RunError> {
        let (shape, lanes) = self.output(program, output)?;
        floats(output, shape, lanes)
    }

    /// The lanes of any output, in host order; waits for the device.
    pub fn read_lanes(&mut self, program: ProgramId, output: &str) -> Result<Vec<u32>, RunError> {
        Ok(self.output(program, output)?.1)
    }

    fn output(&mut self, program: ProgramId, output: &str) -> Result<(&Shape, Vec<u32>), RunError> {
        let number = self.own(program)?;
        let plan = &self.programs[number];
        let found = plan.outputs.iter().find(|(name, _)| name == output);
        let (_, buffer) = found.ok_or_else(|| RunError::UnknownOutput(output.into()))?;
        let shape = &plan.buffer(*buffer).shape;
        let lanes = self.executor.output(number, *buffer)?;
        Ok((shape, to_host(lanes, shape)))
    }

    /// A loaded program.
    ///
    /// # Panics
    /// Maybe, if it belongs to another session.
    pub fn program(&self, id: ProgramId) -> &Program {
        &self.programs[id.number]
    }

    /// The number of a program, if it is this session's.
    fn own(&self, program: ProgramId) -> Result<usize, RunError> {
        if program.session == self.id { Ok(program.number) } else { Err(RunError::OtherSession) }
    }
}

/// Lanes of floats; those of whole numbers are none.
fn floats(name: &str, shape: &Shape, lanes: Vec<u32>) -> Result<Vec<f32>, RunError> {
    match shape.dtype {
        DType::F32 => Ok(bytemuck::allocation::cast_vec(lanes)),
        DType::U32 => Err(RunError::Lanes { name: name.into(), shape: shape.clone() }),
    }
}

/// Programs may be recorded with axes of their own: names and sizes must agree.
fn same_layout(a: &Shape, b: &Shape) -> bool {
    let axes = |s: &Shape| s.axes.iter().map(|x| (x.name().to_string(), x.size())).collect::<Vec<_>>();
    axes(a) == axes(b) && a.channels == b.channels && a.dtype == b.dtype
}

fn to_channel_major<'a>(values: &'a [u32], shape: &Shape) -> Cow<'a, [u32]> {
    transpose(values, shape.axes.elements(), shape.channels.count())
}

fn to_host(lanes: Vec<u32>, shape: &Shape) -> Vec<u32> {
    match transpose(&lanes, shape.channels.count(), shape.axes.elements()) {
        Cow::Borrowed(_) => lanes,
        Cow::Owned(turned) => turned,
    }
}

fn transpose(values: &[u32], rows: usize, columns: usize) -> Cow<'_, [u32]> {
    if rows == 1 || columns == 1 {
        return Cow::Borrowed(values);
    }
    let mut out = Vec::with_capacity(values.len());
    for c in 0..columns {
        out.extend((0..rows).map(|r| values[r * columns + c]));
    }
    Cow::Owned(out)
}
