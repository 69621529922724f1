//! A program on the device: pipelines, bindings, and all dispatches in one command buffer.

use super::adapter::Gpu;
use super::memory::Buffer;
use super::queue::barrier;
use crate::RunError;
use crate::gpu::bound;
use ash::vk;
use raygrad_kernels::gpu::{GpuLaunch, Kernel};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Bindings of kernels that bind the same number of buffers.
struct Layouts {
    set: vk::DescriptorSetLayout,
    pipeline: vk::PipelineLayout,
}

pub(crate) struct Loaded {
    /// Recorded once, submitted at every step.
    pub(super) commands: vk::CommandBuffer,
    layouts: BTreeMap<usize, Layouts>,
    pipelines: Vec<vk::Pipeline>,
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
        let kernels: Vec<Kernel> = launches.into_iter().flat_map(|l| l.kernels).collect();
        // Null handles may be destroyed, so that what was made goes with `loaded` if something fails.
        let mut loaded = Loaded {
            commands: vk::CommandBuffer::null(),
            layouts: BTreeMap::new(),
            pipelines: vec![],
            descriptors: vk::DescriptorPool::null(),
            pool: vk::CommandPool::null(),
            gpu: gpu.clone(),
        };
        for kernel in &kernels {
            loaded.layouts(kernel.bindings.len())?;
        }
        // Drivers compile here, each kernel by itself.
        let pipelines: Vec<_> = kernels.par_iter().map(|k| loaded.pipeline(k)).collect();
        let mut failed = None;
        for pipeline in pipelines {
            match pipeline {
                Ok(pipeline) => loaded.pipelines.push(pipeline),
                Err(e) => failed = failed.or(Some(e)),
            }
        }
        if let Some(e) = failed {
            return Err(e);
        }
        let sets = loaded.bind(&kernels, inputs, own)?;
        loaded.record(&kernels, &sets)?;
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
    fn bind(
        &mut self,
        kernels: &[Kernel],
        inputs: &[Buffer],
        own: &[Buffer],
    ) -> Result<Vec<vk::DescriptorSet>, RunError> {
        if kernels.is_empty() {
            return Ok(vec![]);
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
            for (kernel, set) in kernels.iter().zip(&sets) {
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
                    .dst_set(*set)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .buffer_info(&buffers);
                gpu.device.update_descriptor_sets(&[write], &[]);
            }
            Ok(sets)
        }
    }

    /// Records all dispatches, each after the one before it.
    fn record(&mut self, kernels: &[Kernel], sets: &[vk::DescriptorSet]) -> Result<(), RunError> {
        let gpu = &self.gpu;
        let description = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.family);
        // SAFETY: handles of this device.
        unsafe {
            self.pool = gpu.device.create_command_pool(&description, None).map_err(|e| gpu.error(e))?;
            let description = vk::CommandBufferAllocateInfo::default()
                .command_pool(self.pool)
                .level(vk::CommandBufferLevel::PRIMARY)
                .command_buffer_count(1);
            let commands = gpu.device.allocate_command_buffers(&description).map_err(|e| gpu.error(e))?[0];
            // Several steps may be under way.
            let description =
                vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::SIMULTANEOUS_USE);
            gpu.device.begin_command_buffer(commands, &description).map_err(|e| gpu.error(e))?;
            let compute = vk::PipelineBindPoint::COMPUTE;
            for ((kernel, set), pipeline) in kernels.iter().zip(sets).zip(&self.pipelines) {
                barrier(gpu, commands);
                let layout = self.layouts[&kernel.bindings.len()].pipeline;
                gpu.device.cmd_bind_pipeline(commands, compute, *pipeline);
                gpu.device.cmd_bind_descriptor_sets(commands, compute, layout, 0, &[*set], &[]);
                let [x, y, z] = kernel.workgroups;
                gpu.device.cmd_dispatch(commands, x, y, z);
            }
            gpu.device.end_command_buffer(commands).map_err(|e| gpu.error(e))?;
            self.commands = commands;
        }
        Ok(())
    }
}

impl Drop for Loaded {
    fn drop(&mut self) {
        let device = &self.gpu.device;
        // SAFETY: the session's queue has waited for its work. Null handles are ignored.
        unsafe {
            device.destroy_command_pool(self.pool, None);
            device.destroy_descriptor_pool(self.descriptors, None);
            self.pipelines.iter().for_each(|p| device.destroy_pipeline(*p, None));
            for layouts in self.layouts.values() {
                device.destroy_pipeline_layout(layouts.pipeline, None);
                device.destroy_descriptor_set_layout(layouts.set, None);
            }
        }
    }
}
