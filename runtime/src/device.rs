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
        Device::cpu(threads)
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
        }
    }

    /// Everything programs can run on here.
    pub fn list() -> Vec<DeviceInfo> {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        vec![DeviceInfo {
            id: "cpu".into(),
            name: format!("CPU, {threads} threads"),
            backend: "cpu",
            details: format!("{} kernels", Isa::detect()),
        }]
    }
}
