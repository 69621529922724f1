//! Planning: fused regions become a [`Program`]: ordered launches over buffers with lifetimes.
//!
//! Updates are written in place where every reader of the old value is earlier or reads only the element it replaces;
//! otherwise into a buffer of their own that a last launch copies. Temporaries whose lifetimes do not overlap share a slot.

pub mod explain;
pub mod region;
mod spec;

use crate::fuse::{Fused, Origin, Target, TargetKind, fuse};
use crate::graph::{Axes, Shape};
use crate::ops::input::Role;
use crate::simplify::simplify;
use crate::step::{Step, StepError};
use region::{BufferId, Inst, InstId, Region, RegionOp, Store};
use std::time::{Duration, Instant};

/// What a buffer is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BufferKind {
    /// Shared by name with the other programs of a session.
    Input { name: String, role: Role },
    /// Alive from its first to its last launch; temporaries of one slot share memory.
    Temporary { slot: usize },
    /// Kept for reading back.
    Output,
}

/// A buffer: lanes of 32 bits, stored channel by channel, each channel over the elements of the axes (last axis fastest).
#[derive(Clone, Debug)]
pub struct Buffer {
    pub kind: BufferKind,
    pub shape: Shape,
    /// Name for people: the input's, or what was computed and where.
    pub label: String,
}

/// One launch.
#[derive(Clone, Debug)]
pub struct Launch {
    pub name: String,
    pub region: Region,
    /// Values that an earlier launch also computes.
    pub recomputed: usize,
}

/// Time spent in each stage.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timing {
    pub simplify: Duration,
    pub fuse: Duration,
    pub plan: Duration,
}

/// An executable plan for one step.
#[derive(Clone, Debug)]
pub struct Program {
    pub target: Target,
    pub buffers: Vec<Buffer>,
    /// Size in lanes of every slot of temporaries.
    pub slots: Vec<usize>,
    pub launches: Vec<Launch>,
    pub outputs: Vec<(String, BufferId)>,
    /// Recorded ops before fusion: what an eager framework would launch.
    pub ops: usize,
    pub timing: Timing,
}

/// Simplifies, fuses and plans a step.
pub fn compile(step: &Step, target: &Target) -> Result<Program, StepError> {
    step.check()?;
    let start = Instant::now();
    let recorded = count_ops(step);
    let step = simplify(step);
    let simplified = Instant::now();
    let roots = step.roots();
    if let Some(e) = roots.iter().find_map(crate::graph::Tensor::error) {
        return Err(StepError::Record(Box::new(e.clone())));
    }
    let fused = fuse(&roots, *target);
    if target.kind == TargetKind::Gpu {
        fused.regions.iter().try_for_each(countable)?;
    }
    let fused_at = Instant::now();
    let mut program = plan(&step, fused, *target);
    program.ops = recorded;
    program.timing = Timing { simplify: simplified - start, fuse: fused_at - simplified, plan: fused_at.elapsed() };
    spec::check(&program);
    Ok(program)
}

/// Refuses a region with more elements than kernels of GPUs count.
fn countable(region: &Region) -> Result<(), StepError> {
    match region.body.last() {
        Some(last) if u32::try_from(region.domain.elements()).is_err() => {
            Err(StepError::TooManyElements { op: last.label.clone(), domain: region.domain.clone(), at: last.source })
        }
        _ => Ok(()),
    }
}

fn count_ops(step: &Step) -> usize {
    crate::graph::topological(step.roots()).iter().filter(|t| !t.inputs().is_empty()).count()
}

