//! Reading back, through one staging buffer that only grows.

use super::adapter::Gpu;
use super::api;
use crate::RunError;
use std::sync::mpsc;

#[derive(Default)]
pub(super) struct Staging(Option<api::Buffer>);

impl Staging {
    /// Lanes `first..first + lanes` of a buffer, once everything submitted is done.
    pub fn read(&mut self, gpu: &Gpu, from: &api::Buffer, first: usize, lanes: usize) -> Result<Vec<u32>, RunError> {
        let size = 4 * lanes as u64;
        // Kept only after a read that succeeded: a buffer for which there was no memory has a size, too.
        let staging = match self.0.take() {
            Some(buffer) if buffer.size() >= size => buffer,
            _ => gpu.device.create_buffer(&api::BufferDescriptor {
                label: Some("staging"),
                size: size.next_power_of_two(),
                usage: api::BufferUsages::MAP_READ | api::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            }),
        };
        gpu.check()?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(from, 4 * first as u64, &staging, 0, size);
        gpu.queue.submit([encoder.finish()]);
        let (done, mapped) = mpsc::channel();
        staging.map_async(api::MapMode::Read, 0..size, move |result| {
            // Nobody listens only if the wait below failed already.
            let _ = done.send(result);
        });
        gpu.wait(None)?;
        match mapped.try_recv() {
            Ok(Ok(())) => {}
            Ok(Err(e)) => return Err(gpu.problem(e.to_string())),
            Err(_) => return Err(gpu.problem("a buffer could not be mapped".into())),
        }
        let values = {
            let view = staging.get_mapped_range(0..size).map_err(|e| gpu.problem(e.to_string()))?;
            bytemuck::pod_collect_to_vec(&view)
        };
        staging.unmap();
        self.0 = Some(staging);
        Ok(values)
    }
}
