//! The order of things: what the host writes, steps, and what it reads.
//!
//! Writes are collected in a frame: copied to memory that the device sees, and recorded as copies. A step submits the
//! frame's copies and the program's command buffer together. There are [`QUEUED`] frames, so that the host runs ahead by
//! as many steps and waits for a frame only when it comes round again.

use super::adapter::Gpu;
use super::memory::Buffer;
use crate::RunError;
use crate::gpu::QUEUED;
use ash::vk;
use std::sync::Arc;

/// Most bytes of a frame's writes; more go in pieces.
const MOST: usize = 4 << 20;
/// Room that a frame starts with.
const LEAST: usize = 16 << 10;

/// Writes under way, with the step after them.
struct Frame {
    commands: vk::CommandBuffer,
    done: vk::Fence,
    /// Submitted, and not waited for yet.
    busy: bool,
    /// Whether commands are being recorded.
    open: bool,
    staging: Option<Buffer>,
    used: usize,
}

pub(super) struct Queue {
    frames: Vec<Frame>,
    /// The frame that is next submitted.
    at: usize,
    pool: vk::CommandPool,
    back: Option<Buffer>,
    gpu: Arc<Gpu>,
}

impl Queue {
    pub fn new(gpu: Arc<Gpu>) -> Result<Queue, RunError> {
        let description = vk::CommandPoolCreateInfo::default()
            .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER | vk::CommandPoolCreateFlags::TRANSIENT)
            .queue_family_index(gpu.family);
        // SAFETY: handles of this device; the queue destroys them when it goes, whatever was made until then.
        unsafe {
            let pool = gpu.device.create_command_pool(&description, None).map_err(|e| gpu.error(e))?;
            let mut queue = Queue { frames: vec![], at: 0, pool, back: None, gpu };
            let gpu = &queue.gpu;
            let description = vk::CommandBufferAllocateInfo::default()
                .command_pool(pool)
                .level(vk::CommandBufferLevel::PRIMARY)
                .command_buffer_count(QUEUED as u32);
            let commands = gpu.device.allocate_command_buffers(&description).map_err(|e| gpu.error(e))?;
            for commands in commands {
                let done = gpu.device.create_fence(&Default::default(), None).map_err(|e| gpu.error(e))?;
                queue.frames.push(Frame { commands, done, busy: false, open: false, staging: None, used: 0 });
            }
            Ok(queue)
        }
    }

    /// Fills a buffer with zeros, and waits: if loading fails after this, the buffer goes, and nothing may need it then.
    pub fn zero(&mut self, buffer: &Buffer) -> Result<(), RunError> {
        let commands = self.record(0)?;
        // SAFETY: `commands` is being recorded, and the buffer may be copied to.
        unsafe { self.gpu.device.cmd_fill_buffer(commands, buffer.raw, 0, vk::WHOLE_SIZE, 0) };
        self.submit_and_wait(None)
    }

    /// Sets the bytes of a buffer from `first` on.
    pub fn write(&mut self, buffer: &Buffer, first: u64, bytes: &[u8]) -> Result<(), RunError> {
        let mut to = first;
        for piece in bytes.chunks(MOST) {
            let commands = self.record(piece.len())?;
            let frame = &mut self.frames[self.at];
            let Some(staging) = &mut frame.staging else { continue };
            staging.bytes()?[frame.used..frame.used + piece.len()].copy_from_slice(piece);
            let region = vk::BufferCopy { src_offset: frame.used as u64, dst_offset: to, size: piece.len() as u64 };
            // SAFETY: `commands` is being recorded, and both ranges lie inside their buffers.
            unsafe { self.gpu.device.cmd_copy_buffer(commands, staging.raw, buffer.raw, &[region]) };
            self.frames[self.at].used += piece.len();
            self.barrier(commands);
            to += piece.len() as u64;
        }
        self.gpu.check()
    }

    /// Waits for all work, and reads lanes of a buffer from byte `first` on.
    pub fn read(&mut self, buffer: &Buffer, first: u64, lanes: usize) -> Result<Vec<u32>, RunError> {
        let size = 4 * lanes as u64;
        if size == 0 {
            return Ok(vec![]);
        }
        let commands = self.record(0)?;
        if self.back.as_ref().is_none_or(|b| b.size < size) {
            self.back = Some(Buffer::to_host(&self.gpu, size.next_power_of_two())?);
        }
        let Some(back) = &mut self.back else { return Ok(vec![]) };
        let region = vk::BufferCopy { src_offset: first, dst_offset: 0, size };
        let (copies, host) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::HOST);
        let seen = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        // SAFETY: `commands` is being recorded, and both ranges lie inside their buffers.
        unsafe {
            self.gpu.device.cmd_copy_buffer(commands, buffer.raw, back.raw, &[region]);
            // The end of a submission does not make what it wrote visible to the host.
            self.gpu.device.cmd_pipeline_barrier(commands, copies, host, Default::default(), &seen, &[], &[]);
        }
        self.submit_and_wait(None)?;
        let Some(back) = &mut self.back else { return Ok(vec![]) };
        Ok(bytemuck::pod_collect_to_vec(&back.bytes()?[..size as usize]))
    }

    /// Submits what the frame has recorded and then the program, and goes on to the next frame.
    pub fn submit(&mut self, program: Option<vk::CommandBuffer>) -> Result<(), RunError> {
        self.wait(self.at)?;
        let (gpu, frame) = (&self.gpu, &mut self.frames[self.at]);
        // SAFETY: the command buffers are complete, and nothing of this frame is under way.
        unsafe {
            let own = std::mem::take(&mut frame.open).then_some(frame.commands);
            if let Some(commands) = own {
                gpu.device.end_command_buffer(commands).map_err(|e| gpu.error(e))?;
            }
            let commands: Vec<vk::CommandBuffer> = own.into_iter().chain(program).collect();
            let work = vk::SubmitInfo::default().command_buffers(&commands);
            gpu.device.queue_submit(*gpu.queue(), &[work], frame.done).map_err(|e| gpu.error(e))?;
        }
        frame.busy = true;
        self.at = (self.at + 1) % QUEUED;
        self.gpu.check()
    }

    /// The same, and waits for all of it.
    pub fn submit_and_wait(&mut self, program: Option<vk::CommandBuffer>) -> Result<(), RunError> {
        let at = self.at;
        let submitted = self.submit(program);
        // Also after an error: whoever hears of it may free what is in use.
        submitted.and(self.wait(at))
    }

    /// Waits until a frame may be used again.
    fn wait(&mut self, at: usize) -> Result<(), RunError> {
        let (gpu, frame) = (&self.gpu, &mut self.frames[at]);
        if frame.busy {
            // SAFETY: the fence was given to a submission.
            unsafe {
                gpu.device.wait_for_fences(&[frame.done], true, u64::MAX).map_err(|e| gpu.error(e))?;
                gpu.device.reset_fences(&[frame.done]).map_err(|e| gpu.error(e))?;
            }
            (frame.busy, frame.used) = (false, 0);
        }
        Ok(())
    }

    /// The command buffer of a frame that has room for so many bytes.
    fn record(&mut self, bytes: usize) -> Result<vk::CommandBuffer, RunError> {
        let full = |f: &Frame| f.used + bytes > f.staging.as_ref().map_or(0, |s| s.size as usize);
        let frame = &self.frames[self.at];
        if !frame.busy && frame.used > 0 && full(frame) {
            self.submit(None)?;
        }
        self.wait(self.at)?;
        if full(&self.frames[self.at]) {
            let size = bytes.next_power_of_two().max(LEAST);
            self.frames[self.at].staging = Some(Buffer::to_device(&self.gpu, size as u64)?);
        }
        let (gpu, frame) = (&self.gpu, &mut self.frames[self.at]);
        let commands = frame.commands;
        if !frame.open {
            let description = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
            // SAFETY: nothing of this frame is under way.
            unsafe { gpu.device.begin_command_buffer(commands, &description).map_err(|e| gpu.error(e))? };
            frame.open = true;
            self.barrier(commands);
        }
        Ok(commands)
    }

    fn barrier(&self, commands: vk::CommandBuffer) {
        barrier(&self.gpu, commands);
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        // Only for this queue's own work: to wait for the device, no other session may submit meanwhile.
        for at in 0..self.frames.len() {
            let _ = self.wait(at);
        }
        // SAFETY: after the waits nothing of this queue is under way; a lost device has no work either.
        unsafe {
            self.frames.iter().for_each(|f| self.gpu.device.destroy_fence(f.done, None));
            self.gpu.device.destroy_command_pool(self.pool, None);
        }
    }
}