fn plan(step: &Step, fused: Fused, target: Target) -> Program {
    let mut buffers: Vec<Buffer> = fused.buffers.iter().map(|(origin, shape)| describe(origin, shape)).collect();
    let mut launches: Vec<Launch> = fused
        .regions
        .into_iter()
        .zip(fused.recomputed)
        .map(|(region, recomputed)| Launch { name: String::new(), region, recomputed })
        .collect();
    let (outputs, updates) = fused.roots.split_at(step.outputs.len());
    let targets: Vec<BufferId> = step.updates.iter().map(|(input, _)| input_buffer(&mut buffers, input)).collect();
    for (((_, value), source), target_buffer) in step.updates.iter().zip(updates).zip(targets.iter().copied()) {
        // The old value of an input that is itself updated is set aside first.
        let mut source = source;
        let aside;
        if targets.contains(source) && *source != target_buffer {
            let Buffer { shape, label, .. } = buffers[source.0 as usize].clone();
            buffers.push(Buffer { kind: BufferKind::Temporary { slot: 0 }, shape, label });
            aside = BufferId(buffers.len() as u32 - 1);
            launches.insert(0, copy(&buffers, *source, aside));
            source = &aside;
        }
        let taken = outputs.contains(source) || updates.iter().filter(|u| *u == source).count() > 1;
        if !taken && value.input_name().is_none() && replaces_in_place(&launches, *source, target_buffer, &buffers) {
            rename(&mut launches, *source, target_buffer);
        } else if *source != target_buffer {
            launches.push(copy(&buffers, *source, target_buffer));
        }
    }
    // An output that is an input keeps the value from before the updates only if it is copied first.
    let mut named = vec![];
    for ((name, _), source) in step.outputs.iter().zip(outputs) {
        let buffer = match &buffers[source.0 as usize].kind {
            BufferKind::Input { .. } => {
                let shape = buffers[source.0 as usize].shape.clone();
                buffers.push(Buffer { kind: BufferKind::Output, shape, label: name.clone() });
                let buffer = BufferId(buffers.len() as u32 - 1);
                launches.insert(0, copy(&buffers, *source, buffer));
                buffer
            }
            _ => {
                buffers[source.0 as usize].kind = BufferKind::Output;
                *source
            }
        };
        named.push((name.clone(), buffer));
    }
    let slots = assign_slots(&mut buffers, &launches);
    for (i, launch) in launches.iter_mut().enumerate() {
        launch.name = explain::launch_name(i, &launch.region);
    }
    Program { target, buffers, slots, launches, outputs: named, ops: 0, timing: Timing::default() }
}

fn describe(origin: &Origin, shape: &Shape) -> Buffer {
    match origin {
        Origin::Input(i) => Buffer {
            kind: BufferKind::Input { name: i.name.clone(), role: i.role },
            shape: shape.clone(),
            label: i.name.clone(),
        },
        Origin::Computed(t) => {
            let file = t.source().file().rsplit('/').next().unwrap_or_default();
            let label = format!("{} {file}:{}", t.op().name(), t.source().line());
            Buffer { kind: BufferKind::Temporary { slot: 0 }, shape: shape.clone(), label }
        }
    }
}

/// The buffer of an update's target, which nothing may read.
fn input_buffer(buffers: &mut Vec<Buffer>, input: &crate::graph::Tensor) -> BufferId {
    let Some(op) = input.op_as::<crate::ops::input::Input>() else { unreachable!("checked by Step::check") };
    let known = buffers.iter().position(|b| matches!(&b.kind, BufferKind::Input { name, .. } if *name == op.name));
    let at = known.unwrap_or_else(|| {
        buffers.push(describe(&Origin::Input(op.clone()), input.shape()));
        buffers.len() - 1
    });
    BufferId(at as u32)
}

/// Whether the launch that writes `value` may write it straight into `old`.
fn replaces_in_place(launches: &[Launch], value: BufferId, old: BufferId, buffers: &[Buffer]) -> bool {
    let Some(writer) = launches.iter().position(|l| l.region.stores.iter().any(|s| s.buffer() == value)) else {
        return false;
    };
    let region = &launches[writer].region;
    let shape = &buffers[old.0 as usize].shape;
    let whole = region.domain == shape.axes
        && shape.axes == buffers[value.0 as usize].shape.axes
        && region.stores.iter().any(|s| matches!(s, Store::Write { buffer, .. } if *buffer == value));
    // A scan looks at other elements of its line.
    let elementwise = !region.whole
        && region.body.iter().all(|i| match &i.op {
            RegionOp::Load(b) => *b != old || i.axes == region.domain,
            RegionOp::Take { table, .. } => *table != old,
            RegionOp::Linear(w) => w.buffer != old,
            _ => true,
        })
        && (region.grain != region::Grain::Lane || region.keeps_channels_of(&[old], |_| true));
    let later = launches[writer + 1..].iter().any(|l| l.region.reads().contains(&old));
    whole && elementwise && !later
}

