//! A program on the device: pipelines, bindings, and all dispatches in one command buffer.

use super::adapter::{Clock, Gpu};
use super::memory::Buffer;
use super::queue::barrier;
use crate::RunError;
use crate::gpu::bound;
use ash::vk;
use raygrad_kernels::gpu::{GpuLaunch, Kernel, groups};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Bindings of kernels that bind the same number of buffers.
struct Layouts {
    set: vk::DescriptorSetLayout,
    pipeline: vk::PipelineLayout,
}

struct Dispatch {
    pipeline: vk::Pipeline,
    layout: vk::PipelineLayout,
    set: vk::DescriptorSet,
    workgroups: [u32; 3],
}

pub(crate) struct Loaded {
    /// Recorded once, submitted at every step.
    pub(super) commands: vk::CommandBuffer,
    layouts: BTreeMap<usize, Layouts>,
    dispatches: Vec<Dispatch>,
    /// Those of every launch.
    launches: Vec<Range<usize>>,
    /// The same dispatches in groups that do not wait for each other.
    groups: Vec<Vec<usize>>,
    descriptors: vk::DescriptorPool,
    pool: vk::CommandPool,
    gpu: Arc<Gpu>,
}

impl Loaded {
    pub fn new(
        gpu: &Arc<Gpu>,
        launches: Vec<GpuLaunch>,
        inputs: &[Buffer],
        own: &[Buffer],
    ) -> Result<Loaded, RunError> {
        // Null handles may be destroyed, so that what was made goes with `loaded` if something fails.
        let mut loaded = Loaded {
            commands: vk::CommandBuffer::null(),
            layouts: BTreeMap::new(),
            dispatches: vec![],
            launches: vec![],
            groups: vec![],
            descriptors: vk::DescriptorPool::null(),
            pool: vk::CommandPool::null(),
            gpu: gpu.clone(),
        };
        let mut kernels: Vec<Kernel> = vec![];
        for launch in launches {
            loaded.launches.push(kernels.len()..kernels.len() + launch.kernels.len());
            kernels.extend(launch.kernels);
        }
        for kernel in &kernels {
            loaded.layouts(kernel.bindings.len())?;
        }
        // Drivers compile here, each kernel by itself.
        let pipelines: Vec<_> = kernels.par_iter().map(|k| loaded.pipeline(k)).collect();
        let mut failed = None;
        for (kernel, pipeline) in kernels.iter().zip(pipelines) {
            match pipeline {
                Ok(pipeline) => loaded.dispatches.push(Dispatch {
                    pipeline,
                    layout: loaded.layouts[&kernel.bindings.len()].pipeline,
                    set: vk::DescriptorSet::null(),
                    workgroups: kernel.workgroups,
                }),
                Err(e) => failed = failed.or(Some(e)),
            }
        }
        if let Some(e) = failed {
            return Err(e);
        }
        loaded.groups = groups(&kernels);
        loaded.bind(&kernels, inputs, own)?;
        let description = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.family);
        // SAFETY: a handle of this device.
        loaded.pool = unsafe { gpu.device.create_command_pool(&description, None) }.map_err(|e| gpu.error(e))?;
        loaded.commands = loaded.record(None)?;
        gpu.check()?;
        Ok(loaded)
    }

    /// Makes the layouts for so many buffers.
    fn layouts(&mut self, buffers: usize) -> Result<(), RunError> {
        if self.layouts.contains_key(&buffers) {
            return Ok(());
        }
        let gpu = &self.gpu;
        let bindings: Vec<_> = (0..buffers as u32)
            .map(|i| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(i)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let description = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        // SAFETY: handles of this device.
        unsafe {
            let set = gpu.device.create_descriptor_set_layout(&description, None).map_err(|e| gpu.error(e))?;
            let sets = [set];
            let description = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            let pipeline = gpu.device.create_pipeline_layout(&description, None);
            let pipeline = pipeline.inspect_err(|_| gpu.device.destroy_descriptor_set_layout(set, None));
            self.layouts.insert(buffers, Layouts { set, pipeline: pipeline.map_err(|e| gpu.error(e))? });
        }
        Ok(())
    }

    fn pipeline(&self, kernel: &Kernel) -> Result<vk::Pipeline, RunError> {
        let gpu = &self.gpu;
        let failed = |problem: String| gpu.problem(format!("kernel `{}`: {problem}", kernel.name));
        let code = kernel.spirv().map_err(|e| gpu.problem(e.to_string()))?;
        // SAFETY: naga writes valid SPIR-V for a valid module; the layout has a binding for each of the kernel's.
        unsafe {
            let description = vk::ShaderModuleCreateInfo::default().code(&code);
            let module = gpu.device.create_shader_module(&description, None).map_err(|e| failed(e.to_string()))?;
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(c"main");
            let description = vk::ComputePipelineCreateInfo::default()
                .stage(stage)
                .layout(self.layouts[&kernel.bindings.len()].pipeline);
            let made = gpu.device.create_compute_pipelines(gpu.cache, &[description], None);
            gpu.device.destroy_shader_module(module, None);
            match made {
                Ok(pipelines) => Ok(pipelines[0]),
                Err((_, e)) => Err(failed(e.to_string())),
            }
        }
    }

    /// A descriptor set a kernel.
    fn bind(&mut self, kernels: &[Kernel], inputs: &[Buffer], own: &[Buffer]) -> Result<(), RunError> {
        if kernels.is_empty() {
            return Ok(());
        }
        let gpu = &self.gpu;
        let buffers: usize = kernels.iter().map(|k| k.bindings.len()).sum();
        let sizes = [vk::DescriptorPoolSize {
            ty: vk::DescriptorType::STORAGE_BUFFER,
            descriptor_count: buffers.max(1) as u32,
        }];
        let description = vk::DescriptorPoolCreateInfo::default().max_sets(kernels.len() as u32).pool_sizes(&sizes);
        let layouts: Vec<_> = kernels.iter().map(|k| self.layouts[&k.bindings.len()].set).collect();
        // SAFETY: handles of this device; the buffers live as long as the program.
        unsafe {
            self.descriptors = gpu.device.create_descriptor_pool(&description, None).map_err(|e| gpu.error(e))?;
            let description =
                vk::DescriptorSetAllocateInfo::default().descriptor_pool(self.descriptors).set_layouts(&layouts);
            let sets = gpu.device.allocate_descriptor_sets(&description).map_err(|e| gpu.error(e))?;
            for ((kernel, set), dispatch) in kernels.iter().zip(sets).zip(&mut self.dispatches) {
                dispatch.set = set;
                let buffers: Vec<_> = kernel
                    .bindings
                    .iter()
                    .map(|b| vk::DescriptorBufferInfo {
                        buffer: bound(b.arena, inputs, own).raw,
                        offset: 0,
                        range: vk::WHOLE_SIZE,
                    })
                    .collect();
                let write = vk::WriteDescriptorSet::default()
                    .dst_set(set)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .buffer_info(&buffers);
                gpu.device.update_descriptor_sets(&[write], &[]);
            }
            Ok(())
        }
    }

    /// A new command buffer with all dispatches. If the clock is read, at the start and after every launch, each waits for the
    /// one before it; else those of a group are free to run together.
    fn record(&self, clock: Option<vk::QueryPool>) -> Result<vk::CommandBuffer, RunError> {
        let gpu = &self.gpu;
        // SAFETY: handles of this device; the queries are as many as launches and one more.
        unsafe {
            let description = vk::CommandBufferAllocateInfo::default()
                .command_pool(self.pool)
                .level(vk::CommandBufferLevel::PRIMARY)
                .command_buffer_count(1);
            let commands = gpu.device.allocate_command_buffers(&description).map_err(|e| gpu.error(e))?[0];
            // Several steps may be under way.
            let description =
                vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::SIMULTANEOUS_USE);
            gpu.device.begin_command_buffer(commands, &description).map_err(|e| gpu.error(e))?;
            let read_clock = |number: usize| {
                if let Some(queries) = clock {
                    let all_before = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                    gpu.device.cmd_write_timestamp(commands, all_before, queries, number as u32);
                }
            };
            if let Some(queries) = clock {
                gpu.device.cmd_reset_query_pool(commands, queries, 0, self.launches.len() as u32 + 1);
            }
            let compute = vk::PipelineBindPoint::COMPUTE;
            let run = |dispatch: &Dispatch| {
                gpu.device.cmd_bind_pipeline(commands, compute, dispatch.pipeline);
                gpu.device.cmd_bind_descriptor_sets(commands, compute, dispatch.layout, 0, &[dispatch.set], &[]);
                let [x, y, z] = dispatch.workgroups;
                gpu.device.cmd_dispatch(commands, x, y, z);
            };
            barrier(gpu, commands);
            if clock.is_some() {
                read_clock(0);
                for (i, launch) in self.launches.iter().enumerate() {
                    for dispatch in &self.dispatches[launch.clone()] {
                        run(dispatch);
                        barrier(gpu, commands);
                    }
                    read_clock(i + 1);
                }
            } else {
                for group in &self.groups {
                    group.iter().for_each(|d| run(&self.dispatches[*d]));
                    barrier(gpu, commands);
                }
            }
            gpu.device.end_command_buffer(commands).map_err(|e| gpu.error(e))?;
            Ok(commands)
        }
    }
}

