//! Region -> tile program.

mod layers;

use super::fold::fold;
use super::temporaries::lane_program;
use super::values::{Values, is_alias};
use super::*;
use crate::cpu::{ROW_BLOCK, gemm_scratch, outer, outer_len, outer_scratch, panel_len, row_stride};
use raygrad_compiler::graph::{Axes, Axis};
use raygrad_compiler::plan::Program;
use raygrad_compiler::plan::region::{Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::{ScalarProgram, Val};

/// Lowers one region of `program`, with matrix products of `products`.
pub fn lower(program: &Program, unfolded: &Region, products: Products) -> TileProgram {
    let layers = unfolded.body.iter().any(|i| matches!(i.op, RegionOp::Linear(_)))
        || unfolded.stores.iter().any(|s| matches!(s, Store::Outer { .. }));
    let most = if layers { LAYER_ROWS } else { PLAIN_ROWS };
    let (region, lines) = fold(program, unfolded, most);
    let region = &region;
    let outer: Vec<&Axis> = region.domain.iter().filter(|a| Some(*a) != region.inner.as_ref()).collect();
    let line = unfolded.inner.as_ref().map_or(1, Axis::size);
    let inner = region.inner.as_ref().map_or(1, Axis::size);
    let rows = tile_rows(inner, line, region.whole, most);
    let ld = row_stride(rows);
    let mut lowering = Lowering {
        program,
        region,
        domain: &unfolded.domain,
        outer,
        lines,
        inner: unfolded.inner.as_ref(),
        values: Values::new(region, ld),
        out: empty(products, inner, line, rows, ld),
    };
    lowering.out.outer = lowering.outer.iter().map(|a| a.size()).collect();
    // A buffer that is updated in place is read before anything is written. Constants are written once for all tiles:
    // their places must never have been another value's. Uniform values are small, and layers want their bias first.
    let early = |id: &InstId| match &region.inst(*id).op {
        RegionOp::Load(b) => region.is_uniform(*id) || region.stores.iter().any(|s| s.buffer() == *b),
        RegionOp::Const(_) => true,
        _ => false,
    };
    let (first, rest): (Vec<InstId>, Vec<InstId>) = region.ids().partition(early);
    for id in first {
        lowering.inst(id);
    }
    for id in rest {
        lowering.inst(id);
        // A result leaves as soon as it is complete: what it was computed from can then be overwritten.
        for store in region.stores.iter().filter(|s| s.values().iter().max() == Some(&id)) {
            lowering.store(store);
        }
    }
    for store in region.stores.iter().filter(|s| s.values().iter().max().is_some_and(early)) {
        lowering.store(store);
    }
    lowering.finish()
}

/// Rows of a tile: all rows in equal parts, none longer than `most`; whole lines, if there are several.
fn tile_rows(inner: usize, line: usize, whole: bool, most: usize) -> usize {
    if line < inner {
        let lines = inner / line;
        return lines.div_ceil(lines.div_ceil(most / line)) * line;
    }
    let segments = if whole { 1 } else { inner.div_ceil(most) };
    inner.div_ceil(segments).next_multiple_of(ROW_BLOCK)
}

fn empty(products: Products, inner: usize, line: usize, rows: usize, ld: usize) -> TileProgram {
    TileProgram {
        outer: vec![],
        inner,
        line,
        rows,
        ld,
        scratch: 0,
        temps: 0,
        products,
        pairs: 0,
        constants: vec![],
        ops: vec![],
        packs: vec![],
        packed: 0,
        accumulators: vec![],
        accumulated: 0,
        batch: None,
        direct: false,
        chunks: 1,
    }
}

struct Lowering<'a> {
    program: &'a Program,
    region: &'a Region,
    /// Of the region before it was folded.
    domain: &'a Axes,
    outer: Vec<&'a Axis>,
    /// Axes whose positions are lines, outermost first, and the axis that lines run along.
    lines: Vec<Axis>,
    inner: Option<&'a Axis>,
    values: Values,
    out: TileProgram,
}