fn rename(launches: &mut [Launch], from: BufferId, to: BufferId) {
    let new = |b: &mut BufferId| {
        if *b == from {
            *b = to;
        }
    };
    for region in launches.iter_mut().map(|l| &mut l.region) {
        for inst in &mut region.body {
            match &mut inst.op {
                RegionOp::Load(b) | RegionOp::Take { table: b, .. } => new(b),
                RegionOp::Linear(w) => new(&mut w.buffer),
                _ => {}
            }
        }
        for store in &mut region.stores {
            match store {
                Store::Write { buffer, .. }
                | Store::Reduce { buffer, .. }
                | Store::Outer { buffer, .. }
                | Store::Scatter { buffer, .. } => new(buffer),
            }
        }
    }
}

/// A launch that copies one buffer to another of the same number of channels, broadcasting over axes.
fn copy(buffers: &[Buffer], from: BufferId, to: BufferId) -> Launch {
    let (source, target) = (&buffers[from.0 as usize].shape, &buffers[to.0 as usize].shape);
    let load = Inst {
        op: RegionOp::Load(from),
        inputs: vec![],
        axes: source.axes.clone(),
        channels: source.channels.count(),
        dtype: source.dtype,
        label: "copy".into(),
        source: std::panic::Location::caller(),
    };
    let domain: Axes = target.axes.clone();
    let wide = target.channels.count() > 64;
    let region = Region {
        inner: domain.last().cloned(),
        domain,
        whole: false,
        grain: if wide { region::Grain::Lane } else { region::Grain::Row },
        body: vec![load],
        stores: vec![Store::Write { value: InstId(0), buffer: to }],
    };
    Launch { name: String::new(), region, recomputed: 0 }
}

/// Gives temporaries with disjoint lifetimes the same slot, largest first into the tightest fit.
fn assign_slots(buffers: &mut [Buffer], launches: &[Launch]) -> Vec<usize> {
    let mut first = vec![usize::MAX; buffers.len()];
    let mut last = vec![0; buffers.len()];
    for (at, launch) in launches.iter().enumerate() {
        let written = launch.region.stores.iter().map(Store::buffer);
        for b in launch.region.reads().into_iter().chain(written) {
            let b = b.0 as usize;
            first[b] = first[b].min(at);
            last[b] = last[b].max(at);
        }
    }
    let mut order: Vec<usize> =
        (0..buffers.len()).filter(|b| matches!(buffers[*b].kind, BufferKind::Temporary { .. })).collect();
    order.sort_by_key(|b| std::cmp::Reverse(buffers[*b].shape.lanes()));
    let mut slots: Vec<(usize, Vec<(usize, usize)>)> = vec![];
    for b in order {
        let span = (first[b], last[b]);
        let free = |used: &[(usize, usize)]| used.iter().all(|u| u.1 < span.0 || span.1 < u.0);
        let lanes = buffers[b].shape.lanes();
        let fit = slots.iter().enumerate().filter(|(_, s)| free(&s.1)).min_by_key(|(_, s)| s.0);
        let slot = match fit {
            Some((i, _)) => i,
            None => {
                slots.push((lanes, vec![]));
                slots.len() - 1
            }
        };
        slots[slot].1.push(span);
        buffers[b].kind = BufferKind::Temporary { slot };
    }
    slots.into_iter().map(|s| s.0).collect()
}

impl Program {
    pub fn buffer(&self, id: BufferId) -> &Buffer {
        &self.buffers[id.0 as usize]
    }
    /// Inputs with their names, roles and shapes.
    pub fn inputs(&self) -> impl Iterator<Item = (&str, Role, &Shape)> {
        self.buffers.iter().filter_map(|b| match &b.kind {
            BufferKind::Input { name, role } => Some((name.as_str(), *role, &b.shape)),
            _ => None,
        })
    }
    /// Floating-point operations of one run.
    pub fn flops(&self) -> u64 {
        self.launches.iter().map(|l| l.region.flops()).sum()
    }
}
