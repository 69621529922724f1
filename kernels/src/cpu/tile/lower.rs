//! Region -> tile program.

use super::fold::fold;
use super::values::{Values, is_alias};
use super::*;
use crate::cpu::{ROW_BLOCK, outer, outer_len, panel_len, row_stride};
use raygrad_compiler::graph::{Axes, Axis};
use raygrad_compiler::plan::Program;
use raygrad_compiler::plan::region::{Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::{ScalarProgram, Val};

/// Lowers one region of `program`.
pub fn lower(program: &Program, unfolded: &Region) -> TileProgram {
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
        out: empty(inner, line, rows, ld),
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

fn empty(inner: usize, line: usize, rows: usize, ld: usize) -> TileProgram {
    TileProgram {
        outer: vec![],
        inner,
        line,
        rows,
        ld,
        scratch: 0,
        temps: 0,
        constants: vec![],
        ops: vec![],
        packs: vec![],
        packed: 0,
        accumulators: vec![],
        accumulated: 0,
        direct: false,
        chunks: 1,
    }
}

/// A layer and what its only reader does with it.
struct FusedLayer {
    layer: InstId,
    /// Values added to every row.
    biases: Vec<InstId>,
    epilogue: LayerEpilogue,
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
                self.out.constants.extend(bits.iter().enumerate().map(|(c, b)| (to + c as Place, *b)));
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
                let from: Vec<Place> = (0..inst.channels).map(|c| from + (c * self.out.ld) as Place).collect();
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
        let step = if full { self.out.ld as Place } else { 1 };
        let mut runs: Vec<Run> = vec![];
        for c in 0..inst.channels {
            let arg = |v: &Value| {
                let place = v.places[if v.places.len() == 1 { 0 } else { c }];
                // A uniform run goes over channels: operands of one channel repeat.
                let repeats = if full { !v.full } else { v.places.len() == 1 && inst.channels > 1 };
                if repeats { RunArg::Splat(place) } else { RunArg::Lanes(place) }
            };
            let args: Vec<RunArg> = operands.iter().map(arg).collect();
            let at = out + c as Place * step;
            match runs.last_mut() {
                Some(run) if follows(run, at, &args, step) => run.channels += 1,
                _ => runs.push(Run { out: at, channels: 1, args }),
            }
        }
        self.out.ops.push(TileOp::Map { program: lane_program(program), runs, full });
    }

    /// A layer without a value yet whose only reader is a pointwise program that the matrix kernel can apply itself. The
    /// program's other operands are known.
    fn layer_of(&self, id: InstId) -> Option<FusedLayer> {
        let inst = self.region.inst(id);
        let RegionOp::Map(program) = &inst.op else { return None };
        let mut unknown = inst.inputs.iter().filter(|i| !self.values.known(**i));
        let (Some(&layer), None) = (unknown.next(), unknown.next()) else { return None };
        let alone = matches!(self.region.inst(layer).op, RegionOp::Linear(_))
            && self.values.users(layer) == 1
            && self.region.inst(layer).axes == inst.axes
            && self.region.inst(layer).channels == inst.channels
            && !self.region.is_uniform(id);
        if !alone {
            return None;
        }
        let at = |i: InstId| Val::Input(inst.inputs.iter().position(|x| *x == i).unwrap_or_default() as u8);
        let others: Vec<InstId> = inst.inputs.iter().copied().filter(|i| *i != layer).collect();
        let (y, zero) = (at(layer), Val::Const(0));
        if let ([(Prim::Lt, lt), (Prim::Select, select)], [h]) = (&program.code[..], &others[..])
            && *lt == [zero, at(*h)]
            && *select == [Val::Inst(0), y, zero]
            && !self.region.is_uniform(*h)
            && self.region.inst(*h).channels == inst.channels
        {
            let h = self.values.contiguous(self.values.get(*h))?;
            return Some(FusedLayer { layer, biases: vec![], epilogue: LayerEpilogue::Mask(h) });
        }
        // Sums of the layer and values that do not vary along the tile, rectified or not.
        let is_bias = |i: &InstId| {
            self.region.is_uniform(*i)
                && self.region.inst(*i).channels == inst.channels
                && self.values.contiguous(self.values.get(*i)).is_some()
        };
        let (adds, epilogue) = match program.code.split_last()? {
            ((Prim::Max, args), adds) => {
                let rectified = adds.len().checked_sub(1).map_or(y, |last| Val::Inst(last as u16));
                (*args == [rectified, zero]).then_some((adds, LayerEpilogue::Relu))?
            }
            _ => (&program.code[..], LayerEpilogue::None),
        };
        let terms: Vec<Val> = adds.iter().flat_map(|(_, args)| args.iter().copied()).collect();
        let once = |v: Val| terms.iter().filter(|t| **t == v).count() == 1;
        let plain_sum = adds.iter().all(|(prim, _)| *prim == Prim::Add)
            && others.iter().all(|i| once(at(*i)))
            && (adds.is_empty() || once(y))
            && (1..adds.len()).all(|i| once(Val::Inst(i as u16 - 1)))
            && !terms.iter().any(|t| matches!(t, Val::Const(_)));
        (plain_sum && others.iter().all(is_bias)).then_some(FusedLayer { layer, biases: others, epilogue })
    }

    /// Whether `id` is a layer that its only reader computes, see [`Lowering::layer_of`]. Its operand stays alive till then.
    fn fused_into_user(&self, id: InstId) -> bool {
        if !matches!(self.region.inst(id).op, RegionOp::Linear(_)) || self.values.users(id) != 1 {
            return false;
        }
        let user = self.region.ids().find(|u| self.region.inst(*u).inputs.contains(&id));
        user.and_then(|user| self.layer_of(user)).is_some()
    }

    /// Computes a layer with its epilogue as the value of `id`.
    fn layer_as(&mut self, id: InstId, fused: &FusedLayer) {
        let mut sum = None;
        let place = |v: &Values, b: &InstId| v.contiguous(v.get(*b));
        let mut bias = fused.biases.first().and_then(|b| place(&self.values, b));
        if fused.biases.len() > 1 {
            let channels = self.region.inst(id).channels;
            let (to, lanes) = self.values.temporary(channels, false);
            for other in fused.biases[1..].iter().filter_map(|b| place(&self.values, b)) {
                let add = ScalarProgram { code: vec![(Prim::Add, vec![Val::Input(0), Val::Input(1)])] };
                let args = vec![RunArg::Lanes(bias.unwrap_or(to)), RunArg::Lanes(other)];
                let runs = vec![Run { out: to, channels, args }];
                self.out.ops.push(TileOp::Map { program: lane_program(&add), runs, full: false });
                bias = Some(to);
            }
            sum = Some((to, lanes));
        }
        self.layer(id, fused.layer, bias, fused.epilogue);
        sum.into_iter().for_each(|s| self.values.release_temporary(s));
        // The layer's operand was held for this moment; the layer itself never had a value.
        self.values.done(self.region.inst(fused.layer).inputs[0]);
        for input in self.region.inst(id).inputs.iter().filter(|i| **i != fused.layer) {
            self.values.done(*input);
        }
    }

    /// Stretches of neighbouring channels of a full value: first place, first channel, channels.
    fn stretches(&self, id: InstId) -> Vec<(Place, usize, usize)> {
        let value = self.values.get(id);
        let mut all: Vec<(Place, usize, usize)> = vec![];
        for (c, place) in value.places.iter().enumerate() {
            match all.last_mut() {
                Some((first, _, n)) if *first + (*n * self.out.ld) as Place == *place => *n += 1,
                _ => all.push((*place, c, 1)),
            }
        }
        all
    }

    /// The stretches of a wide full value that is not worth copying together, if `usable` says they can be used apart.
    fn apart(&self, id: InstId, usable: impl Fn(usize) -> bool) -> Option<Vec<(Place, usize, usize)>> {
        let value = self.values.get(id);
        if !value.full || value.places.len() < WIDE || self.values.contiguous(value).is_some() {
            return None;
        }
        let all = self.stretches(id);
        (all.len() <= 4 && all.iter().all(|(_, first, _)| usable(*first))).then_some(all)
    }

    fn layer(&mut self, id: InstId, layer: InstId, bias: Option<Place>, epilogue: LayerEpilogue) {
        let inst = self.region.inst(layer);
        let RegionOp::Linear(weights) = inst.op else { unreachable!("only layers are passed here") };
        let full = !self.region.is_uniform(layer);
        let contraction = if weights.transposed { weights.columns } else { weights.rows };
        let outputs = inst.channels;
        // Rows of untransposed weights are a matrix of their own: one product per stretch of the operand.
        if let Some(parts) = self.apart(inst.inputs[0], |_| !weights.transposed) {
            let out = self.values.create(id, outputs, full);
            let last = parts.len() - 1;
            for (i, (x, first, n)) in parts.into_iter().enumerate() {
                let rows = Weights { first: weights.first + first * weights.columns, rows: n, ..weights };
                let pack = self.pack(rows, n, outputs);
                let epilogue = if i == last { epilogue } else { LayerEpilogue::None };
                let bias = if i == 0 { bias } else { None };
                let op = Layer { x, contraction: n, pack, bias, accumulate: i > 0, epilogue, out, outputs, full };
                self.out.ops.push(TileOp::Layer(op));
            }
            return;
        }
        let (x, copy) = self.side_by_side(inst.inputs[0], full);
        let out = self.values.create(id, outputs, full);
        let pack = self.pack(weights, contraction, outputs);
        let op = Layer { x, contraction, pack, bias, accumulate: false, epilogue, out, outputs, full };
        self.out.ops.push(TileOp::Layer(op));
        copy.into_iter().for_each(|c| self.values.release_temporary(c));
    }

    fn pack(&mut self, weights: Weights, contraction: usize, outputs: usize) -> usize {
        if let Some(known) = self.out.packs.iter().position(|p| p.weights == weights) {
            return known;
        }
        let view = self.view(weights.buffer);
        let len = panel_len(contraction, outputs).next_multiple_of(16);
        let elements = view.elements;
        self.out.packs.push(Pack { weights, view, at: self.out.packed, len, elements });
        self.out.packed += len * elements;
        self.out.packs.len() - 1
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
        self.out.scratch = self.out.temps + temps;
        let per_line = |op: &TileOp| match op {
            TileOp::Store(TileStore::Reduce { view, .. }) => {
                view.inner == 0 && view.outer.iter().chain(view.lines.iter().map(|(_, s)| s)).all(|s| *s > 0)
            }
            TileOp::Store(TileStore::Outer { .. } | TileStore::Scatter { .. }) => false,
            _ => true,
        };
        let complete = self.out.tiles() / self.out.line_tiles();
        self.out.direct = complete >= 2 * MAX_CHUNKS && self.out.ops.iter().all(per_line);
        let units = if self.out.direct { complete } else { self.out.tiles() }.max(1);
        // A chunk's accumulators are worth a few tiles of work each.
        self.out.chunks = (units / CHUNK_TILES).next_power_of_two().clamp(units.min(2), MAX_CHUNKS);
        self.out
    }
}

/// Whether a channel continues a run.
fn follows(run: &Run, at: Place, args: &[RunArg], step: Place) -> bool {
    let n = run.channels as Place;
    let continues = |(old, new): (&RunArg, &RunArg)| match (old, new) {
        (RunArg::Lanes(a), RunArg::Lanes(b)) => a + n * step == *b,
        (RunArg::Splat(a), RunArg::Splat(b)) => a == b,
        _ => false,
    };
    run.out + n * step == at && run.args.iter().zip(args).all(continues)
}

/// Assigns temporaries to a scalar program's intermediate results.
pub(super) fn lane_program(program: &ScalarProgram) -> LaneProgram {
    let n = program.code.len();
    let mut last_use = vec![0; n];
    for (at, (_, args)) in program.code.iter().enumerate() {
        for arg in args {
            if let Val::Inst(i) = arg {
                last_use[*i as usize] = at;
            }
        }
    }
    let mut place = vec![0u8; n];
    let mut free: Vec<u8> = vec![];
    let mut temps = 0u8;
    let mut code = vec![];
    for (at, (prim, args)) in program.code.iter().enumerate() {
        let mut sources = [Source::Const(0); 3];
        for (source, arg) in sources.iter_mut().zip(args) {
            *source = match arg {
                Val::Input(i) => Source::Arg(*i),
                Val::Const(c) => Source::Const(*c),
                Val::Inst(i) => Source::Temp(place[*i as usize]),
            };
        }
        for (i, last) in last_use.iter().enumerate().take(at) {
            let used_here = args.contains(&Val::Inst(i as u16));
            if used_here && *last == at {
                free.push(place[i]);
            }
        }
        let to = free.pop().unwrap_or_else(|| {
            temps += 1;
            temps - 1
        });
        place[at] = to;
        code.push((*prim, sources, to));
    }
    LaneProgram { code, temps: temps as usize }
}
