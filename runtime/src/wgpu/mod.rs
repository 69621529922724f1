//! The wgpu backend: programs on any Vulkan, Metal or DX12 adapter.

mod adapter;
mod program;
mod transfer;

pub use adapter::Gpu;

use crate::RunError;
use crate::gpu::{Api, QUEUED};
use ::wgpu as api;
use program::Loaded;
use raygrad_kernels::gpu::{Arena, GpuLaunch, Limits};
use std::collections::VecDeque;
use std::sync::Arc;
use transfer::Staging;

/// A session's view of a device.
pub(crate) struct WgpuApi {
    gpu: Arc<Gpu>,
    staging: Staging,
    queued: VecDeque<api::SubmissionIndex>,
}

impl WgpuApi {
    pub fn new(gpu: Arc<Gpu>) -> WgpuApi {
        WgpuApi { gpu, staging: Staging::default(), queued: VecDeque::new() }
    }
}

impl Api for WgpuApi {
    type Buffer = api::Buffer;
    type Loaded = Loaded;

    fn name(&self) -> String {
        self.gpu.adapter().name.clone()
    }

    fn limits(&self) -> Limits {
        self.gpu.limits()
    }

    fn buffer(&mut self, arena: &Arena) -> Result<api::Buffer, RunError> {
        self.gpu.buffer(arena)
    }

    fn load(
        &mut self,
        launches: Vec<GpuLaunch>,
        inputs: &[api::Buffer],
        own: &[api::Buffer],
    ) -> Result<Loaded, RunError> {
        Loaded::new(&self.gpu, launches, inputs, own)
    }

    fn write(&mut self, buffer: &api::Buffer, first: usize, lanes: &[u32]) -> Result<(), RunError> {
        self.gpu.queue.write_buffer(buffer, 4 * first as u64, bytemuck::cast_slice(lanes));
        self.gpu.check()
    }

    fn submit(&mut self, program: &Loaded) -> Result<(), RunError> {
        if self.queued.len() >= QUEUED
            && let Some(oldest) = self.queued.pop_front()
        {
            self.gpu.wait(Some(oldest))?;
        }
        self.queued.push_back(program.submit(&self.gpu));
        self.gpu.check()
    }

    fn read(&mut self, buffer: &api::Buffer, first: usize, lanes: usize) -> Result<Vec<u32>, RunError> {
        self.staging.read(&self.gpu, buffer, first, lanes)
    }
}
