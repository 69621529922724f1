//! The Vulkan backend: programs on a Vulkan driver through ash, with a device of raygrad's own.
//!
//! A program's dispatches are recorded into one command buffer when it is loaded and submitted again at every step,
//! together with what the host wrote since the last one. Kernels run without robust buffer access: the lowering derives
//! every index from the kernel's own dispatch and the arenas it binds, and clamps those of gathers.

mod adapter;
mod instance;
mod memory;
mod program;
mod queue;

pub use adapter::Gpu;

use crate::RunError;
use crate::gpu::Api;
use memory::Buffer;
use program::{Loaded, Timed};
use queue::Queue;
use raygrad_kernels::gpu::{Arena, GpuLaunch, Limits};
use std::sync::Arc;

/// A session's view of a device.
pub(crate) struct VulkanApi {
    gpu: Arc<Gpu>,
    queue: Queue,
}

impl VulkanApi {
    pub fn new(gpu: Arc<Gpu>) -> Result<VulkanApi, RunError> {
        Ok(VulkanApi { queue: Queue::new(gpu.clone())?, gpu })
    }
}

impl Api for VulkanApi {
    type Buffer = Buffer;
    type Loaded = Loaded;

    fn name(&self) -> String {
        self.gpu.adapter().name.clone()
    }

    fn limits(&self) -> Limits {
        self.gpu.limits()
    }

    fn buffer(&mut self, arena: &Arena) -> Result<Buffer, RunError> {
        let buffer = Buffer::on_device(&self.gpu, &arena.name, arena.bytes())?;
        self.queue.zero(&buffer)?;
        Ok(buffer)
    }

    fn load(&mut self, launches: Vec<GpuLaunch>, inputs: &[Buffer], own: &[Buffer]) -> Result<Loaded, RunError> {
        Loaded::new(&self.gpu, launches, inputs, own)
    }

    fn write(&mut self, buffer: &Buffer, first: usize, lanes: &[u32]) -> Result<(), RunError> {
        self.queue.write(buffer, 4 * first as u64, bytemuck::cast_slice(lanes))
    }

    fn submit(&mut self, program: &Loaded) -> Result<(), RunError> {
        self.queue.submit(Some(program.commands))
    }

    fn profile(&mut self, program: &Loaded) -> Result<Option<Vec<f64>>, RunError> {
        let Some(clock) = self.gpu.clock() else { return Ok(None) };
        let timed = Timed::new(program, clock)?;
        self.queue.submit_and_wait(Some(timed.commands))?;
        timed.seconds().map(Some)
    }

    fn read(&mut self, buffer: &Buffer, first: usize, lanes: usize) -> Result<Vec<u32>, RunError> {
        self.queue.read(buffer, 4 * first as u64, lanes)
    }
}
