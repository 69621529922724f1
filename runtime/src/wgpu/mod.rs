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

    fn profile(&mut self, program: &Loaded) -> Result<Option<Vec<f64>>, RunError> {
        if !self.gpu.has_clock() {
            return Ok(None);
        }
        let launches = program.launches();
        let count = 2 * launches as u32;
        if count > api::QUERY_SET_MAX_QUERIES {
            return Ok(None);
        }
        let queries = self.gpu.device.create_query_set(&api::QuerySetDescriptor {
            label: Some("clock"),
            ty: api::QueryType::Timestamp,
            count: count.max(1),
        });
        let ticks = self.gpu.device.create_buffer(&api::BufferDescriptor {
            label: Some("clock"),
            size: 8 * u64::from(count.max(1)),
            usage: api::BufferUsages::QUERY_RESOLVE | api::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        program.submit_timed(&self.gpu, &queries, &ticks);
        let halves = self.staging.read(&self.gpu, &ticks, 0, 4 * launches)?;
        let tick = |i: usize| u64::from(halves[2 * i]) | u64::from(halves[2 * i + 1]) << 32;
        let second = 1e-9 * f64::from(self.gpu.queue.get_timestamp_period());
        Ok(Some((0..launches).map(|i| tick(2 * i + 1).wrapping_sub(tick(2 * i)) as f64 * second).collect()))
    }

    fn read(&mut self, buffer: &api::Buffer, first: usize, lanes: usize) -> Result<Vec<u32>, RunError> {
        self.staging.read(&self.gpu, buffer, first, lanes)
    }
}
