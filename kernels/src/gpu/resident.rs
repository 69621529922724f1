//! Kernels of resident networks: a workgroup takes a tile of rows through all layers, in its own memory.
//!
//! Where a region scans along its inner axis or sums over many short lines of it, a workgroup follows a whole line, tile by
//! tile: from encoding to the last sum in one kernel, which is how rays are rendered.
//!
//! What is kept lies `[channel][row]`, values whose lives do not overlap in the same place. What does not fit, even of the
//! smallest tiles, lies in scratch memory.

use super::builder::{Kind, Value};
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::phases::{Phase, Phases};
use super::position::{Position, four_rows, is_run};
use super::resident_layer;
use super::resident_line::Carried;
use super::room::tile_of;
use super::vanish::vanishing;
use super::{Kernel, LowerError};
use naga::MathFunction as Math;
use raygrad_compiler::fuse::LINE_CHANNELS;
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::plan::region::{BufferId, Grain, Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;
use std::collections::HashMap;

/// Invocations a row.
pub(super) const PER_ROW: u32 = 4;
/// Lines from which workgroups that follow one each fill a device ...
const MANY_LINES: usize = 256;
/// ... and elements of a line up to which it does not take too long.
const LONG_LINE: usize = 1024;

/// Whether a region is for a kernel of this kind.
pub(super) fn is_resident(region: &Region) -> bool {
    region.grain == Grain::Tile && region.body.iter().any(|i| matches!(i.op, RegionOp::Linear(_)))
}

/// Whether a workgroup combines a reduction along lines itself.
pub(super) fn follows(region: &Region, store: &Store) -> bool {
    let lines = |inner: &Axis| region.domain.without(inner).elements() >= MANY_LINES && inner.size() <= LONG_LINE;
    let narrow = store.values().iter().all(|v| region.inst(*v).channels <= LINE_CHANNELS);
    narrow && (region.whole || region.inner.as_ref().is_some_and(lines))
}

/// The kernel of a region whose stores write, or are combined over lines.
pub(super) fn kernel(layout: &mut Layout, limits: Limits, name: &str, region: &Region) -> Result<Kernel, LowerError> {
    let phases = Phases::of(region);
    let inner = Axes::new(region.inner.clone());
    let lines = region.whole || region.stores.iter().any(|s| matches!(s, Store::Reduce { .. }));
    // A tile has one set of weights.
    let of_weights = region.body.iter().filter_map(|i| match &i.op {
        RegionOp::Linear(w) => Some(layout.shape(w.buffer).axes.clone()),
        _ => None,
    });
    let batch = match lines {
        true => region.domain.minus(&inner),
        false => region.domain.minus(&region.domain.minus(&of_weights.fold(Axes::none(), |a, b| a.union(&b)))),
    };
    let rows = region.domain.minus(&batch);
    let ends = vanishing(&phases.region);
    let tile = tile_of(&phases, (rows.elements() as u32, ends.is_some()), limits.max_workgroup_bytes);
    let tile_rows = Axes::new([Axis::new("tile", tile.rows as usize)]);
    layout.hold(tile.lanes);
    let mut places = HashMap::new();
    for id in phases.region.ids().filter(|id| phases.kept[id.0 as usize]) {
        let inst = phases.region.inst(id);
        let place = match tile.offsets.get(&id) {
            Some(offset) => {
                let shape = Shape::of(tile_rows.clone(), inst.channels, DType::F32);
                layout.in_workgroup(&inst.label, shape, *offset)
            }
            None => layout.scratch(&inst.label, Shape::of(region.domain.clone(), inst.channels, DType::F32))?,
        };
        places.insert(id, place);
    }
    let spilled = places.len() > tile.offsets.len();
    let network = Network { phases, places, batch, rows, tile_rows, tile: tile.rows, lines, ends, spilled };
    network.kernel(layout, limits, name)
}

pub(super) struct Network {
    pub phases: Phases,
    /// Where what is kept lies.
    pub places: HashMap<InstId, BufferId>,
    /// Axes of which a workgroup has one element.
    pub batch: Axes,
    /// Those along which its tiles run.
    pub rows: Axes,
    /// That of what a workgroup holds.
    tile_rows: Axes,
    /// Rows of a tile.
    pub tile: u32,
    lines: bool,
    /// The count behind whose first element a line need not be followed.
    ends: Option<InstId>,
    spilled: bool,
}

/// Where a tile begins.
#[derive(Clone, Copy)]
pub(super) struct First {
    pub batch: Value,
    pub row: Value,
}

impl Network {
    fn kernel(&self, layout: &Layout, limits: Limits, name: &str) -> Result<Kernel, LowerError> {
        let (count, batches) = (self.rows.elements() as u32, self.batch.elements() as u64);
        let tiles = if self.lines { 1 } else { count.div_ceil(self.tile) };
        let groups = batches * u64::from(tiles);
        let mut e = Emit::new(layout, limits, groups, PER_ROW * self.tile)?.with_vectors(true);
        if e.spare_workgroups() {
            e.leave_from(e.workgroup, groups as u32);
        }
        let (across, size) = (e.b.u(tiles), e.b.u(self.tile));
        let (own, batch) = (e.b.rem(e.workgroup, across), e.b.div(e.workgroup, across));
        e.b.name(batch, "batch");
        if !self.lines {
            let row = e.b.mul(own, size);
            e.b.name(row, "first_row");
            self.tile(&mut e, First { batch, row }, &Carried::default());
            return e.finish(name);
        }
        let carried = self.carried(&mut e);
        let stop = self.ends.map(|id| (id, e.b.workgroup("seen", Kind::F32, false, 1)));
        let (from, to) = (e.b.u(0), e.b.u(count));
        let row = e.b.open_loop("row", from, to, self.tile);
        e.b.barrier();
        self.tile(&mut e, First { batch, row }, &carried);
        if let Some((id, seen)) = stop {
            let (first, zero) = (e.b.u(0), e.b.f(0.0));
            e.if_below(e.invocation, Some(1), |e| {
                let sum = carried.sums.iter().find(|s| s.0 == id).map_or(zero, |s| e.b.get(s.1));
                e.b.store(seen, first, sum);
            });
            e.b.barrier();
            let seen = e.b.load_uniform(seen, first);
            e.b.name(seen, "seen_now");
            let enough = e.b.less(zero, seen);
            e.b.break_if(enough);
        }
        e.b.close_loop();
        self.finish(&mut e, First { batch, row: from }, &carried);
        e.finish(name)
    }

    /// All phases of one tile.
    fn tile(&self, e: &mut Emit, first: First, carried: &Carried) {
        for (at, phase) in self.phases.all.iter().enumerate() {
            if at > 0 {
                if self.spilled { e.b.barrier_of_storage() } else { e.b.barrier() }
            }
            let region = self.phases.seen_by(at, |id| self.load(e.layout, id));
            match phase {
                Phase::Rows(ids) => self.rows(e, &region, ids, first),
                Phase::Lanes(id) => self.lanes(e, &region, *id, first),
                Phase::Layer { linear, results } => resident_layer::emit(self, e, &region, (*linear, results), first),
                Phase::Scan(id) => self.scan(e, *id, first, carried),
                Phase::Totals => self.totals(e, first, carried),
            }
        }
    }

    /// A kept value as a load.
    fn load(&self, layout: &Layout, id: InstId) -> Inst {
        let (buffer, inst) = (self.places[&id], self.phases.region.inst(id));
        let axes = layout.shape(buffer).axes.clone();
        Inst { op: RegionOp::Load(buffer), inputs: vec![], axes, ..inst.clone() }
    }

    /// Rows of the last tile do not fill it.
    pub fn is_ragged(&self) -> bool {
        !(self.rows.elements() as u32).is_multiple_of(self.tile)
    }

    /// Whether four neighbouring rows from a multiple of four on all exist or all do not.
    fn in_fours(&self) -> bool {
        self.rows.elements().is_multiple_of(4)
    }

    /// Row `own` of a tile; what lies behind the last row is the last one again.
    fn position(&self, e: &mut Emit, first: First, own: Value) -> Position {
        let mut row = e.b.add(first.row, own);
        if self.is_ragged() {
            let last = e.b.u(self.rows.elements() as u32 - 1);
            row = e.b.math(Math::Min, &[row, last]);
        }
        self.at(first.batch, row, own)
    }

    fn at(&self, batch: Value, row: Value, own: Value) -> Position {
        let position = match self.batch.is_empty() {
            true => Position::new(&self.rows, row),
            false => Position::new(&self.batch, batch).and(&self.rows, row),
        };
        position.and(&self.tile_rows, own)
    }

    /// Four neighbouring rows of a tile, from `own` on, a multiple of four.
    fn four_rows(&self, e: &mut Emit, first: First, own: Value) -> [Value; 4] {
        let row = e.b.add(first.row, own);
        four_rows(e, row, self.rows.elements() as u32, self.is_ragged())
    }

    /// Values there.
    pub fn four<'r>(&self, e: &mut Emit, region: &'r Region, first: First, own: Value) -> Values<'r> {
        let mut all = vec![];
        for (i, row) in self.four_rows(e, first, own).into_iter().enumerate() {
            let offset = e.b.u(i as u32);
            let own = e.b.add(own, offset);
            all.push(self.at(first.batch, row, own));
        }
        let values = Values::new(region, all).side_by_side(&self.tile_rows);
        if self.in_fours() { values.side_by_side(&self.rows) } else { values }
    }

    /// Buffers where a value is kept and written.
    pub fn buffers(&self, id: InstId) -> Vec<BufferId> {
        self.kept(id).into_iter().chain(self.written(id)).collect()
    }

    /// Where a value is kept.
    pub fn kept(&self, id: InstId) -> Option<BufferId> {
        self.places.get(&id).copied()
    }

    /// Buffers that a value is written to.
    pub fn written(&self, id: InstId) -> Vec<BufferId> {
        let written = |s: &Store| match s {
            Store::Write { value, buffer } if *value == id => Some(*buffer),
            _ => None,
        };
        self.phases.region.stores.iter().filter_map(written).collect()
    }

    /// Sets channels of a row of buffers, or where values are vectors, of four neighbours: each of a buffer, a channel and a value.
    pub fn set(&self, e: &mut Emit, all: &[(BufferId, Value, Value)], first: First, own: Value) {
        let row = e.b.add(first.row, own);
        let (mut inside, mut fours, mut lanes) = (vec![], vec![], vec![]);
        for item in all {
            let shape = e.layout.shape(item.0);
            let floats = shape.dtype == DType::F32;
            if shape.axes == self.tile_rows {
                inside.push(*item);
            } else if item.2.vector && floats && self.in_fours() && is_run(&shape.axes, &self.rows) {
                fours.push(*item);
            } else {
                lanes.push(*item);
            }
        }
        self.set_at(e, &inside, first, (row, own));
        let end = self.is_ragged().then(|| self.rows.elements() as u32);
        if !fours.is_empty() {
            e.if_below(row, end, |e| self.set_at(e, &fours, first, (row, own)));
        }
        // A branch a row, not one a channel.
        let vectors = lanes.iter().any(|l| l.2.vector);
        for i in 0..if vectors { 4 } else { 1 } {
            if lanes.is_empty() {
                break;
            }
            let offset = e.b.u(i);
            let (row, own) = (e.b.add(row, offset), e.b.add(own, offset));
            e.if_below(row, end, |e| {
                for (buffer, channel, value) in &lanes {
                    let lane = if value.vector { e.b.component(*value, i) } else { *value };
                    self.set_at(e, &[(*buffer, *channel, lane)], first, (row, own));
                }
            });
        }
    }

    fn set_at(&self, e: &mut Emit, all: &[(BufferId, Value, Value)], first: First, (row, own): (Value, Value)) {
        for (buffer, channel, value) in all {
            let axes = e.layout.shape(*buffer).axes.clone();
            let element = self.at(first.batch, row, own).element(e, &axes);
            let at = e.index(*buffer, *channel, element);
            if value.vector { e.store_four(*buffer, at, *value) } else { e.store(*buffer, at, *value) }
        }
    }

    /// An invocation a row.
    fn rows(&self, e: &mut Emit, region: &Region, ids: &[InstId], first: First) {
        let own = e.invocation;
        e.if_below(own, Some(self.tile), |e| {
            let position = self.position(e, first, own);
            let mut values = Values::new(region, vec![position]);
            let mut all = vec![];
            for id in ids {
                for (c, value) in values.all(e, *id).into_iter().enumerate() {
                    let c = e.b.u(c as u32);
                    all.extend(self.buffers(*id).into_iter().map(|buffer| (buffer, c, value)));
                }
            }
            self.set(e, &all, first, own);
        });
    }

    /// An invocation a channel of four rows, or of one where not everything can be computed side by side.
    fn lanes(&self, e: &mut Emit, region: &Region, id: InstId, first: First) {
        use RegionOp::{ChannelSum, Const, Index, Load, Map, Pick, RowOuter};
        let simple =
            |i: &Inst| matches!(i.op, Load(_) | Const(_) | Map(_) | Pick(_) | Index(_) | ChannelSum(_) | RowOuter);
        let needed = super::elements::closure(region, [id]);
        let fours =
            region.body.iter().zip(&needed).all(|(i, n)| !n || simple(i)) && region.inst(id).dtype == DType::F32;
        let (each, channels) = (if fours { 4 } else { 1 }, region.inst(id).channels as u32);
        let (across, count) = (self.tile / each, self.tile / each * channels);
        let invocations = PER_ROW * self.tile;
        let (none, all) = (e.b.u(0), e.b.u(count));
        let before = e.b.open_loop("lane", none, all, invocations);
        let number = e.b.add(before, e.invocation);
        let spare = !count.is_multiple_of(invocations);
        e.if_below(number, spare.then_some(count), |e| {
            let (width, each) = (e.b.u(across), e.b.u(each));
            let (channel, own) = (e.b.div(number, width), e.b.rem(number, width));
            let own = e.b.mul(own, each);
            e.b.name(channel, "channel");
            e.b.name(own, "own_row");
            let mut values = match fours {
                true => self.four(e, region, first, own),
                false => {
                    let position = self.position(e, first, own);
                    Values::new(region, vec![position])
                }
            };
            let value = values.channel(e, id, Channel::Var(channel));
            let value = if fours { e.b.splat(value) } else { value };
            let all: Vec<_> = self.buffers(id).into_iter().map(|buffer| (buffer, channel, value)).collect();
            self.set(e, &all, first, own);
        });
        e.b.close_loop();
    }

    /// A channel of a row of what is kept.
    pub fn held(&self, e: &mut Emit, place: BufferId, channel: Value, first: First, own: Value) -> Value {
        let axes = e.layout.shape(place).axes.clone();
        let position = self.position(e, first, own);
        let element = position.element(e, &axes);
        let at = e.index(place, channel, element);
        e.load(place, at)
    }

    /// A channel of four rows of what is kept.
    pub fn held_four(&self, e: &mut Emit, place: BufferId, channel: Value, first: First, own: Value) -> Value {
        let axes = e.layout.shape(place).axes.clone();
        if axes != self.tile_rows && !(self.in_fours() && is_run(&axes, &self.rows)) {
            let mut all = vec![];
            for i in 0..4 {
                let offset = e.b.u(i);
                let own = e.b.add(own, offset);
                all.push(self.held(e, place, channel, first, own));
            }
            return e.b.vector([all[0], all[1], all[2], all[3]]);
        }
        // What the workgroup holds does not depend on where the tile begins.
        let row = if axes == self.tile_rows { first.row } else { self.four_rows(e, first, own)[0] };
        let element = self.at(first.batch, row, own).element(e, &axes);
        let at = e.index(place, channel, element);
        e.load_four(place, at)
    }

    /// A workgroup's element of axes that its tiles do not run along.
    pub fn batch_element(&self, e: &mut Emit, first: First, axes: &Axes) -> Value {
        Position::new(&self.batch, first.batch).element(e, axes)
    }
}
