//! Devices: what programs run on.

use crate::{DeviceError, RunError};
use raygrad_compiler::{Program, Target};
use raygrad_kernels::cpu::{Isa, Products};
use std::sync::Arc;
#[cfg(feature = "gpu")]
use {
    raygrad_compiler::cost::Rates,
    raygrad_kernels::gpu::{Half, Limits, SOFTWARE_TILES, storages},
};

/// Threads of the CPU that can be asked for.
const MOST_THREADS: usize = 1024;

/// A device to run sessions on.
#[derive(Clone)]
pub enum Device {
    /// The CPU, with a pool of its own threads, and what its matrix products multiply.
    Cpu { pool: Arc<rayon::ThreadPool>, products: Products },
    /// A GPU, or software that acts as one.
    #[cfg(feature = "wgpu")]
    Wgpu { gpu: Arc<crate::wgpu::Gpu>, forms: Forms },
    /// The same through Vulkan, with a device of raygrad's own.
    #[cfg(feature = "vulkan")]
    Vulkan { gpu: Arc<crate::vulkan::Gpu>, forms: Forms },
}

/// Which forms of kernels a device runs, where there is a choice, and what it is chosen by.
#[cfg(feature = "gpu")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Forms {
    /// What kernels use for half precision; `None` at single precision.
    pub half: Option<Half>,
    /// How many of the largest tiles not to use ([`raygrad_kernels::gpu::Limits::tiles`]); software has tiles of its own.
    pub tiles: u32,
    /// Networks whose layers have at most this many outputs stay in a workgroup ([`Target::resident`]); 0: none do.
    pub resident: usize,
    /// What the device does at best; of a GPU that was not measured ([`Device::measured`]), what a large one does.
    pub rates: Rates,
}

#[cfg(feature = "gpu")]
impl Default for Forms {
    fn default() -> Forms {
        Forms { half: None, tiles: 0, resident: 0, rates: Rates::GPU }
    }
}

#[cfg(feature = "gpu")]
impl Forms {
    /// What to compile programs for.
    pub fn target(self) -> Target {
        let matrices = self.half.is_some_and(|h| h.matrices.is_some());
        let rates = if matrices { self.rates } else { self.rates.single() };
        Target { resident: self.resident, rates, ..Target::gpu() }
    }

    /// What kernels of a program for such a target keep to, on a device of these limits.
    pub fn limits(self, target: &Target, of_device: Limits) -> Limits {
        Limits { half: self.half, tiles: self.tiles, workgroups: target.rates.workgroups, ..of_device }
    }

    /// Bytes of a lane of each of a program's buffers, by id.
    pub fn lane_bytes(self, program: &Program) -> Vec<u64> {
        storages(program, self.half.is_some()).iter().map(|s| s.bytes()).collect()
    }

    /// What suits an adapter: software has tiles of its own.
    fn of(adapter: &crate::Adapter) -> Forms {
        match adapter.kind {
            crate::AdapterKind::Software => Forms { tiles: SOFTWARE_TILES, rates: Rates::SOFTWARE, ..Forms::default() },
            _ => Forms::default(),
        }
    }
}

