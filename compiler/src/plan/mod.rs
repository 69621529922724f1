//! Planning: fused regions become a [`Program`]: ordered launches over buffers with lifetimes.
//!
//! Updates are written in place where every reader of the old value is earlier or reads only the element it replaces;
//! otherwise into a buffer of their own that a last launch copies. Temporaries whose lifetimes do not overlap share a slot.

pub mod explain;
pub mod region;
mod spec;

use crate::fuse::{Fused, Origin, Target, TargetKind, fuse};
use crate::graph::{Axes, Shape, Tensor};
use crate::ops::input::{Input, Role};
use crate::simplify::simplify;
use crate::step::{Step, StepError};
use region::{BufferId, Inst, InstId, Region, RegionOp, Store};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;
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
    let targets = input_buffers(&mut buffers, step);
    let updated: HashSet<BufferId> = targets.iter().copied().collect();
    let mut roots: HashMap<BufferId, usize> = HashMap::new();
    fused.roots.iter().for_each(|root| *roots.entry(*root).or_default() += 1);
    let (outputs, updates) = fused.roots.split_at(step.outputs.len());
    let accesses = Accesses::of(&fused.regions);
    let mut renamed: HashMap<BufferId, BufferId> = HashMap::new();
    // Copies that come before all other launches, the last one first, and those that come after them.
    let (mut before, mut after) = (vec![], vec![]);
    for (((_, value), source), target) in step.updates.iter().zip(updates).zip(targets) {
        // The old value of an input that is itself updated is set aside first.
        let mut source = *source;
        if updated.contains(&source) && source != target {
            let Buffer { shape, label, .. } = buffers[source.0 as usize].clone();
            buffers.push(Buffer { kind: BufferKind::Temporary { slot: 0 }, shape, label });
            let aside = BufferId(buffers.len() as u32 - 1);
            before.push(copy(&buffers, source, aside));
            source = aside;
        }
        let computed = value.input_name().is_none() && roots.get(&source) == Some(&1);
        if computed && replaces_in_place(&fused.regions, &accesses, source, target, &buffers) {
            renamed.insert(source, target);
        } else if source != target {
            after.push(copy(&buffers, source, target));
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
                before.push(copy(&buffers, *source, buffer));
                buffer
            }
            _ => {
                buffers[source.0 as usize].kind = BufferKind::Output;
                *source
            }
        };
        named.push((name.clone(), buffer));
    }
    let fused_launches = fused.regions.into_iter().zip(fused.recomputed).map(|(mut region, recomputed)| {
        region.buffers_mut().for_each(|b| *b = renamed.get(b).copied().unwrap_or(*b));
        Launch { name: String::new(), region, recomputed }
    });
    let mut launches: Vec<Launch> = before.into_iter().rev().chain(fused_launches).chain(after).collect();
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

/// The buffers of the updates' targets, some of which nothing may read.
fn input_buffers(buffers: &mut Vec<Buffer>, step: &Step) -> Vec<BufferId> {
    let name = |b: &Buffer| if let BufferKind::Input { name, .. } = &b.kind { Some(name.clone()) } else { None };
    let known = buffers.iter().enumerate().filter_map(|(at, b)| Some((name(b)?, BufferId(at as u32))));
    let known: HashMap<String, BufferId> = known.collect();
    let target = |(input, _): &(Tensor, Tensor)| {
        let Some(op) = input.op_as::<Input>() else { unreachable!("checked by Step::check") };
        known.get(&op.name).copied().unwrap_or_else(|| {
            buffers.push(describe(&Origin::Input(op.clone()), input.shape()));
            BufferId(buffers.len() as u32 - 1)
        })
    };
    step.updates.iter().map(target).collect()
}

/// Which regions touch a buffer, by their number.
struct Accesses {
    /// Who writes it element by element.
    writer: HashMap<BufferId, usize>,
    last_reader: HashMap<BufferId, usize>,
    /// Buffers of which a region reads other elements or channels than those it is about to write.
    elsewhere: HashSet<(usize, BufferId)>,
}

impl Accesses {
    fn of(regions: &[Region]) -> Accesses {
        let mut all = Accesses { writer: HashMap::new(), last_reader: HashMap::new(), elsewhere: HashSet::new() };
        for (at, region) in regions.iter().enumerate() {
            let written = region.stores.iter().filter(|s| matches!(s, Store::Write { .. }));
            all.writer.extend(written.map(|s| (s.buffer(), at)));
            all.last_reader.extend(region.reads().into_iter().map(|b| (b, at)));
            if region.grain == region::Grain::Lane {
                all.elsewhere.extend(region.mixed(|_| true).into_iter().map(|b| (at, b)));
            }
            let elsewhere = region.body.iter().filter_map(|i| match &i.op {
                // A scan looks at other elements of its line.
                RegionOp::Load(b) => (region.whole || i.axes != region.domain).then_some(*b),
                op => op.buffer(),
            });
            all.elsewhere.extend(elsewhere.map(|b| (at, b)));
        }
        all
    }
}

