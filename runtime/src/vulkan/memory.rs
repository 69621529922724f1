//! Buffers, and the memory below them.

use super::adapter::Gpu;
use crate::RunError;
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::Arc;

/// A buffer with memory of its own.
pub(crate) struct Buffer {
    pub(super) raw: vk::Buffer,
    pub(super) size: u64,
    allocation: Allocation,
    gpu: Arc<Gpu>,
}

impl Buffer {
    /// For kernels.
    pub fn on_device(gpu: &Arc<Gpu>, name: &str, size: u64) -> Result<Buffer, RunError> {
        let transfer = vk::BufferUsageFlags::TRANSFER_SRC | vk::BufferUsageFlags::TRANSFER_DST;
        Buffer::new(gpu, name, size, vk::BufferUsageFlags::STORAGE_BUFFER | transfer, MemoryLocation::GpuOnly)
    }

    /// What the host writes for the device to copy.
    pub fn to_device(gpu: &Arc<Gpu>, size: u64) -> Result<Buffer, RunError> {
        Buffer::new(gpu, "staging", size, vk::BufferUsageFlags::TRANSFER_SRC, MemoryLocation::CpuToGpu)
    }

    /// What the device copies for the host to read.
    pub fn to_host(gpu: &Arc<Gpu>, size: u64) -> Result<Buffer, RunError> {
        Buffer::new(gpu, "read back", size, vk::BufferUsageFlags::TRANSFER_DST, MemoryLocation::GpuToCpu)
    }

    fn new(
        gpu: &Arc<Gpu>,
        name: &str,
        size: u64,
        usage: vk::BufferUsageFlags,
        location: MemoryLocation,
    ) -> Result<Buffer, RunError> {
        let failed = |problem: String| gpu.problem(format!("`{name}`, {size} bytes: {problem}"));
        let description = vk::BufferCreateInfo::default().size(size).usage(usage);
        // SAFETY: the buffer belongs to this device, and its memory is bound once, right here.
        unsafe {
            let raw = gpu.device.create_buffer(&description, None).map_err(|e| failed(e.to_string()))?;
            let requirements = gpu.device.get_buffer_memory_requirements(raw);
            let allocation = gpu.allocate(|a| {
                let description = AllocationCreateDesc {
                    name,
                    requirements,
                    location,
                    linear: true,
                    allocation_scheme: AllocationScheme::GpuAllocatorManaged,
                };
                a.allocate(&description).map_err(|e| failed(e.to_string()))
            });
            let allocation = match allocation {
                Ok(allocation) => allocation,
                Err(e) => {
                    gpu.device.destroy_buffer(raw, None);
                    return Err(e);
                }
            };
            let buffer = Buffer { raw, size, allocation, gpu: gpu.clone() };
            let (memory, offset) = (buffer.allocation.memory(), buffer.allocation.offset());
            gpu.device.bind_buffer_memory(raw, memory, offset).map_err(|e| failed(e.to_string()))?;
            Ok(buffer)
        }
    }

    /// The bytes that the host sees.
    pub fn bytes(&mut self) -> Result<&mut [u8], RunError> {
        let problem = self.gpu.problem("memory for the host is not mapped");
        self.allocation.mapped_slice_mut().ok_or(problem)
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let allocation = std::mem::take(&mut self.allocation);
        // SAFETY: the queue of a session waits for its work before buffers go.
        unsafe { self.gpu.device.destroy_buffer(self.raw, None) };
        // Freeing fails only for an allocation of another allocator.
        let _ = self.gpu.allocate(|a| a.free(allocation).map_err(|e| self.gpu.problem(e.to_string())));
    }
}