/// How precise a device computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Everything in single precision.
    #[default]
    F32,
    /// Matrix products of halves, summed in single precision. Parameters and everything else stay in single precision.
    /// A GPU stores what they read as halves (f16); the CPU rounds it to bfloat16 where they read it.
    Mixed,
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
        #[cfg(feature = "gpu")]
        if may_have_gpu() {
            // Where both drive an adapter, Vulkan was measured to be faster.
            #[cfg(feature = "vulkan")]
            if let Some(gpu) = crate::vulkan::Gpu::auto() {
                return Ok(Device::Vulkan { gpu: Arc::new(gpu), forms: Forms::default() });
            }
            #[cfg(feature = "wgpu")]
            if let Some(gpu) = crate::wgpu::Gpu::auto() {
                return Ok(Device::Wgpu { gpu: Arc::new(gpu), forms: Forms::default() });
            }
        }
        Device::cpu(threads)
    }

    /// The adapter numbered `index` in [`Device::list`], or the best one, software included.
    #[cfg(feature = "wgpu")]
    pub fn wgpu(index: Option<usize>) -> Result<Device, DeviceError> {
        let gpu = crate::wgpu::Gpu::open(index)?;
        let forms = Forms::of(gpu.adapter());
        Ok(Device::Wgpu { gpu: Arc::new(gpu), forms })
    }

    /// This build has no wgpu backend.
    #[cfg(not(feature = "wgpu"))]
    pub fn wgpu(_: Option<usize>) -> Result<Device, DeviceError> {
        Err(DeviceError::NotBuilt("wgpu"))
    }

    /// The Vulkan driver numbered `index` in [`Device::list`], or the best one, software included.
    #[cfg(feature = "vulkan")]
    pub fn vulkan(index: Option<usize>) -> Result<Device, DeviceError> {
        let gpu = crate::vulkan::Gpu::open(index)?;
        let forms = Forms::of(gpu.adapter());
        Ok(Device::Vulkan { gpu: Arc::new(gpu), forms })
    }

    /// This build has no Vulkan backend.
    #[cfg(not(feature = "vulkan"))]
    pub fn vulkan(_: Option<usize>) -> Result<Device, DeviceError> {
        Err(DeviceError::NotBuilt("vulkan"))
    }

    /// The CPU with `threads` threads, by default one a core. Results do not depend on the number.
    pub fn cpu(threads: Option<usize>) -> Result<Device, DeviceError> {
        let threads = match threads {
            Some(0) => return Err(DeviceError::Threads { threads: 0, reason: "at least one is needed".into() }),
            Some(n) if n > MOST_THREADS => {
                let reason = format!("at most {MOST_THREADS} are of any use");
                return Err(DeviceError::Threads { threads: n, reason });
            }
            Some(n) => n,
            None => std::thread::available_parallelism().map_or(1, usize::from),
        };
        let builder = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("raygrad-{i}"));
        let pool = builder.build().map_err(|e| DeviceError::Threads { threads, reason: e.to_string() })?;
        Ok(Device::Cpu { pool: Arc::new(pool), products: Products::F32 })
    }

    /// The same device at another precision. Cooperative matrices are used where a GPU has them and they pass a test
    /// against single precision. A CPU without dot products of bfloat16 computes the same from single precision, which
    /// takes longer than [`Precision::F32`].
    pub fn with_precision(self, precision: Precision) -> Result<Device, DeviceError> {
        match (precision, self) {
            (Precision::F32, Device::Cpu { pool, .. }) => Ok(Device::Cpu { pool, products: Products::F32 }),
            (Precision::Mixed, Device::Cpu { pool, .. }) => Ok(Device::Cpu { pool, products: Products::Bf16 }),
            #[cfg(feature = "gpu")]
            (Precision::F32, gpu) => Ok(gpu.with_half(None)),
            #[cfg(feature = "gpu")]
            (Precision::Mixed, gpu) => {
                let Some(half) = gpu.has_half() else { return Err(DeviceError::NoHalf { device: gpu.name() }) };
                let mixed = gpu.with_half(Some(half));
                if half.matrices.is_none() || crate::gpu::half::matrices_work(&mixed) {
                    return Ok(mixed);
                }
                Ok(mixed.with_half(Some(Half { matrices: None })))
            }
        }
    }

    /// The adapter, where the device is one.
    #[cfg(feature = "gpu")]
    pub(crate) fn adapter(&self) -> Option<&crate::Adapter> {
        match self {
            Device::Cpu { .. } => None,
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, .. } => Some(gpu.adapter()),
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, .. } => Some(gpu.adapter()),
        }
    }

    /// What the device has for half precision, if it stores halves.
    #[cfg(feature = "gpu")]
    pub fn has_half(&self) -> Option<Half> {
        self.adapter()?.half
    }

    /// The same device with what kernels may use for half precision.
    #[cfg(feature = "gpu")]
    pub fn with_half(self, half: Option<Half>) -> Device {
        let forms = Forms { half, ..self.forms() };
        self.with_forms(forms)
    }

    /// What kernels use for half precision; `None` at single precision.
    #[cfg(feature = "gpu")]
    pub fn half(&self) -> Option<Half> {
        self.forms().half
    }

    /// The same device with other forms of kernels.
    #[cfg(feature = "gpu")]
    pub fn with_forms(self, forms: Forms) -> Device {
        match self {
            Device::Cpu { .. } => self,
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, .. } => Device::Wgpu { gpu, forms },
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, .. } => Device::Vulkan { gpu, forms },
        }
    }

    #[cfg(feature = "gpu")]
    pub fn forms(&self) -> Forms {
        match self {
            Device::Cpu { .. } => Forms::default(),
            #[cfg(feature = "wgpu")]
            Device::Wgpu { forms, .. } => *forms,
            #[cfg(feature = "vulkan")]
            Device::Vulkan { forms, .. } => *forms,
        }
    }

    /// The same device with its rates, by which it is chosen what is stored, which tiles matrix products have and which form narrow
    /// networks: measured, which takes some tenths of a second, or known from before (they are kept on disk, rounded, by device
    /// and driver). Those of the CPU and of drivers in software are not measured: a step has the same bits wherever it runs.
    pub fn measured(self) -> Result<Device, RunError> {
        #[cfg(feature = "gpu")]
        return crate::gpu::rates::measured(self);
        #[cfg(not(feature = "gpu"))]
        Ok(self)
    }

    /// Seconds that every launch of a program should take by the cost model ([`raygrad_compiler::cost`]).
    pub fn predicted(&self, program: &Program) -> Vec<f64> {
        let of_lane = self.lane_bytes(program);
        program.predicted(|b| of_lane[b.0 as usize])
    }

    /// The same device with the tiles that run a program fastest: found by running it with each choice, or known from before
    /// (results are kept on disk, by program, device, driver and precision). On the CPU there is nothing to choose.
    ///
    /// Other tiles add up in another order: results differ by rounding.
    #[cfg_attr(not(feature = "gpu"), expect(unused_variables))]
    pub fn tuned(self, program: &Program) -> Result<Device, RunError> {
        match self {
            Device::Cpu { .. } => Ok(self),
            #[cfg(feature = "gpu")]
            _ => crate::gpu::tune::tuned(self, program),
        }
    }

    /// Of two programs for the same step, the one that this device runs faster: found, and kept, as by [`Device::tuned`]. Results
    /// differ by rounding. On the CPU, the first.
    pub fn faster(&self, programs: [Program; 2]) -> Result<Program, RunError> {
        #[cfg(feature = "gpu")]
        let best = if let Device::Cpu { .. } = self { 0 } else { crate::gpu::tune::faster(self, &programs)? };
        #[cfg(not(feature = "gpu"))]
        let best = 0;
        let [first, second] = programs;
        Ok(if best == 0 { first } else { second })
    }

    /// Bytes of a lane of each of a program's buffers, by id.
    pub fn lane_bytes(&self, program: &Program) -> Vec<u64> {
        #[cfg(feature = "gpu")]
        return self.forms().lane_bytes(program);
        #[cfg(not(feature = "gpu"))]
        vec![4; program.buffers.len()]
    }

    /// What kernels of a program for this device keep to; `None` on the CPU, which has no such kernels.
    #[cfg(feature = "gpu")]
    pub fn limits(&self, target: &Target) -> Option<Limits> {
        let of_device = match self {
            Device::Cpu { .. } => return None,
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, .. } => gpu.limits(),
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, .. } => gpu.limits(),
        };
        Some(self.forms().limits(target, of_device))
    }

    /// What to compile programs for.
    pub fn target(&self) -> Target {
        match self {
            Device::Cpu { .. } => Target::cpu(),
            #[cfg(feature = "gpu")]
            _ => self.forms().target(),
        }
    }

    /// The device, for people.
    pub fn name(&self) -> String {
        match self {
            Device::Cpu { pool, products } => {
                let form = match products {
                    Products::F32 => "",
                    Products::Bf16 if Isa::detect().multiplies_pairs() => ", bf16 products",
                    Products::Bf16 => ", bf16 products emulated (slower than f32)",
                };
                format!("CPU, {} threads{form}", pool.current_num_threads())
            }
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, .. } => gpu.adapter().name.clone(),
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, .. } => gpu.adapter().name.clone(),
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
        #[cfg_attr(not(feature = "gpu"), expect(unused_mut))]
        let mut all = vec![cpu];
        #[cfg(feature = "wgpu")]
        all.extend(listed("wgpu", crate::wgpu::Gpu::list()));
        #[cfg(feature = "vulkan")]
        all.extend(listed("vulkan", crate::vulkan::Gpu::list()));
        all
    }
}

/// Adapters of a backend, in the order in which `--device` counts them.
#[cfg(feature = "gpu")]
fn listed(backend: &str, adapters: Vec<crate::gpu::Adapter>) -> impl Iterator<Item = DeviceInfo> {
    adapters.into_iter().enumerate().map(move |(i, a)| DeviceInfo {
        id: format!("{backend}:{i}"),
        name: a.name,
        backend: a.api,
        details: format!("{}, {}{}", a.kind, a.driver, a.half.map_or(String::new(), |h| format!(", {h}"))),
    })
}

/// Whether a GPU can be here. Without a device file of one, every adapter is a software one, and to ask it costs 50 MB and
/// a tenth of a second.
#[cfg(feature = "gpu")]
fn may_have_gpu() -> bool {
    let files = ["/dev/dri", "/dev/nvidiactl", "/dev/dxg", "/dev/kgsl-3d0", "/dev/mali0"];
    !cfg!(target_os = "linux") || files.iter().any(|f| std::path::Path::new(f).exists())
}