/// What kernels and copies did that were recorded or submitted before is done, and seen by those after.
pub(super) fn barrier(gpu: &Gpu, commands: vk::CommandBuffer) {
    let shader = vk::AccessFlags::SHADER_READ | vk::AccessFlags::SHADER_WRITE;
    let copies = vk::AccessFlags::TRANSFER_READ | vk::AccessFlags::TRANSFER_WRITE;
    let all = shader | copies;
    let memory = [vk::MemoryBarrier::default().src_access_mask(all).dst_access_mask(all)];
    let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
    // SAFETY: `commands` is being recorded.
    unsafe { gpu.device.cmd_pipeline_barrier(commands, stages, stages, Default::default(), &memory, &[], &[]) };
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gpu() -> Option<Arc<Gpu>> {
        crate::gpu::expected(Gpu::open(None)).map(Arc::new)
    }

    /// More writes than frames, pieces larger than a frame, and all of them in order.
    #[test]
    fn writes_of_all_sizes_arrive_in_order() {
        let Some(gpu) = gpu() else { return };
        let lanes = 5 * MOST / 8;
        let buffer = Buffer::on_device(&gpu, "test", 4 * lanes as u64).unwrap();
        let mut queue = Queue::new(gpu).unwrap();
        queue.zero(&buffer).unwrap();
        let mut expected = vec![0u32; lanes];
        let mut first = 0;
        for (i, length) in [1, 7, 100_000, 3, lanes - 200_000, 5000, 1, 1, 1, 1, 1, 9].into_iter().enumerate() {
            let values: Vec<u32> = (0..length).map(|v| (v * 31 + i * 7 + 1) as u32).collect();
            queue.write(&buffer, 4 * first as u64, bytemuck::cast_slice(&values)).unwrap();
            expected[first..first + length].copy_from_slice(&values);
            if i % 2 == 1 {
                queue.submit(None).unwrap();
            }
            // Overlaps with what comes next.
            first += length / 2;
        }
        assert!(queue.read(&buffer, 0, lanes).unwrap() == expected);
        assert_eq!(queue.read(&buffer, 4 * 3, 2).unwrap(), expected[3..5]);
        assert_eq!(queue.read(&buffer, 0, 0).unwrap(), []);
    }

    /// An error does not leave what was submitted under way: its buffers may go.
    #[test]
    fn errors_are_told_after_the_wait() {
        if std::env::var_os("RAYGRAD_VULKAN_VALIDATION").is_none_or(|v| v != "1") {
            println!("skipped, RAYGRAD_VULKAN_VALIDATION is not 1");
            return;
        }
        let Some(gpu) = gpu() else { return };
        let buffer = Buffer::on_device(&gpu, "test", 16).unwrap();
        let mut queue = Queue::new(gpu.clone()).unwrap();
        let commands = queue.record(0).unwrap();
        // SAFETY: recorded, inside the buffer; the size should be a multiple of four, which validation alone minds.
        unsafe { gpu.device.cmd_fill_buffer(commands, buffer.raw, 0, 6, 0) };
        assert!(queue.submit_and_wait(None).is_err());
        assert!(queue.frames.iter().all(|f| !f.busy));
    }

    /// The test suite runs with validation: what it says must reach us.
    #[test]
    fn what_validation_says_is_an_error() {
        if std::env::var_os("RAYGRAD_VULKAN_VALIDATION").is_none_or(|v| v != "1") {
            println!("skipped, RAYGRAD_VULKAN_VALIDATION is not 1");
            return;
        }
        let Some(gpu) = gpu() else { return };
        let buffer = Buffer::on_device(&gpu, "test", 16).unwrap();
        let mut queue = Queue::new(gpu).unwrap();
        // Recorded only: the frame is never submitted.
        let error = queue.write(&buffer, 12, &[0; 8]).unwrap_err().to_string();
        assert!(error.contains("VUID"), "{error}");
    }
}
