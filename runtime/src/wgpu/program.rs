//! A program on the device: pipelines and bind groups, made once.

use super::adapter::Gpu;
use super::api;
use crate::RunError;
use crate::gpu::bound;
use raygrad_kernels::gpu::{GpuLaunch, Kernel};
use std::borrow::Cow;
use std::ops::Range;

struct Dispatch {
    pipeline: api::ComputePipeline,
    bindings: api::BindGroup,
    workgroups: [u32; 3],
}

pub(crate) struct Loaded {
    dispatches: Vec<Dispatch>,
    /// Those of every launch.
    launches: Vec<Range<usize>>,
}

impl Loaded {
    pub fn new(
        gpu: &Gpu,
        launches: Vec<GpuLaunch>,
        inputs: &[api::Buffer],
        own: &[api::Buffer],
    ) -> Result<Loaded, RunError> {
        let mut loaded = Loaded { dispatches: vec![], launches: vec![] };
        for launch in launches {
            let first = loaded.dispatches.len();
            for kernel in launch.kernels {
                loaded.dispatches.push(Dispatch::new(gpu, kernel, inputs, own)?);
            }
            loaded.launches.push(first..loaded.dispatches.len());
        }
        Ok(loaded)
    }

    pub fn launches(&self) -> usize {
        self.launches.len()
    }

    /// Records and submits all dispatches.
    pub fn submit(&self, gpu: &Gpu) -> api::SubmissionIndex {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.dispatches.iter().for_each(|d| d.record(&mut pass));
        }
        gpu.queue.submit([encoder.finish()])
    }

    /// The same, a pass a launch; the clock is read at the begin and the end of each, two queries a launch.
    pub fn submit_timed(&self, gpu: &Gpu, queries: &api::QuerySet, into: &api::Buffer) {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for (i, launch) in self.launches.iter().enumerate() {
            let timestamp_writes = Some(api::ComputePassTimestampWrites {
                query_set: queries,
                beginning_of_pass_write_index: Some(2 * i as u32),
                end_of_pass_write_index: Some(2 * i as u32 + 1),
            });
            let mut pass = encoder.begin_compute_pass(&api::ComputePassDescriptor { label: None, timestamp_writes });
            self.dispatches[launch.clone()].iter().for_each(|d| d.record(&mut pass));
        }
        encoder.resolve_query_set(queries, 0..2 * self.launches.len() as u32, into, 0);
        gpu.queue.submit([encoder.finish()]);
    }
}

impl Dispatch {
    fn record(&self, pass: &mut api::ComputePass) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.bindings, &[]);
        let [x, y, z] = self.workgroups;
        pass.dispatch_workgroups(x, y, z);
    }

    fn new(gpu: &Gpu, kernel: Kernel, inputs: &[api::Buffer], own: &[api::Buffer]) -> Result<Dispatch, RunError> {
        let name = kernel.name;
        let label = Some(&*name);
        let entries: Vec<api::BindGroupLayoutEntry> = kernel
            .bindings
            .iter()
            .enumerate()
            .map(|(i, b)| api::BindGroupLayoutEntry {
                binding: i as u32,
                visibility: api::ShaderStages::COMPUTE,
                ty: api::BindingType::Buffer {
                    ty: api::BufferBindingType::Storage { read_only: !b.writable },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout = gpu.device.create_bind_group_layout(&api::BindGroupLayoutDescriptor { label, entries: &entries });
        let entries: Vec<api::BindGroupEntry> = kernel
            .bindings
            .iter()
            .enumerate()
            .map(|(i, b)| {
                let resource = bound(b.arena, inputs, own).as_entire_binding();
                api::BindGroupEntry { binding: i as u32, resource }
            })
            .collect();
        let bindings =
            gpu.device.create_bind_group(&api::BindGroupDescriptor { label, layout: &layout, entries: &entries });
        let source = api::ShaderSource::Naga(Cow::Owned(kernel.module));
        // SAFETY: the lowering derives every index from the kernel's own dispatch size and the layout it binds, clamps
        // the indices of gathers, and bounds every loop by a constant, so no access is out of range and every loop ends.
        let module = unsafe {
            gpu.device.create_shader_module_trusted(
                api::ShaderModuleDescriptor { label, source },
                api::ShaderRuntimeChecks::unchecked(),
            )
        };
        let layout = gpu.device.create_pipeline_layout(&api::PipelineLayoutDescriptor {
            label,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = gpu.device.create_compute_pipeline(&api::ComputePipelineDescriptor {
            label,
            layout: Some(&layout),
            module: &module,
            entry_point: Some("main"),
            compilation_options: api::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: gpu.cache(),
        });
        gpu.check().map_err(|e| match e {
            RunError::Device { device, problem } => {
                RunError::Device { device, problem: format!("kernel `{name}`: {problem}") }
            }
            other => other,
        })?;
        Ok(Dispatch { pipeline, bindings, workgroups: kernel.workgroups })
    }
}
