//! What a device could do at best: to compare steps and launches with.

use crate::{Device, RunError, Session};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};
use raygrad_kernels::cpu::peak::peak_gflops;
use std::time::Instant;
#[cfg(feature = "gpu")]
use {
    crate::gpu::Api,
    raygrad_compiler::cost::Rates,
    raygrad_kernels::gpu::{self, GpuProgram, LowerError},
};

/// Lanes of the buffer that passes through the CPU: more than caches hold.
const LANES: usize = 16 << 20;
const ROUNDS: usize = 5;
/// Launches of which the time of one is found.
#[cfg(feature = "gpu")]
const LAUNCHES: usize = 257;

impl Device {
    /// 10^9 operations a second of multiply-adds in registers, each counted as two; on the CPU on as many threads as it has,
    /// and of what its matrix products multiply.
    /// Takes some tenths of a second.
    pub fn peak_gflops(&self) -> Result<f64, RunError> {
        match self {
            Device::Cpu { pool, products } => Ok(peak_gflops(*products, pool.current_num_threads(), 150.0)),
            #[cfg(feature = "gpu")]
            _ => self.rate(gpu::multiply_adds(false)),
        }
    }

    /// 10^9 operations a second of cooperative matrices in registers; `None` unless the device is to use them.
    pub fn peak_matrix_gflops(&self) -> Result<Option<f64>, RunError> {
        #[cfg(feature = "gpu")]
        if let Some(matrices) = self.half().and_then(|h| h.matrices) {
            return Ok(Some(self.rate(gpu::matrix_products(matrices))?));
        }
        Ok(None)
    }

    /// 10^9 bytes a second to and from memory, of a buffer of 64 MiB.
    pub fn peak_gbytes(&self) -> Result<f64, RunError> {
        match self {
            Device::Cpu { .. } => Ok(8.0 * LANES as f64 / self.fastest_pass()? * 1e-9),
            #[cfg(feature = "gpu")]
            _ => self.rate(gpu::copy()),
        }
    }

    /// Seconds of the fastest of some passes over a buffer that is read, changed and written.
    fn fastest_pass(&self) -> Result<f64, RunError> {
        let x = Tensor::input("x", Role::State, Shape::new(&[&Axis::new("lane", LANES)], 1));
        let step = Step { outputs: vec![], updates: vec![(x.clone(), &x * 0.5 + 1.0)] };
        let mut session = Session::new(self.clone())?;
        let program = compile(&step, &self.target())
            .map_err(|e| RunError::Device { device: self.name(), problem: e.to_string() })?;
        let id = session.add(program)?;
        let mut best = f64::INFINITY;
        // The first round touches the memory.
        for round in 0..=ROUNDS {
            let begun = Instant::now();
            session.run(id)?;
            if round > 0 {
                best = best.min(begun.elapsed().as_secs_f64());
            }
        }
        Ok(best)
    }

    /// 10^9 of what a program does a second; of some runs, the fastest.
    #[cfg(feature = "gpu")]
    fn rate(&self, program: Result<(GpuProgram, f64), LowerError>) -> Result<f64, RunError> {
        let (program, work) = program.map_err(|e| self.problem(&e))?;
        Ok(work / self.fastest(program, true)? * 1e-9)
    }

    /// All that the cost model asks of a GPU, measured now; with the rate of matrices where it has them.
    #[cfg(feature = "gpu")]
    pub(crate) fn measure_rates(&self) -> Result<Rates, RunError> {
        let gflops = self.peak_gflops()?;
        let matrices = self.clone().with_half(self.has_half()).peak_matrix_gflops()?;
        let alone = self.rate(gpu::multiply_adds(true))?;
        let rounded = Rates::rounded;
        Ok(Rates {
            gflops: rounded(gflops),
            product_gflops: rounded(matrices.unwrap_or(gflops).max(gflops)),
            mbytes: rounded(1e3 * self.peak_gbytes()?),
            launch_ns: rounded(1e9 * self.launch_seconds()?),
            workgroups: rounded(gflops / alone),
        })
    }

    /// Seconds of a launch that waits for the one before it and does nothing, by the host's clock: what many take longer than one.
    #[cfg(feature = "gpu")]
    fn launch_seconds(&self) -> Result<f64, RunError> {
        let seconds = |count| self.fastest(gpu::launches(count).map_err(|e| self.problem(&e))?, false);
        Ok((seconds(LAUNCHES)? - seconds(1)?).max(0.0) / (LAUNCHES - 1) as f64)
    }

    #[cfg(feature = "gpu")]
    fn problem(&self, e: &LowerError) -> RunError {
        RunError::Device { device: self.name(), problem: e.to_string() }
    }

    /// Seconds of the fastest of some runs of a program without inputs, by the device's clock if it is to and has one.
    #[cfg(feature = "gpu")]
    fn fastest(&self, program: GpuProgram, by_device: bool) -> Result<f64, RunError> {
        match self {
            Device::Cpu { .. } => Err(RunError::Target(raygrad_compiler::fuse::TargetKind::Gpu)),
            #[cfg(feature = "wgpu")]
            Device::Wgpu { gpu, .. } => fastest(crate::wgpu::WgpuApi::new(gpu.clone()), program, by_device),
            #[cfg(feature = "vulkan")]
            Device::Vulkan { gpu, .. } => fastest(crate::vulkan::VulkanApi::new(gpu.clone())?, program, by_device),
        }
    }
}

#[cfg(feature = "gpu")]
fn fastest<A: Api>(mut api: A, program: GpuProgram, by_device: bool) -> Result<f64, RunError> {
    let own = program.arenas.iter().map(|a| api.buffer(a)).collect::<Result<Vec<_>, _>>()?;
    let loaded = api.load(program.launches, &[], &own)?;
    let best = fastest_round(&mut api, &loaded, &own[0], by_device);
    // First, as in a session: it waits for its work.
    drop(api);
    best
}

#[cfg(feature = "gpu")]
fn fastest_round<A: Api>(api: &mut A, loaded: &A::Loaded, own: &A::Buffer, by_device: bool) -> Result<f64, RunError> {
    let mut best = f64::INFINITY;
    for round in 0..=ROUNDS {
        let begun = Instant::now();
        let profiled = if by_device { api.profile(loaded)? } else { None };
        let seconds = match profiled {
            Some(launches) => launches.iter().sum(),
            None => {
                api.submit(loaded)?;
                api.read(own, 0, 1)?;
                begun.elapsed().as_secs_f64()
            }
        };
        // The first round compiles.
        if round > 0 {
            best = best.min(seconds);
        }
    }
    Ok(best)
}
