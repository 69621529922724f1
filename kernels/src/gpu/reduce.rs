//! Sums and maxima over axes, in a fixed order, without atomics.
//!
//! Few rows: an invocation a result runs over them. Many rows: a workgroup takes a chunk of them, its invocations every
//! 64th row each (or every 64th four rows), and combines through workgroup memory; a second kernel combines the chunks.

use super::builder::{Builder, Kind, Memory, Value, Var};
use super::channels::is_indexable;
use super::chunks::{End, finish};
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, WORKGROUP};
use super::position::{Position, is_run};
use super::scalar::larger;
use super::{Kernel, LowerError};
use raygrad_compiler::graph::{Axes, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;

/// Most channels that one invocation accumulates.
const MAX_CHANNELS: usize = 64;
/// Rows up to which one invocation sums alone.
const FEW_ROWS: usize = 64;
/// Rows of a chunk, at least.
const CHUNK_ROWS: usize = 2048;
/// The same where each invocation takes four rows at a time, and results alone fill a device.
const CHUNK_ROWS_OF_FOURS: usize = 8192;
/// Parts in which a workgroup's sums are combined.
const EIGHTHS: u32 = 8;
/// Chunks, at most.
pub(super) const MAX_CHUNKS: usize = 256;

/// Combines two values.
pub(super) fn combine(b: &mut Builder, kind: Reduction, so_far: Value, next: Value) -> Value {
    match kind {
        Reduction::Sum => b.add(so_far, next),
        Reduction::Max => larger(b, so_far, next),
    }
}

/// Combines values in order; of none, what combining starts from.
pub(super) fn combine_all(b: &mut Builder, kind: Reduction, values: &[Value]) -> Value {
    let Some((first, others)) = values.split_first() else { return neutral(b, kind) };
    others.iter().fold(*first, |so_far, next| combine(b, kind, so_far, *next))
}

/// `count` lanes of a memory from `first` on, `every` apart, combined in order.
pub(super) fn combine_lanes(
    e: &mut Emit,
    kind: Reduction,
    memory: Memory,
    first: Value,
    (count, every): (u32, u32),
) -> Value {
    let mut all = vec![];
    for i in 0..count {
        let offset = e.b.u(i * every);
        let at = e.b.add(first, offset);
        all.push(e.b.load_lane(memory, at));
    }
    combine_all(&mut e.b, kind, &all)
}

/// What combining starts from.
pub(super) fn neutral(b: &mut Builder, kind: Reduction) -> Value {
    match kind {
        Reduction::Sum => b.f(0.0),
        Reduction::Max => b.f(f32::NEG_INFINITY),
    }
}

/// A result of the kernel: a channel of a store's buffer, or with `lanes`, all of them.
struct Target {
    store: usize,
    kind: Reduction,
    channel: u32,
}

/// Kernels for a region whose stores all reduce to buffers of the same axes.
pub(super) fn kernels(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
) -> Result<Vec<Kernel>, LowerError> {
    // By lane where channels are many: channels are then a dimension of the dispatch.
    let mut narrow: Vec<Target> = vec![];
    let mut groups: Vec<(bool, Vec<Target>)> = vec![];
    for (store, s) in region.stores.iter().enumerate() {
        let Store::Reduce { kind, value, .. } = s else { continue };
        let channels = region.inst(*value).channels;
        if channels > MAX_CHANNELS && is_indexable(region, *value) {
            groups.push((true, vec![Target { store, kind: *kind, channel: 0 }]));
        } else {
            narrow.extend((0..channels as u32).map(|channel| Target { store, kind: *kind, channel }));
        }
    }
    while !narrow.is_empty() {
        let rest = narrow.split_off(narrow.len().min(MAX_CHANNELS));
        groups.push((false, std::mem::replace(&mut narrow, rest)));
    }
    let several = groups.len() > 1;
    let mut all = vec![];
    for (i, (by_lane, targets)) in groups.iter().enumerate() {
        let name = if several { format!("{name}.{}", i + 1) } else { name.to_string() };
        all.extend(group(layout, limits, &name, region, targets, *by_lane)?);
    }
    Ok(all)
}

fn group(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
    targets: &[Target],
    by_lane: bool,
) -> Result<Vec<Kernel>, LowerError> {
    let keep = layout.shape(region.stores[targets[0].store].buffer()).axes.clone();
    let over = region.domain.minus(&keep);
    let (kept, rows) = (keep.elements(), over.elements());
    let channels = if by_lane { region.inst(region.stores[targets[0].store].values()[0]).channels } else { 1 };
    let results = kept * channels;
    let fours = in_fours(layout, region, &over);
    let work = Reducer { region, targets, by_lane, keep, over, channels, fours };
    // Half of what fills a device is enough for invocations that sum alone.
    let many = limits.invocations() / 2;
    if rows <= FEW_ROWS || results >= many && rows < 32768 {
        return Ok(vec![work.alone(layout, limits, name)?]);
    }
    let chunk_rows = if fours && results >= FEW_ROWS { CHUNK_ROWS_OF_FOURS } else { CHUNK_ROWS };
    let chunks = rows.div_ceil(chunk_rows).min(MAX_CHUNKS.min((many * 16).div_ceil(results)).max(1));
    let per_chunk = rows.div_ceil(chunks).next_multiple_of(WORKGROUP as usize);
    let chunks = rows.div_ceil(per_chunk);
    if chunks == 1 {
        return Ok(vec![work.chunked(layout, limits, name, per_chunk, 1, None)?]);
    }
    let lanes = chunks * results * targets.len();
    let partials = layout.scratch("partial", Shape::of(Axes::none(), lanes, DType::F32))?;
    let first = work.chunked(layout, limits, name, per_chunk, chunks, Some(partials))?;
    let mut ends = vec![];
    for t in targets {
        let first = if by_lane { 0 } else { t.channel as usize * kept };
        ends.push(End { buffer: region.stores[t.store].buffer(), first, lanes: results, lines: None, kind: t.kind });
    }
    let last = finish(layout, limits, &format!("{name}.finish"), partials, chunks, &ends)?;
    Ok(vec![first, last])
}

/// Whether a region's values can be computed at four neighbouring rows at once, most of them with one load.
fn in_fours(layout: &Layout, region: &Region, over: &Axes) -> bool {
    use RegionOp::{Const, Index, Load, Map, Pick, RowOuter};
    let simple = |op: &RegionOp| matches!(op, Load(_) | Const(_) | Map(_) | Pick(_) | RowOuter | Index(_));
    let run = |op: &RegionOp| matches!(op, Load(b) if is_run(&layout.shape(*b).axes, over));
    over.elements().is_multiple_of(4)
        && region.body.iter().all(|i| simple(&i.op) && i.dtype == DType::F32)
        && region.body.iter().any(|i| run(&i.op))
}

struct Reducer<'r> {
    region: &'r Region,
    targets: &'r [Target],
    by_lane: bool,
    keep: Axes,
    over: Axes,
    /// Channels that are a dimension of the dispatch.
    channels: usize,
    /// Whether invocations take four rows at a time.
    fours: bool,
}