/// Whether the region that writes `value` may write it straight into `old`.
fn replaces_in_place(
    regions: &[Region],
    accesses: &Accesses,
    value: BufferId,
    old: BufferId,
    buffers: &[Buffer],
) -> bool {
    let Some(writer) = accesses.writer.get(&value) else { return false };
    let region = &regions[*writer];
    let [shape, new] = [old, value].map(|b| &buffers[b.0 as usize].shape);
    let whole = region.domain == shape.axes && shape.axes == new.axes;
    let later = accesses.last_reader.get(&old).is_some_and(|reader| reader > writer);
    whole && !later && !accesses.elsewhere.contains(&(*writer, old))
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

/// The slots that a lifetime has not met yet: one that is taken stays so.
#[derive(Default)]
struct Untried {
    /// Slots there were when it last looked.
    seen: usize,
    /// Those of one size together.
    ranges: Vec<Range<usize>>,
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
    let mut order: Vec<usize> = (0..buffers.len())
        .filter(|b| matches!(buffers[*b].kind, BufferKind::Temporary { .. }) && first[*b] <= last[*b])
        .collect();
    order.sort_by_key(|b| std::cmp::Reverse(buffers[*b].shape.lanes()));
    // Size of every slot, and the lifetimes in it, first to last launch.
    let mut slots: Vec<(usize, BTreeMap<usize, usize>)> = vec![];
    let mut untried: HashMap<(usize, usize), Untried> = HashMap::new();
    for b in order {
        let span = (first[b], last[b]);
        let free = |slot: usize| slots[slot].1.range(..=span.1).next_back().is_none_or(|(_, end)| *end < span.0);
        let Untried { seen, ranges } = untried.entry(span).or_default();
        for slot in *seen..slots.len() {
            match ranges.last_mut() {
                Some(range) if range.end == slot && slots[range.start].0 == slots[slot].0 => range.end += 1,
                _ => ranges.push(slot..slot + 1),
            }
        }
        *seen = slots.len();
        // Younger slots are never larger.
        let mut fit = None;
        while let (None, Some(range)) = (fit, ranges.last_mut()) {
            match range.next() {
                Some(slot) => fit = free(slot).then_some(slot),
                None => drop(ranges.pop()),
            }
        }
        let slot = fit.unwrap_or_else(|| {
            slots.push((buffers[b].shape.lanes(), BTreeMap::new()));
            slots.len() - 1
        });
        slots[slot].1.insert(span.0, span.1);
        buffers[b].kind = BufferKind::Temporary { slot };
    }
    // What is written straight into the input it replaces has a buffer that no launch touches: it stays in the first slot.
    let none = slots.is_empty();
    let sizes = slots.into_iter().map(|s| s.0);
    sizes.chain(none.then_some(1)).collect()
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

#[cfg(test)]
mod tests {
    use super::compile;
    use crate::{Axis, Program, Shape, Step, Target, Tensor};

    fn plan(updates: Vec<(Tensor, Tensor)>) -> Program {
        compile(&Step { outputs: vec![], updates }, &Target::cpu()).unwrap()
    }

    /// What is computed straight into a parameter takes no memory besides, alone or where others share a slot.
    #[test]
    fn updates_in_place_take_no_memory() {
        let [p, q] = [("p", 5000), ("q", 7)].map(|(name, width)| Tensor::parameter(name, Shape::new(&[], width)));
        let halved = (p.clone(), &p * 0.5);
        assert!(plan(vec![halved.clone()]).slots.iter().sum::<usize>() <= 1);
        let row = Axis::new("row", 100);
        let x = Tensor::data("x", Shape::new(&[&row], 7));
        let program = plan(vec![halved, (q.clone(), &q - (&x * &q).sin().sum(&[&row]))]);
        assert_eq!(program.slots, [7]);
    }

    /// Lines that are computed whole may replace what is not read along them.
    #[test]
    fn scans_of_others_replace_in_place() {
        let row = Axis::new("row", 300);
        let [s, x] = ["s", "x"].map(|name| Tensor::parameter(name, Shape::new(&[&row], 1)));
        assert_eq!(plan(vec![(s.clone(), x.cumsum(&row))]).launches.len(), 1);
        assert_eq!(plan(vec![(s.clone(), s.cumsum(&row))]).launches.len(), 2);
    }
}
