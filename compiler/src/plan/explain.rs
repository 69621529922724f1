//! The page `explain` prints: every launch with what is fused, stored, recomputed, FLOPs and bytes, and where a device was
//! asked, what it takes there.

use super::region::{BufferId, Region, RegionOp, Store};
use super::{BufferKind, Program};
use std::collections::BTreeMap;
use std::fmt;

/// What a device did with the launches of a program, and what it does at best.
#[derive(Clone, Debug)]
pub struct Measured {
    /// Of every launch, by the device's clock.
    pub seconds: Vec<f64>,
    /// 10^9 operations a second.
    pub gflops: f64,
    /// 10^9 bytes a second to and from memory.
    pub gbytes: f64,
}

/// A name that says what dominates the launch: `03_frame.pixel_linear`.
pub(super) fn launch_name(index: usize, region: &Region) -> String {
    let axes: Vec<&str> = region.domain.iter().map(|a| a.name()).collect();
    let domain = if axes.is_empty() { "once".to_string() } else { axes.join(".") };
    let kind = |op: &RegionOp| match op {
        RegionOp::Linear(_) | RegionOp::RowLinear { .. } => 5,
        RegionOp::SymEig { .. } => 4,
        RegionOp::CumSum { .. } | RegionOp::Shift { .. } | RegionOp::RowReduce(_) => 3,
        RegionOp::Map(_) => 2,
        _ => 1,
    };
    let main = match region.body.iter().map(|i| kind(&i.op)).max() {
        Some(5) => "layers",
        Some(4) => "eigen",
        Some(3) => "scan",
        Some(2) => "map",
        _ => "copy",
    };
    let reduces = region.stores.iter().any(|s| !matches!(s, Store::Write { .. }));
    format!("{index:02}_{domain}_{main}{}", if reduces { "_reduce" } else { "" })
}

impl Program {
    /// Bytes a launch moves to and from memory: every buffer it touches, once.
    pub fn launch_bytes(&self, index: usize) -> u64 {
        self.launch_bytes_of(index, |_| 4)
    }

    /// The same where a lane of a buffer has so many bytes.
    pub fn launch_bytes_of(&self, index: usize, of_lane: impl Fn(BufferId) -> u64) -> u64 {
        let region = &self.launches[index].region;
        let written = region.stores.iter().map(|s| s.buffer());
        region.reads().into_iter().chain(written).map(|b| of_lane(b) * self.buffer(b).shape.lanes() as u64).sum()
    }

    /// Bytes of all buffers, temporaries of one slot counted once.
    pub fn memory_bytes(&self) -> u64 {
        self.memory_bytes_of(|_| 4)
    }

    /// The same where a lane of a buffer has so many bytes.
    fn memory_bytes_of(&self, of_lane: impl Fn(BufferId) -> u64) -> u64 {
        let (mut own, mut slots) = (0, vec![0; self.slots.len()]);
        for (i, b) in self.buffers.iter().enumerate() {
            let bytes = of_lane(BufferId(i as u32)) * b.shape.lanes() as u64;
            match b.kind {
                BufferKind::Temporary { slot } => slots[slot] = bytes.max(slots[slot]),
                _ => own += bytes,
            }
        }
        own + slots.iter().sum::<u64>()
    }

    /// The page that explains the program where a lane of a buffer has so many bytes.
    pub fn explained(&self, of_lane: impl Fn(BufferId) -> u64, measured: Option<&Measured>) -> String {
        let mut text = String::new();
        // Text takes all that is written to it.
        let _ = self.explain(&mut text, &of_lane, measured);
        text
    }

    fn explain(
        &self,
        f: &mut dyn fmt::Write,
        of_lane: &dyn Fn(BufferId) -> u64,
        measured: Option<&Measured>,
    ) -> fmt::Result {
        writeln!(
            f,
            "{} launches from {} recorded ops, {:.3} GFLOP, {:.2} MB in buffers, target {:?}",
            self.launches.len(),
            self.ops,
            self.flops() as f64 * 1e-9,
            self.memory_bytes_of(of_lane) as f64 * 1e-6,
            self.target.kind,
        )?;
        let predicted = self.predicted(of_lane);
        writeln!(f, "predicted: {:.3} ms on a device of {}", 1e3 * predicted.iter().sum::<f64>(), self.target.rates)?;
        if let Some(Measured { seconds, gflops, gbytes }) = measured {
            let all = 1e3 * seconds.iter().sum::<f64>();
            writeln!(f, "measured: {all:.3} ms; at best {gflops:.0} GFLOP/s and {gbytes:.1} GB/s")?;
        }
        for (i, launch) in self.launches.iter().enumerate() {
            let region = &launch.region;
            writeln!(f, "\n{}  over {}", launch.name, region.domain)?;
            let (flops, bytes) = (region.flops() as f64 * 1e-6, self.launch_bytes_of(i, of_lane) as f64 * 1e-6);
            writeln!(f, "  {flops:.3} MFLOP, {bytes:.3} MB, {:.1} us predicted", 1e6 * predicted[i])?;
            if let Some(Measured { seconds, gflops, gbytes }) = measured {
                let time = seconds[i].max(1e-9);
                let [flops, bytes] = [flops, bytes].map(|mega| 1e-3 * mega / time);
                let [of_flops, of_bytes] = [flops / gflops, bytes / gbytes].map(|share| 100.0 * share);
                write!(f, "  {:.1} us measured, ", 1e6 * seconds[i])?;
                writeln!(f, "{flops:.1} GFLOP/s ({of_flops:.0} %), {bytes:.1} GB/s ({of_bytes:.0} %)")?;
            }
            writeln!(f, "  fused: {}", fused(region))?;
            if launch.recomputed > 0 {
                writeln!(f, "  recomputed: {} values of earlier launches", launch.recomputed)?;
            }
            for b in region.reads() {
                writeln!(f, "  reads   b{} {}", b.0, self.describe(b))?;
            }
            for s in &region.stores {
                let how = match s {
                    Store::Write { .. } => "writes ",
                    Store::Reduce { kind: crate::ops::Reduction::Sum, .. } => "sums   ",
                    Store::Reduce { kind: crate::ops::Reduction::Max, .. } => "maxima ",
                    Store::Outer { .. } => "outer  ",
                    Store::Scatter { .. } => "scatter",
                };
                writeln!(f, "  {how} b{} {}", s.buffer().0, self.describe(s.buffer()))?;
            }
        }
        Ok(())
    }

    fn describe(&self, id: super::BufferId) -> String {
        let b = self.buffer(id);
        let kind = match &b.kind {
            BufferKind::Input { role, .. } => format!("{role:?}").to_lowercase(),
            BufferKind::Temporary { slot } => format!("slot {slot}"),
            BufferKind::Output => "output".into(),
        };
        format!("{} ({}, {kind})", b.label, b.shape)
    }
}

impl fmt::Display for Program {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        self.explain(f, &|_| 4, None)
    }
}

/// The region's instructions, counted by name in order of first appearance.
fn fused(region: &Region) -> String {
    let mut order: Vec<String> = vec![];
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    for inst in &region.body {
        let name = match &inst.op {
            RegionOp::Load(_) | RegionOp::Const(_) => continue,
            RegionOp::Linear(w) => format!("{}({}x{})", inst.label, w.rows, w.columns),
            _ => inst.label.clone(),
        };
        if !count.contains_key(&name) {
            order.push(name.clone());
        }
        *count.entry(name).or_default() += 1;
    }
    let list = order.iter().map(|n| if count[n] > 1 { format!("{n} x{}", count[n]) } else { n.clone() });
    list.collect::<Vec<_>>().join(", ")
}
