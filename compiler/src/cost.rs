//! What work takes on a device: the cost model by which fusion stores values or computes them again, forms of kernels are
//! chosen, and `explain` says how long a launch should take.
//!
//! A launch takes as long as its arithmetic or its bytes, whichever is more, each at the share of the device's best rate that
//! such kernels reach, and what starting it takes.

use crate::fuse::{Target, TargetKind};
use crate::plan::Program;
use crate::plan::region::{BufferId, Grain, Region, Store};
use std::fmt;

/// What a device does at best.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rates {
    /// 10^9 operations a second of multiply-adds in single precision, two each.
    pub gflops: u32,
    /// The same of what matrix products are made of: more where a device has matrices of halves and is to use them.
    pub product_gflops: u32,
    /// 10^6 bytes a second to and from memory.
    pub mbytes: u32,
    /// Nanoseconds of a launch that waits for the one before it and does nothing.
    pub launch_ns: u32,
    /// Workgroups that keep all of a GPU's processors busy.
    pub workgroups: u32,
}

impl Rates {
    /// Of two cores with AVX-512. The CPU's are not measured: the same step has the same bits on all of them.
    pub const CPU: Rates = Rates { gflops: 300, product_gflops: 300, mbytes: 15_000, launch_ns: 10_000, workgroups: 1 };
    /// Of a large GPU, for who has not measured one.
    pub const GPU: Rates =
        Rates { gflops: 49_000, product_gflops: 620_000, mbytes: 3_500_000, launch_ns: 3_000, workgroups: 128 };
    /// Of a driver that computes on a CPU, which are not measured either: tiles reach less than its multiply-adds, since lanes of a
    /// vector read one by one. More workgroups than cores, which then end together.
    pub const SOFTWARE: Rates =
        Rates { gflops: 64, product_gflops: 6, mbytes: 4_000, launch_ns: 50_000, workgroups: 16 };

    /// The same where nothing is multiplied in matrices of halves.
    pub const fn single(self) -> Rates {
        let least = if self.product_gflops < self.gflops { self.product_gflops } else { self.gflops };
        Rates { product_gflops: least, ..self }
    }

    /// The nearest of 1, 1.5, 2, 3, 4, 6 and so on, at least 1: what is measured twice should be the same.
    pub fn rounded(measured: f64) -> u32 {
        let halves = (2.0 * measured.max(1.0).log2()).round().min(61.0) as u32;
        (if halves.is_multiple_of(2) { 2 } else { 3 }) << (halves / 2) >> 1
    }
}

impl fmt::Display for Rates {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} GFLOP/s", self.gflops)?;
        if self.product_gflops != self.gflops {
            write!(f, " ({} of matrices)", self.product_gflops)?;
        }
        write!(f, ", {} GB/s, {} us a launch", f64::from(self.mbytes) * 1e-3, f64::from(self.launch_ns) * 1e-3)
    }
}

/// Arithmetic to be done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Operations of matrix products, two a multiply-add.
    pub products: u64,
    /// Instructions of everything else.
    pub others: u64,
}

impl Work {
    /// Of so many multiply-adds of matrix products.
    pub fn products(multiply_adds: usize) -> Work {
        Work { products: 2 * multiply_adds as u64, others: 0 }
    }
    pub fn others(instructions: u64) -> Work {
        Work { products: 0, others: instructions }
    }
    pub fn flops(&self) -> u64 {
        self.products + self.others
    }
}

impl std::ops::Add for Work {
    type Output = Work;
    fn add(self, other: Work) -> Work {
        Work { products: self.products + other.products, others: self.others + other.others }
    }
}

impl std::ops::Mul<u64> for Work {
    type Output = Work;
    fn mul(self, times: u64) -> Work {
        Work { products: self.products * times, others: self.others * times }
    }
}

impl std::iter::Sum for Work {
    fn sum<I: Iterator<Item = Work>>(all: I) -> Work {
        all.fold(Work::default(), |a, b| a + b)
    }
}