impl Lowering<'_> {
    fn view(&self, buffer: BufferId) -> View {
        let shape = &self.program.buffer(buffer).shape;
        let strides = shape.axes.strides_in(self.domain);
        let stride = |axis: &Axis| {
            let at = self.domain.iter().position(|a| a == axis);
            at.map_or(0, |i| strides[i])
        };
        View {
            buffer,
            elements: shape.axes.elements(),
            outer: self.outer.iter().map(|a| stride(a)).collect(),
            lines: self.lines.iter().map(|a| (a.size(), stride(a))).collect(),
            inner: self.inner.map_or(0, stride),
        }
    }

    /// Stride and size of one axis of a buffer.
    fn axis_stride(&self, buffer: BufferId, axis: &Axis) -> (usize, usize) {
        let axes = &self.program.buffer(buffer).shape.axes;
        (axes.iter().skip_while(|a| *a != axis).skip(1).map(Axis::size).product(), axis.size())
    }

    /// Where the position along `axis` comes from.
    fn position(&self, axis: &Axis) -> Position {
        if let Some(outer) = self.outer.iter().position(|a| *a == axis) {
            return Position::Outer(outer);
        }
        let mut every = 1;
        for row in self.lines.iter().chain(self.inner).rev() {
            if row == axis {
                break;
            }
            every *= row.size();
        }
        Position::Row { every, size: axis.size() }
    }

    fn places(&self, id: InstId) -> Vec<Place> {
        self.values.get(id).places.clone()
    }

    /// The value of `id` with its channels next to each other and `full` as asked, copied if need be. The copy, if any,
    /// must be released after the next operation.
    fn side_by_side(&mut self, id: InstId, full: bool) -> (Place, Option<(Place, usize)>) {
        let value = self.values.get(id).clone();
        if value.full == full
            && let Some(place) = self.values.contiguous(&value)
        {
            return (place, None);
        }
        let copy = self.values.temporary(value.places.len(), full);
        let from_full = vec![value.full; value.places.len()];
        self.out.ops.push(TileOp::Gather { from: value.places, from_full, to: copy.0, full });
        (copy.0, Some(copy))
    }

    fn inst(&mut self, id: InstId) {
        let region = self.region;
        let inst = region.inst(id);
        let full = !region.is_uniform(id);
        if self.fused_into_user(id) {
            return;
        }
        match &inst.op {
            RegionOp::Load(buffer) => {
                let view = self.view(*buffer);
                let to = self.values.create(id, inst.channels, full);
                self.out.ops.push(TileOp::Load { view, to, channels: inst.channels, full });
            }
            RegionOp::Const(bits) => {
                let to = self.values.create(id, inst.channels, false);
                self.out.constants.extend(bits.iter().enumerate().map(|(c, b)| (to + c, *b)));
                // Constants are written once per thread: nothing may take their place.
                self.keep(id);
            }
            RegionOp::Map(program) => {
                if let Some(fused) = self.layer_of(id) {
                    return self.layer_as(id, &fused);
                }
                self.map(id, inst, program, full);
            }
            RegionOp::Pick(pick) => self.pick(id, inst, pick, full),
            RegionOp::ChannelSum(groups) => {
                let from = self.places(inst.inputs[0]);
                let out = self.values.create(id, inst.channels, full);
                self.out.ops.push(TileOp::ChannelSum { from, groups: groups.to_vec(), out, full });
            }
            RegionOp::ChannelMax => {
                let from = self.places(inst.inputs[0]);
                let out = self.values.create(id, 1, full);
                self.out.ops.push(TileOp::ChannelMax { from, out, full });
            }
            RegionOp::Linear(_) => self.layer(id, id, None, LayerEpilogue::None),
            RegionOp::RowLinear { rows, columns, transposed } => {
                let (x, w) = (self.values.get(inst.inputs[0]).clone(), self.values.get(inst.inputs[1]).clone());
                let out = self.values.create(id, inst.channels, full);
                let (rows, columns, transposed) = (*rows, *columns, *transposed);
                self.out.ops.push(TileOp::RowLinear { x, w, rows, columns, transposed, out, full });
            }
            RegionOp::RowOuter => {
                let (x, d) = (self.values.get(inst.inputs[0]).clone(), self.values.get(inst.inputs[1]).clone());
                let out = self.values.create(id, inst.channels, full);
                self.out.ops.push(TileOp::RowOuter { x, d, out, full });
            }
            RegionOp::CumSum { .. } | RegionOp::Shift { .. } => {
                let (from, copy) = self.side_by_side(inst.inputs[0], true);
                let from: Vec<Place> = (0..inst.channels).map(|c| from + c * self.out.ld).collect();
                let out = self.values.create(id, inst.channels, true);
                self.out.ops.push(match &inst.op {
                    RegionOp::CumSum { reverse } => TileOp::CumSum { from, out, reverse: *reverse },
                    RegionOp::Shift { by } => TileOp::Shift { from, out, by: *by },
                    _ => unreachable!("matched above"),
                });
                copy.into_iter().for_each(|c| self.values.release_temporary(c));
            }
            RegionOp::RowReduce(kind) => {
                let x = self.values.get(inst.inputs[0]).clone();
                let out = self.values.create(id, inst.channels, full);
                self.out.ops.push(TileOp::RowReduce { kind: *kind, x, out, full });
            }
            RegionOp::Index(axis) => {
                let of = self.position(axis);
                let out = self.values.create(id, 1, full);
                self.out.ops.push(TileOp::Index { of, out });
            }
            RegionOp::Take { table, axis } => {
                let index = self.values.get(inst.inputs[0]).clone();
                let mut view = self.view(*table);
                // The index takes the place of this axis, whether or not others vary along it.
                for (stride, outer) in view.outer.iter_mut().zip(&self.outer) {
                    *stride = if *outer == axis { 0 } else { *stride };
                }
                for ((_, stride), line) in view.lines.iter_mut().zip(&self.lines) {
                    *stride = if line == axis { 0 } else { *stride };
                }
                if self.inner == Some(axis) {
                    view.inner = 0;
                }
                let (axis_stride, axis_size) = self.axis_stride(*table, axis);
                let out = self.values.create(id, inst.channels, full);
                let channels = inst.channels;
                self.out.ops.push(TileOp::Take { view, axis_stride, axis_size, index, out, channels, full });
            }
            RegionOp::SymEig { n } => {
                let from = self.places(inst.inputs[0]);
                let out = self.values.create(id, inst.channels, full);
                self.out.ops.push(TileOp::SymEig { n: *n, from, out, full });
            }
        }
        for input in &inst.inputs {
            self.values.done(*input);
        }
    }

    /// Holds a value's allocation to the end of the tile.
    fn keep(&mut self, id: InstId) {
        self.values.alias(id, &(0..self.region.inst(id).channels as u32).map(|c| (id, c)).collect::<Vec<_>>(), false);
    }

    fn pick(&mut self, id: InstId, inst: &Inst, pick: &[(u32, u32)], full: bool) {
        if is_alias(self.region, id) {
            let picks: Vec<(InstId, u32)> = pick.iter().map(|(o, c)| (inst.inputs[*o as usize], *c)).collect();
            self.values.alias(id, &picks, full);
            return;
        }
        let chosen = |(o, c): &(u32, u32)| {
            let value = self.values.get(inst.inputs[*o as usize]);
            (value.places[*c as usize], value.full)
        };
        let (from, from_full): (Vec<Place>, Vec<bool>) = pick.iter().map(chosen).unzip();
        let to = self.values.create(id, inst.channels, full);
        self.out.ops.push(TileOp::Gather { from, from_full, to, full });
    }

    fn map(&mut self, id: InstId, inst: &Inst, program: &ScalarProgram, full: bool) {
        let operands: Vec<Value> = inst.inputs.iter().map(|i| self.values.get(*i).clone()).collect();
        let overwritten = inst.inputs.iter().find_map(|i| self.values.overwrite(id, *i, inst.channels, full));
        let out = overwritten.unwrap_or_else(|| self.values.create(id, inst.channels, full));
        let step = if full { self.out.ld } else { 1 };
        let mut runs: Vec<Run> = vec![];
        for c in 0..inst.channels {
            let arg = |v: &Value| {
                let place = v.places[if v.places.len() == 1 { 0 } else { c }];
                // A uniform run goes over channels: operands of one channel repeat.
                let repeats = if full { !v.full } else { v.places.len() == 1 && inst.channels > 1 };
                if repeats { RunArg::Splat(place) } else { RunArg::Lanes(place) }
            };
            let args: Vec<RunArg> = operands.iter().map(arg).collect();
            let at = out + c * step;
            match runs.last_mut() {
                Some(run) if follows(run, at, &args, step) => run.channels += 1,
                _ => runs.push(Run { out: at, channels: 1, args }),
            }
        }
        self.out.ops.push(TileOp::Map { program: lane_program(program), runs, full });
    }

    fn accumulator(&mut self, buffer: BufferId, kind: Reduction, blocked: Option<(usize, usize, usize)>) -> usize {
        let len = match blocked {
            Some((k, n, elements)) => outer_len(k, n) * elements,
            None => self.program.buffer(buffer).shape.lanes(),
        };
        let at = self.out.accumulated;
        self.out.accumulators.push(Accumulator { at, len, kind, buffer, blocked });
        self.out.accumulated += len.next_multiple_of(16);
        at
    }

    fn store(&mut self, store: &Store) {
        let view = self.view(store.buffer());
        let mut copies = vec![];
        let lowered = match store {
            Store::Write { value, .. } => TileStore::Write { value: self.values.get(*value).clone(), view },
            Store::Reduce { kind, value, buffer } => {
                let at = self.accumulator(*buffer, *kind, None);
                TileStore::Reduce { kind: *kind, value: self.values.get(*value).clone(), view, at }
            }
            Store::Outer { x, d, buffer } => {
                let (k, n) = (self.region.inst(*x).channels, self.region.inst(*d).channels);
                let at = self.accumulator(*buffer, Reduction::Sum, Some((k, n, view.elements)));
                let (d, d_copy) = self.side_by_side(*d, true);
                copies.extend(d_copy);
                let fits = |first: usize| first.is_multiple_of(outer::PANEL) || !outer::x_along_vectors(k, n);
                let parts = self.apart(*x, fits).unwrap_or_else(|| {
                    let (place, x_copy) = self.side_by_side(*x, true);
                    copies.extend(x_copy);
                    vec![(place, 0, k)]
                });
                TileStore::Outer { parts, k, d, n, view, at }
            }
            Store::Scatter { value, index, axis, buffer } => {
                let (axis_stride, axis_size) = self.axis_stride(*buffer, axis);
                let at = self.accumulator(*buffer, Reduction::Sum, None);
                let (value, index) = (self.values.get(*value).clone(), self.values.get(*index).clone());
                TileStore::Scatter { value, index, axis_stride, axis_size, view, at }
            }
        };
        self.out.ops.push(TileOp::Store(lowered));
        copies.into_iter().for_each(|c| self.values.release_temporary(c));
        for value in store.values() {
            self.values.done(value);
        }
    }

    fn finish(mut self) -> TileProgram {
        let temps = self.out.ops.iter().map(|op| if let TileOp::Map { program, .. } = op { program.temps } else { 0 });
        // One more block serves kernels that need a row of their own.
        let temps = temps.max().unwrap_or(0) * BLOCK + self.out.ld.max(BLOCK);
        self.out.temps = self.values.arena_len();
        self.out.pairs = (self.out.temps + temps).next_multiple_of(16);
        let products = self.out.products;
        let pairs = self.out.ops.iter().map(|op| match op {
            TileOp::Layer(layer) => gemm_scratch(products, layer.contraction),
            TileOp::Store(TileStore::Outer { k, n, .. }) => outer_scratch(products, *k, *n, self.out.rows),
            _ => 0,
        });
        self.out.scratch = self.out.pairs + pairs.max().unwrap_or(0);
        let per_line = |op: &TileOp| match op {
            TileOp::Store(TileStore::Reduce { view, .. }) => {
                view.inner == 0 && view.outer.iter().chain(view.lines.iter().map(|(_, s)| s)).all(|s| *s > 0)
            }
            TileOp::Store(TileStore::Outer { .. } | TileStore::Scatter { .. }) => false,
            _ => true,
        };
        let complete = self.out.tiles() / self.out.line_tiles();
        self.out.direct = complete >= 2 * MAX_CHUNKS && self.out.ops.iter().all(per_line);
        if self.out.direct {
            self.out.accumulated = 0;
        }
        let units = if self.out.direct { complete } else { self.out.tiles() }.max(1);
        // A chunk's accumulators are worth a few tiles of work each.
        self.out.chunks = (units / CHUNK_TILES).next_power_of_two().clamp(units.min(2), MAX_CHUNKS);
        self.out.batch = self.out.tiles_of_batch();
        self.out.accumulated *= if self.out.batch.is_some() { 2 } else { 1 };
        self.out
    }
}

/// Whether a channel continues a run.
fn follows(run: &Run, at: Place, args: &[RunArg], step: Place) -> bool {
    let n = run.channels;
    let continues = |(old, new): (&RunArg, &RunArg)| match (old, new) {
        (RunArg::Lanes(a), RunArg::Lanes(b)) => a + n * step == *b,
        (RunArg::Splat(a), RunArg::Splat(b)) => a == b,
        _ => false,
    };
    run.out + n * step == at && run.args.iter().zip(args).all(continues)
}
