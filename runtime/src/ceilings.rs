//! What a device could do at best: to compare steps and launches with.

use crate::{Device, RunError, Session};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};
use raygrad_kernels::cpu::peak::peak_gflops;
use std::time::Instant;

/// Lanes of the buffer that passes through: more than caches hold.
const LANES: usize = 16 << 20;
const ROUNDS: usize = 5;

impl Device {
    /// 10^9 operations a second of multiply-adds in registers, each counted as two; on the CPU on as many threads as it has.
    /// Takes some tenths of a second.
    pub fn peak_gflops(&self) -> Result<f64, RunError> {
        match self {
            Device::Cpu { pool } => Ok(peak_gflops(pool.current_num_threads(), 150.0)),
            #[cfg(feature = "gpu")]
            _ => {
                let (step, operations) = multiply_adds();
                Ok(operations / self.fastest(&step)? * 1e-9)
            }
        }
    }

    /// 10^9 bytes a second to and from memory, of a buffer of 64 MiB that is read and written in place.
    pub fn peak_gbytes(&self) -> Result<f64, RunError> {
        Ok(8.0 * LANES as f64 / self.fastest(&copy())? * 1e-9)
    }

    /// Seconds of the fastest of some runs, by the device's clock where it has one.
    fn fastest(&self, step: &Step) -> Result<f64, RunError> {
        let mut session = Session::new(self.clone())?;
        let program = compile(step, &self.target())
            .map_err(|e| RunError::Device { device: self.name(), problem: e.to_string() })?;
        let id = session.add(program)?;
        let mut best = f64::INFINITY;
        // The first round compiles.
        for round in 0..=ROUNDS {
            let begun = Instant::now();
            let seconds = match session.profile(id)? {
                Some(launches) => launches.iter().sum(),
                None => {
                    session.run(id)?;
                    session.read(id, "done")?;
                    begun.elapsed().as_secs_f64()
                }
            };
            if round > 0 {
                best = best.min(seconds);
            }
        }
        Ok(best)
    }
}

/// A buffer that is read, changed and written.
fn copy() -> Step {
    let x = Tensor::input("x", Role::State, Shape::new(&[&Axis::new("lane", LANES)], 1));
    let done = Tensor::scalar(1.0) * 1.0;
    Step { outputs: vec![("done".into(), done)], updates: vec![(x.clone(), &x * 0.5 + 1.0)] }
}

/// Independent chains of multiply-adds whose factors nobody knows when compiling, and their operations.
#[cfg(feature = "gpu")]
fn multiply_adds() -> (Step, f64) {
    const ELEMENTS: usize = 1 << 20;
    const CHAINS: usize = 8;
    const LENGTH: usize = 128;
    let element = Axis::new("element", ELEMENTS);
    let factor = |name: &str| Tensor::input(name, Role::State, Shape::new(&[], CHAINS));
    let (a, b) = (factor("a"), factor("b"));
    let mut x = Tensor::index(&element).to_f32() * &a + &b;
    for _ in 0..LENGTH {
        x = &x * &a + &b;
    }
    let outputs = vec![("done".into(), x.sum_channels().sum(&[&element]))];
    (Step { outputs, updates: vec![] }, 2.0 * (ELEMENTS * CHAINS * LENGTH) as f64)
}
