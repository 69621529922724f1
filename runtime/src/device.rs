//! Devices: what programs run on.

use crate::DeviceError;
use raygrad_compiler::Target;
use raygrad_kernels::cpu::Isa;
use std::sync::Arc;

/// A device to run sessions on.
#[derive(Clone)]
pub enum Device {
    /// The CPU, with a pool of its own threads.
    Cpu { pool: Arc<rayon::ThreadPool> },
    /// A GPU, or software that acts as one.
    #[cfg(feature = "wgpu")]
    Wgpu { gpu: Arc<crate::wgpu::Gpu> },
}

/// A device as listed for people.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// What `--device` takes.
    pub id: String,
    pub name: String,
    pub backend: &'static str,
    pub details: String,
}

impl Device {
    /// A real GPU if there is one, else the CPU.
    pub fn auto(threads: Option<usize>) -> Result<Device, DeviceError> {
        #[cfg(feature = "wgpu")]
        if let Some(gpu) = crate::wgpu::Gpu::auto() {
            return Ok(Device::Wgpu { gpu: Arc::new(gpu) });
        }
        Device::cpu(threads)
    }

    /// The adapter numbered `index` in [`Device::list`], or the best one, software included.
    #[cfg(feature = "wgpu")]
    pub fn wgpu(index: Option<usize>) -> Result<Device, DeviceError> {
        Ok(Device::Wgpu { gpu: Arc::new(crate::wgpu::Gpu::open(index)?) })
    }

    /// This build has no GPU backend.
    #[cfg(not(feature = "wgpu"))]
    pub fn wgpu(_: Option<usize>) -> Result<Device, DeviceError> {
        Err(DeviceError::NotBuilt)
    }

    /// The CPU with `threads` threads, by default one a core. Results do not depend on the number.
    pub fn cpu(threads: Option<usize>) -> Result<Device, DeviceError> {
        let threads = match threads {
            Some(0) => return Err(DeviceError::Threads { threads: 0, reason: "at least one is needed".into() }),
            Some(n) => n,
            None => std::thread::available_parallelism().map_or(1, usize::from),
        };
        let builder = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("raygrad-{i}"));
        let pool = builder.build().map_err(|e| DeviceError::Threads { threads, reason: e.to_string() })?;
        Ok(Device::Cpu { pool: Arc::new(pool) })
    }

    /// What to compile programs for.
    pub fn target(&self) -> Target {
        match self {
            Device::Cpu { .. } => Target::cpu(),
            #[cfg(feature = "wgpu")]
            Device::Wgpu { .. } => Target::gpu(),
        }
    }

    /// Everything programs can run on here.
    pub fn list() -> Vec<DeviceInfo> {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let cpu = DeviceInfo {
            id: "cpu".into(),
            name: format!("CPU, {threads} threads"),
            backend: "cpu",
            details: format!("{} kernels", Isa::detect()),
        };
        #[cfg_attr(not(feature = "wgpu"), expect(unused_mut))]
        let mut all = vec![cpu];
        #[cfg(feature = "wgpu")]
        all.extend(crate::wgpu::Gpu::list().into_iter().enumerate().map(|(i, a)| DeviceInfo {
            id: format!("wgpu:{i}"),
            name: a.name,
            backend: a.backend,
            details: format!("{}, {}", a.device_type, a.driver),
        }));
        all
    }
}