/// A program's dispatches once more, with the clock read between launches.
pub(super) struct Timed<'l> {
    pub commands: vk::CommandBuffer,
    queries: vk::QueryPool,
    clock: Clock,
    loaded: &'l Loaded,
}

impl Timed<'_> {
    pub fn new(loaded: &Loaded, clock: Clock) -> Result<Timed<'_>, RunError> {
        let gpu = &loaded.gpu;
        let description = vk::QueryPoolCreateInfo::default()
            .query_type(vk::QueryType::TIMESTAMP)
            .query_count(loaded.launches.len() as u32 + 1);
        // SAFETY: handles of this device.
        let queries = unsafe { gpu.device.create_query_pool(&description, None) }.map_err(|e| gpu.error(e))?;
        let mut timed = Timed { commands: vk::CommandBuffer::null(), queries, clock, loaded };
        timed.commands = loaded.record(Some(queries))?;
        Ok(timed)
    }

    /// Seconds of every launch of a run that is done.
    pub fn seconds(&self) -> Result<Vec<f64>, RunError> {
        let gpu = &self.loaded.gpu;
        let mut ticks = vec![0u64; self.loaded.launches.len() + 1];
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        // SAFETY: the queries were written by the run.
        unsafe { gpu.device.get_query_pool_results(self.queries, 0, &mut ticks, flags).map_err(|e| gpu.error(e))? };
        let between = |w: &[u64]| (w[1].wrapping_sub(w[0]) & self.clock.mask) as f64 * self.clock.seconds_per_tick;
        Ok(ticks.windows(2).map(between).collect())
    }
}

impl Drop for Timed<'_> {
    fn drop(&mut self) {
        let device = &self.loaded.gpu.device;
        // SAFETY: the run was waited for, or never began.
        unsafe {
            if self.commands != vk::CommandBuffer::null() {
                device.free_command_buffers(self.loaded.pool, &[self.commands]);
            }
            device.destroy_query_pool(self.queries, None);
        }
    }
}

impl Drop for Loaded {
    fn drop(&mut self) {
        let device = &self.gpu.device;
        // SAFETY: the session's queue has waited for its work. Null handles are ignored.
        unsafe {
            device.destroy_command_pool(self.pool, None);
            device.destroy_descriptor_pool(self.descriptors, None);
            self.dispatches.iter().for_each(|d| device.destroy_pipeline(d.pipeline, None));
            for layouts in self.layouts.values() {
                device.destroy_pipeline_layout(layouts.pipeline, None);
                device.destroy_descriptor_set_layout(layouts.set, None);
            }
        }
    }
}