/// Share of its best that a device's memory gives a kernel; like the other shares here measured (docs/measured.md).
const BYTES: f64 = 0.8;

impl Target {
    /// Seconds that arithmetic takes.
    pub fn seconds_of(&self, work: Work, grain: Grain) -> f64 {
        let [single, best] = [self.rates.gflops, self.rates.product_gflops].map(f64::from);
        let products = match (self.kind, grain) {
            (TargetKind::Cpu, _) => 0.8 * best,
            // In single precision. A multiply-add takes as many bytes of workgroup memory as a processor reads in the time of
            // three; not measured.
            (_, Grain::Tile) => 0.35 * single.min(best),
            _ if best > single => 0.23 * best,
            _ => 0.8 * best,
        };
        // An instruction takes the place of a multiply-add; a CPU passes its lanes through the first cache.
        let others = if self.kind == TargetKind::Cpu { 0.1 * single } else { 0.25 * single };
        (work.products as f64 / products + work.others as f64 / others) * 1e-9
    }

    /// Seconds that bytes take to or from memory.
    pub fn seconds_of_bytes(&self, bytes: u64) -> f64 {
        bytes as f64 / (BYTES * f64::from(self.rates.mbytes)) * 1e-6
    }

    /// Seconds of a launch that does nothing.
    pub fn seconds_of_start(&self) -> f64 {
        1e-9 * f64::from(self.rates.launch_ns)
    }

    /// Seconds that a launch should take that moves so many bytes.
    fn seconds_of_launch(&self, region: &Region, bytes: u64) -> f64 {
        // What is summed over rows is summed in parts first.
        let parts = self.kind == TargetKind::Gpu && region.stores.iter().any(|s| !matches!(s, Store::Write { .. }));
        let starts = self.seconds_of_start() * if parts { 2.0 } else { 1.0 };
        starts + self.seconds_of(region.work(), region.grain).max(self.seconds_of_bytes(bytes))
    }
}

impl Program {
    /// Seconds that every launch should take where a lane of a buffer has so many bytes.
    pub fn predicted(&self, of_lane: impl Fn(BufferId) -> u64) -> Vec<f64> {
        let one = |i: usize| self.target.seconds_of_launch(&self.launches[i].region, self.launch_bytes_of(i, &of_lane));
        (0..self.launches.len()).map(one).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, Shape, Step, Tensor, compile};

    #[test]
    fn rates_are_rounded() {
        let all = [0.2, 1.0, 1.3, 1.8, 2.6, 132.0, 49_100.0, 620_000.0].map(Rates::rounded);
        assert_eq!(all, [1, 1, 1, 2, 3, 128, 49_152, 524_288]);
    }

    /// A launch takes what its products take, or its bytes, and never less than its start.
    #[test]
    fn a_launch_is_bound_by_the_slower_of_two() {
        let seconds = |rows: usize, width: usize, rates: Rates| {
            let x = Tensor::data("x", Shape::new(&[&Axis::new("row", rows)], width));
            let y = x.linear(&Tensor::parameter("w", Shape::new(&[], (width, width))));
            let target = Target { rates, ..Target::gpu() };
            let program = compile(&Step { outputs: vec![("y".into(), y)], updates: vec![] }, &target).unwrap();
            program.predicted(|_| 4).iter().sum::<f64>()
        };
        let rates = Rates { gflops: 1000, product_gflops: 1000, mbytes: 100_000, launch_ns: 1000, workgroups: 128 };
        let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 0.05, "{found} {expected}");
        near(seconds(1 << 20, 256, rates), (1u64 << 20) as f64 * 2.0 * 65536.0 / 0.8e12);
        near(seconds(1 << 20, 16, rates), (1u64 << 20) as f64 * 2.0 * 64.0 / 0.8e11);
        near(seconds(1, 4, rates), 1e-6);
        let halves = Rates { product_gflops: 8000, ..rates };
        near(seconds(1 << 20, 256, halves), (1u64 << 20) as f64 * 2.0 * 65536.0 / 1.84e12);
    }
}