impl Reducer<'_> {
    /// A total a target; in fours, of every fourth row each.
    fn start(&self, e: &mut Emit) -> Vec<Var> {
        let mut all = vec![];
        for t in self.targets {
            let first = neutral(&mut e.b, t.kind);
            let first = if self.fours { e.b.splat(first) } else { first };
            all.push(e.b.var("total", first));
        }
        all
    }

    /// Adds the values at one row, or in fours at four.
    fn step(&self, e: &mut Emit, totals: &[Var], (kept, channel, row): (Value, Value, Value)) {
        let position = |row| Position::new(&self.keep, kept).and(&self.over, row);
        let mut values = Values::from(e, self.region, (&self.over, row, self.fours), position);
        for (t, total) in self.targets.iter().zip(totals) {
            let id = self.region.stores[t.store].values()[0];
            let c = if self.by_lane { Channel::Var(channel) } else { Channel::At(t.channel) };
            let next = values.channel(e, id, c);
            let so_far = e.b.get(*total);
            let next = combine(&mut e.b, t.kind, so_far, next);
            let next = if self.fours { e.b.splat(next) } else { next };
            e.b.set(*total, next);
        }
    }

    /// Rows that an invocation takes at a time.
    fn each(&self) -> u32 {
        if self.fours { 4 } else { 1 }
    }

    /// What an invocation found for a target.
    fn total(&self, e: &mut Emit, target: &Target, total: Var) -> Value {
        let value = e.b.get(total);
        if !self.fours {
            return value;
        }
        let lanes = [0, 1, 2, 3].map(|i| e.b.component(value, i));
        combine_all(&mut e.b, target.kind, &lanes)
    }

    fn buffer(&self, t: &Target) -> BufferId {
        self.region.stores[t.store].buffer()
    }

    /// Lane of a target's result.
    fn index(&self, e: &mut Emit, t: &Target, kept: Value, channel: Value) -> Value {
        let channel = if self.by_lane { channel } else { e.b.u(t.channel) };
        e.index(self.buffer(t), channel, kept)
    }

    /// An invocation a result.
    fn alone(&self, layout: &Layout, limits: Limits, name: &str) -> Result<Kernel, LowerError> {
        let kept_elements = self.keep.elements() as u32;
        let (e, number) = Emit::over(layout, limits, kept_elements as u64 * self.channels as u64)?;
        let mut e = e.with_vectors(self.fours);
        let per_channel = e.b.u(kept_elements);
        let (channel, kept) = (e.b.div(number, per_channel), e.b.rem(number, per_channel));
        let totals = self.start(&mut e);
        let (from, to) = (e.b.u(0), e.b.u(self.over.elements() as u32));
        let row = e.b.open_loop("row", from, to, self.each());
        self.step(&mut e, &totals, (kept, channel, row));
        e.b.close_loop();
        for (t, total) in self.targets.iter().zip(&totals) {
            let value = self.total(&mut e, t, *total);
            let at = self.index(&mut e, t, kept, channel);
            e.store(self.buffer(t), at, value);
        }
        e.finish(name)
    }

    /// A workgroup a chunk of rows. Results go to `partials`, chunk by chunk and target by target, or to the buffers.
    fn chunked(
        &self,
        layout: &Layout,
        limits: Limits,
        name: &str,
        per_chunk: usize,
        chunks: usize,
        partials: Option<BufferId>,
    ) -> Result<Kernel, LowerError> {
        let (kept_elements, rows) = (self.keep.elements(), self.over.elements());
        let results = kept_elements * self.channels;
        let mut e = Emit::new(layout, limits, (chunks * results) as u64, WORKGROUP)?.with_vectors(self.fours);
        if e.spare_workgroups() {
            e.leave_from(e.workgroup, (chunks * results) as u32);
        }
        let (results_value, per_channel) = (e.b.u(results as u32), e.b.u(kept_elements as u32));
        let (chunk, result) = (e.b.div(e.workgroup, results_value), e.b.rem(e.workgroup, results_value));
        let (channel, kept) = (e.b.div(result, per_channel), e.b.rem(result, per_channel));
        let totals = self.start(&mut e);
        let length = e.b.u(per_chunk as u32);
        let first = e.b.mul(chunk, length);
        let end = e.b.add(first, length);
        let all = e.b.u(rows as u32);
        let end = if rows.is_multiple_of(per_chunk) { end } else { e.b.math(naga::MathFunction::Min, &[end, all]) };
        let each_value = e.b.u(self.each());
        let own = e.b.mul(e.invocation, each_value);
        let own = e.b.add(first, own);
        let row = e.b.open_loop("row", own, end, self.each() * WORKGROUP);
        self.step(&mut e, &totals, (kept, channel, row));
        e.b.close_loop();

        let count = self.targets.len() as u32;
        let found = e.b.workgroup("found", Kind::F32, false, count * WORKGROUP);
        for (i, total) in totals.iter().enumerate() {
            let value = self.total(&mut e, &self.targets[i], *total);
            let first = e.b.u(i as u32 * WORKGROUP);
            let at = e.b.add(e.invocation, first);
            e.b.store(found, at, value);
        }
        e.b.barrier();

        // Of few targets, eight invocations each sum an eighth of what the workgroup's 64 found; then, or at once, one each
        // sums the rest. The code is shared by targets that follow each other, because drivers take long over many copies of
        // a loop.
        let one_kind = self.targets.iter().all(|t| t.kind == self.targets[0].kind);
        let several = one_kind && count * EIGHTHS <= WORKGROUP;
        if several {
            let (length, busy) = (e.b.u(WORKGROUP / EIGHTHS), e.b.u(count * EIGHTHS));
            let first = e.b.mul(e.invocation, length);
            let mine = e.b.less(e.invocation, busy);
            e.b.open_if(mine);
            let total = self.combined(&mut e, found, first, WORKGROUP / EIGHTHS, self.targets[0].kind);
            e.b.store(found, first, total);
            e.b.close_if();
            e.b.barrier();
        }
        let size = e.b.u(WORKGROUP);
        let own = e.b.mul(e.invocation, size);
        let mut begin = 0;
        while begin < self.targets.len() {
            let t = &self.targets[begin];
            let alike = |u: &&Target| u.kind == t.kind && (u.store == t.store || partials.is_some());
            let end = begin + self.targets[begin..].iter().take_while(alike).count();
            let (from, to) = (e.b.u(begin as u32), e.b.u(end as u32));
            let mut mine = e.b.less(e.invocation, to);
            if begin > 0 {
                let reached = e.b.binary(naga::BinaryOperator::GreaterEqual, e.invocation, from);
                mine = e.b.and(reached, mine);
            }
            e.b.open_if(mine);
            let total = match several {
                true => self.spread(&mut e, found, own, t.kind),
                false => self.combined(&mut e, found, own, WORKGROUP, t.kind),
            };
            match partials {
                Some(partials) => {
                    let count = e.b.u(count);
                    let block = e.b.mul(chunk, count);
                    let block = e.b.add(block, e.invocation);
                    let block = e.b.mul(block, results_value);
                    let at = e.b.add(block, result);
                    e.store(partials, at, total);
                }
                None => {
                    // Channels of a store's targets follow each other.
                    let (ahead, first) = (e.b.sub(e.invocation, from), e.b.u(t.channel));
                    let own = e.b.add(ahead, first);
                    let at = e.index(self.buffer(t), if self.by_lane { channel } else { own }, kept);
                    e.store(self.buffer(t), at, total);
                }
            }
            e.b.close_if();
            begin = end;
        }
        e.finish(name)
    }

    /// The first values of the eighths of a target's 64, combined in order.
    fn spread(&self, e: &mut Emit, found: Memory, first: Value, kind: Reduction) -> Value {
        combine_lanes(e, kind, found, first, (EIGHTHS, WORKGROUP / EIGHTHS))
    }

    /// `count` values from `first` on, combined in order.
    fn combined(&self, e: &mut Emit, found: Memory, first: Value, count: u32, kind: Reduction) -> Value {
        let start = neutral(&mut e.b, kind);
        let total = e.b.var("all", start);
        let (from, to) = (e.b.u(0), e.b.u(count));
        let i = e.b.open_loop("other", from, to, 4);
        for j in 0..4 {
            let offset = e.b.u(j);
            let at = e.b.add(i, offset);
            let at = e.b.add(at, first);
            let next = e.b.load(found, at);
            let so_far = e.b.get(total);
            let next = combine(&mut e.b, kind, so_far, next);
            e.b.set(total, next);
        }
        e.b.close_loop();
        e.b.get(total)
    }
}
