//! Layers: rows of channels times a weight matrix, tiled, with the pointwise values after it as the epilogue.

use super::builder::Value;
use super::channels::runs_of;
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, Position, is_run};
use super::parts::{empty, push_load};
use super::reduce::{self, combine, neutral};
use super::sums::{Epilogue, Place, Total};
use super::tile::{Along, Operand, Tile, multiply, split};
use super::{Kernel, LowerError, elements};
use naga::MathFunction as Math;
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store, Weights};
use raygrad_compiler::scalar::DType;
use std::collections::VecDeque;
use std::ops::Range;

/// The kernels of a region whose stores all write the layer `linear` or what follows from it channel by channel.
pub(super) fn kernels(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
    linear: InstId,
) -> Result<Vec<Kernel>, LowerError> {
    let inst = region.inst(linear);
    let (RegionOp::Linear(weights), RegionOp::Load(input)) = (&inst.op, &region.inst(inst.inputs[0]).op) else {
        unreachable!("the part of a layer holds a layer of a loaded input")
    };
    let (terms, columns) =
        if weights.transposed { (weights.columns, weights.rows) } else { (weights.rows, weights.columns) };
    // One matrix for every element of the weights' axes; the rows are the other axes.
    let batch_axes = layout.shape(weights.buffer).axes.clone();
    let row_axes = region.domain.minus(&batch_axes);
    let stretches = split(columns);
    let several = stretches.len() > 1;
    let rows = row_axes.elements();
    let (mut weights, mut all) = (*weights, vec![]);
    let multiplied = limits.half.is_some_and(|h| h.matrices.is_some()) && weights.rows.min(weights.columns) > 32;
    if multiplied
        && rows >= MANY_ROWS
        && let Some((halves, kernels)) = halved(layout, limits, name, region, &weights)?
    {
        all.extend(kernels);
        weights = halves;
    }
    for (i, stretch) in stretches.into_iter().enumerate() {
        let name = if several { format!("{name}.{}", i + 1) } else { name.to_string() };
        let tile = Tile::of(&limits, (rows, stretch.len(), terms), batch_axes.elements());
        let totals = totals(layout, region, rows.div_ceil(tile.m as usize) * tile.parts() as usize)?;
        let layer = Layer {
            region,
            linear,
            totals,
            read_ahead: Layer::epilogue_loads(region, linear),
            weights,
            input: *input,
            tile,
            rows: rows as u32,
            terms: terms as u32,
            columns: stretch.start as u32..stretch.end as u32,
            layer_columns: columns as u32,
            batch_axes: batch_axes.clone(),
            row_axes: row_axes.clone(),
        };
        all.push(layer.kernel(layout, limits, &name)?);
        for total in &layer.totals {
            all.extend(total.finish(layout, limits, &format!("{name}.totals"), region)?);
        }
    }
    Ok(all)
}

/// Whether a layer's kernel combines what follows from it over all rows: it has one matrix, and all columns in one kernel.
pub(super) fn has_totals(layout: &Layout, region: &Region, linear: InstId) -> bool {
    let RegionOp::Linear(weights) = &region.inst(linear).op else { return false };
    layout.shape(weights.buffer).axes.is_empty() && split(region.inst(linear).channels).len() == 1
}

/// What a region combines over all rows, with memory for that of each of so many parts.
fn totals(layout: &mut Layout, region: &Region, parts: usize) -> Result<Vec<RowTotal>, LowerError> {
    let mut all = vec![];
    for store in &region.stores {
        let Store::Reduce { kind, value, buffer } = store else { continue };
        let shape = Shape::new(&[&Axis::new("part", parts)], region.inst(*value).channels);
        all.push(RowTotal { kind: *kind, result: *buffer, partials: layout.scratch("partial", shape)? });
    }
    Ok(all)
}

/// Rows from which weights are read so often that they are made halves first.
const MANY_ROWS: usize = 1 << 14;

/// Weights as halves, in scratch memory that the kernels fill; `None` where they cannot be seen as a buffer of their own.
fn halved(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
    weights: &Weights,
) -> Result<Option<(Weights, Vec<Kernel>)>, LowerError> {
    let count = weights.rows * weights.columns;
    let Some(own) = layout.slice(weights.buffer, weights.first..weights.first + count) else { return Ok(None) };
    let shape = layout.shape(own).clone();
    let mut copy = Region { domain: shape.axes.clone(), inner: shape.axes.last().cloned(), ..empty(region) };
    let buffer = layout.scratch_for_product("weights", shape)?;
    let value = push_load(layout, &mut copy, own);
    copy.stores.push(Store::Write { value, buffer });
    let kernels = elements::kernels(layout, limits, &format!("{name}.halves"), &copy)?;
    Ok(Some((Weights { buffer, first: 0, ..*weights }, kernels)))
}

struct Layer<'r> {
    region: &'r Region,
    linear: InstId,
    /// Loads that the epilogue needs.
    read_ahead: Vec<InstId>,
    totals: Vec<RowTotal>,
    weights: Weights,
    input: BufferId,
    tile: Tile,
    rows: u32,
    terms: u32,
    /// Of the layer, which this kernel computes.
    columns: Range<u32>,
    layer_columns: u32,
    batch_axes: Axes,
    row_axes: Axes,
}

/// Where a workgroup's tile begins.
#[derive(Clone, Copy)]
struct First {
    /// Number of the tile along the rows.
    tile: Value,
    row: Value,
    column: Value,
    batch: Value,
}

/// A combination over all rows, of each column, of what follows from a layer.
struct RowTotal {
    kind: Reduction,
    result: BufferId,
    /// Of parts of tiles.
    partials: BufferId,
}

impl RowTotal {
    /// Combines the parts.
    fn finish(
        &self,
        layout: &mut Layout,
        limits: Limits,
        name: &str,
        region: &Region,
    ) -> Result<Vec<Kernel>, LowerError> {
        let domain = layout.shape(self.partials).axes.clone();
        let mut parts = Region { domain, inner: None, ..empty(region) };
        let value = push_load(layout, &mut parts, self.partials);
        parts.stores.push(Store::Reduce { kind: self.kind, value, buffer: self.result });
        reduce::kernels(layout, limits, name, &parts)
    }
}

/// Four rows in an epilogue: the position of the first in the tile, and in the layer.
struct Rows<'r> {
    m: Value,
    row: Value,
    elements: Vec<Value>,
    values: Values<'r>,
    /// Each also clamped to the last.
    columns: Vec<(Value, Value)>,
}

/// What a layer's kernel writes of one column at four rows.
struct Found {
    row: Value,
    column: Value,
    elements: Vec<Value>,
    results: Vec<(BufferId, Value)>,
}

/// Writes what follows from a layer's sums.
struct Finish<'l, 'r> {
    layer: &'l Layer<'r>,
    first: First,
    /// What was read for sums that are on their way.
    read: VecDeque<Vec<Rows<'l>>>,
}

impl Epilogue for Finish<'_, '_> {
    fn ahead(&mut self, e: &mut Emit, places: &[Place]) {
        self.read.push_back(self.layer.read(e, self.first, places));
    }

    fn sums(&mut self, e: &mut Emit, _: &[Place], sums: &[Value]) -> Vec<Vec<Value>> {
        let layer = self.layer;
        let mut sums = sums.iter();
        let mut all: Vec<Found> = vec![];
        let mut combined = vec![vec![]; layer.totals.len()];
        for Rows { row, elements, mut values, columns, .. } in self.read.pop_front().unwrap_or_default() {
            for ((column, clamped), sums) in columns.into_iter().zip(sums.by_ref()) {
                values.give(e, layer.linear, Channel::Var(clamped), *sums);
                if layer.layer_columns == 1 {
                    values.give(e, layer.linear, Channel::At(0), *sums);
                }
                let mut results = vec![];
                for store in &layer.region.stores {
                    let value = values.channel(e, store.values()[0], Channel::Var(clamped));
                    match layer.totals.iter().position(|t| t.result == store.buffer()) {
                        Some(which) => combined[which].push(layer.combined(e, layer.totals[which].kind, row, value)),
                        None => results.push((store.buffer(), value)),
                    }
                }
                all.push(Found { row, column, results, elements: elements.clone() });
            }
        }
        for found in &all {
            let end = (!layer.whole_columns()).then_some(layer.columns.end);
            e.if_below(found.column, end, |e| layer.write(e, found));
        }
        combined
    }

    fn kinds(&self) -> Vec<Reduction> {
        self.layer.totals.iter().map(|t| t.kind).collect()
    }

    fn total(&mut self, e: &mut Emit, which: usize, Total { n, part, value }: Total) {
        let column = e.b.add(self.first.column, n);
        let end = (!self.layer.whole_columns()).then_some(self.layer.columns.end);
        e.if_below(column, end, |e| {
            let parts = e.b.u(self.layer.tile.parts());
            let before = e.b.mul(self.first.tile, parts);
            let part = e.b.add(before, part);
            let at = e.index(self.layer.totals[which].partials, column, part);
            e.store(self.layer.totals[which].partials, at, value);
        });
    }
}

impl Layer<'_> {
    fn kernel(&self, layout: &Layout, limits: Limits, name: &str) -> Result<Kernel, LowerError> {
        let tile = self.tile;
        let count = self.columns.end - self.columns.start;
        let (row_tiles, column_tiles) = (self.rows.div_ceil(tile.m), count.div_ceil(tile.n));
        let groups = self.batch_axes.elements() as u64 * row_tiles as u64 * column_tiles as u64;
        let mut e = Emit::new(layout, limits, groups, tile.invocations())?.with_vectors(true);
        if e.spare_workgroups() {
            e.leave_from(e.workgroup, groups as u32);
        }
        // Neighbouring workgroups share rows.
        let across = e.b.u(column_tiles);
        let (column_tile, rest) = (e.b.rem(e.workgroup, across), e.b.div(e.workgroup, across));
        let down = e.b.u(row_tiles);
        let (row_tile, batch) = (e.b.rem(rest, down), e.b.div(rest, down));
        let (m, n) = (e.b.u(tile.m), e.b.u(tile.n));
        let (first_row, first_column) = (e.b.mul(row_tile, m), e.b.mul(column_tile, n));
        let before = e.b.u(self.columns.start);
        let first_column = e.b.add(first_column, before);
        e.b.name(first_row, "first_row");
        e.b.name(first_column, "first_column");
        e.b.name(batch, "batch");

        let terms = (e.b.u(0), e.b.u(self.terms));
        let along = if self.weights.transposed { Along::K } else { Along::Edge };
        let first = First { tile: row_tile, row: first_row, column: first_column, batch };
        multiply(
            &mut e,
            tile,
            terms,
            Operand { along: Along::Edge, load: &mut |e, k, at| self.input_vector(e, batch, first_row, k, at) },
            Operand { along, load: &mut |e, k, at| self.weight_vector(e, batch, first_column, k, at) },
            &mut Finish { layer: self, first, read: VecDeque::new() },
        );
        e.finish(name)
    }

    /// What the epilogue computes at some places, with what it needs from memory.
    fn read<'l>(&'l self, e: &mut Emit, first: First, places: &[Place]) -> Vec<Rows<'l>> {
        let mut all: Vec<Rows> = vec![];
        for place in places {
            let column = e.b.add(first.column, place.n);
            e.b.name(column, "column");
            // Sums of the same rows share what they compute of those.
            if all.last().is_none_or(|rows| rows.m != place.m) {
                let row = e.b.add(first.row, place.m);
                e.b.name(row, "row");
                let positions = self.positions(e, first.batch, row);
                let elements = positions.iter().map(|p| p.element(e, &self.region.domain)).collect();
                let mut values = Values::new(self.region, positions);
                if self.in_fours() {
                    values = values.side_by_side(&self.row_axes);
                }
                all.push(Rows { m: place.m, row, elements, values, columns: vec![] });
            }
            let mut clamped = column;
            if !self.whole_columns() {
                let last = e.b.u(self.columns.end - 1);
                clamped = e.b.math(Math::Min, &[column, last]);
            }
            if let Some(rows) = all.last_mut() {
                for id in &self.read_ahead {
                    rows.values.channel(e, *id, Channel::Var(clamped));
                }
                rows.columns.push((column, clamped));
            }
        }
        all
    }

    /// Loads of the region that its values after the layer use channel by channel.
    fn epilogue_loads(region: &Region, linear: InstId) -> Vec<InstId> {
        let mut needed = vec![false; region.body.len()];
        region.stores.iter().flat_map(|s| s.values()).for_each(|v| needed[v.0 as usize] = true);
        let mut loads = vec![];
        for at in (0..region.body.len()).rev().filter(|at| InstId(*at as u32) != linear) {
            let inst = &region.body[at];
            match inst.op {
                RegionOp::Load(_) if needed[at] => loads.push(InstId(at as u32)),
                // A part of a buffer.
                RegionOp::Pick(_)
                    if needed[at]
                        && runs_of(&inst.op).len() == 1
                        && inst.inputs.iter().all(|i| matches!(region.inst(*i).op, RegionOp::Load(_))) =>
                {
                    loads.push(InstId(at as u32))
                }
                RegionOp::Map(_) if needed[at] => inst.inputs.iter().for_each(|i| needed[i.0 as usize] = true),
                _ => {}
            }
        }
        loads.reverse();
        loads
    }

    fn whole_columns(&self) -> bool {
        (self.columns.end - self.columns.start).is_multiple_of(self.tile.n)
    }

    /// Four rows' values as one; rows past the end do not count.
    fn combined(&self, e: &mut Emit, kind: Reduction, row: Value, value: Value) -> Value {
        let end = e.b.u(self.rows);
        let nothing = neutral(&mut e.b, kind);
        let mut total: Option<Value> = None;
        for lane in 0..4 {
            let mut own = if value.vector { e.b.component(value, lane) } else { value };
            if !self.rows.is_multiple_of(self.tile.m) {
                let offset = e.b.u(lane);
                let number = e.b.add(row, offset);
                let inside = e.b.less(number, end);
                own = e.b.select(inside, own, nothing);
            }
            total = Some(total.map_or(own, |so_far| combine(&mut e.b, kind, so_far, own)));
        }
        total.unwrap_or(nothing)
    }

    /// Whether four neighbouring rows from a multiple of four on all exist or all do not.
    fn in_fours(&self) -> bool {
        self.rows.is_multiple_of(4)
    }

    /// Four neighbouring rows, those past the end clamped to the last.
    fn positions(&self, e: &mut Emit, batch: Value, first: Value) -> Vec<Position> {
        let clamped = !self.rows.is_multiple_of(self.tile.m);
        let mut all = vec![];
        let mut first = first;
        if clamped && self.in_fours() {
            let last = e.b.u(self.rows - 4);
            first = e.b.math(Math::Min, &[first, last]);
        }
        for i in 0..4 {
            let offset = e.b.u(i);
            let mut row = e.b.add(first, offset);
            if clamped && !self.in_fours() {
                let last = e.b.u(self.rows - 1);
                row = e.b.math(Math::Min, &[row, last]);
            }
            all.push(self.position(batch, row));
        }
        all
    }

    fn position(&self, batch: Value, row: Value) -> Position {
        match self.batch_axes.is_empty() {
            true => Position::new(&self.row_axes, row),
            false => Position::new(&self.batch_axes, batch).and(&self.row_axes, row),
        }
    }

    /// Channel `k` of four neighbouring rows; zeros past the last channel.
    fn input_vector(&self, e: &mut Emit, batch: Value, first_row: Value, k: Value, at: Value) -> Value {
        e.b.topic("input");
        let row = e.b.add(first_row, at);
        let positions = self.positions(e, batch, row);
        let axes = e.layout.shape(self.input).axes.clone();
        let (channel, inside) = self.term(e, k);
        let index = |e: &mut Emit, p: &Position| {
            let element = p.element(e, &axes);
            e.index(self.input, channel, element)
        };
        let vector = if self.in_fours() && is_run(&axes, &self.row_axes) {
            let at = index(e, &positions[0]);
            e.load_four(self.input, at)
        } else {
            let mut lanes = vec![];
            for p in &positions {
                let at = index(e, p);
                lanes.push(e.load(self.input, at));
            }
            e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]])
        };
        match inside {
            Some(inside) => {
                let zero = e.b.f(0.0);
                e.b.select(inside, vector, zero)
            }
            None => vector,
        }
    }

    /// The number of a term, clamped to the last, and whether it exists, if that is not certain.
    fn term(&self, e: &mut Emit, k: Value) -> (Value, Option<Value>) {
        if self.terms.is_multiple_of(self.tile.k) {
            return (k, None);
        }
        let (count, last) = (e.b.u(self.terms), e.b.u(self.terms - 1));
        (e.b.math(Math::Min, &[k, last]), Some(e.b.less(k, count)))
    }

    /// Four neighbouring weights of term `k`, or of transposed ones, of four neighbouring terms; past the end, any.
    fn weight_vector(&self, e: &mut Emit, batch: Value, first_column: Value, k: Value, at: Value) -> Value {
        e.b.topic("weight");
        let w = self.weights;
        let column = e.b.add(first_column, at);
        // The matrix is `w.rows` lines of `w.columns` weights; a transposed one has a line a column of the layer.
        let (line, lines, first, ends) = if w.transposed {
            (column, self.columns.end, k, (self.terms, self.terms.is_multiple_of(self.tile.k)))
        } else {
            let whole = (self.columns.end - self.columns.start).is_multiple_of(self.tile.n);
            (k, self.terms, column, (self.columns.end, whole))
        };
        let last = e.b.u(lines - 1);
        let line = e.b.math(Math::Min, &[line, last]);
        let stride = e.b.u(w.columns as u32);
        let before = e.b.u(w.first as u32);
        let line = e.b.mul(line, stride);
        let line = e.b.add(line, before);
        let (end, whole) = ends;
        let single = e.layout.shape(w.buffer).axes.elements() == 1;
        let aligned = [w.first as u32, w.columns as u32, self.columns.start, end].iter().all(|x| x.is_multiple_of(4));
        if single && aligned {
            let last = e.b.u(end - 4);
            let first = if whole { first } else { e.b.math(Math::Min, &[first, last]) };
            let at = e.b.add(line, first);
            return e.load_four(w.buffer, at);
        }
        let mut lanes = vec![];
        for j in 0..4 {
            let (offset, last) = (e.b.u(j), e.b.u(end - 1));
            let own = e.b.add(first, offset);
            let own = if whole { own } else { e.b.math(Math::Min, &[own, last]) };
            let channel = e.b.add(line, own);
            let at = e.index(w.buffer, channel, batch);
            lanes.push(e.load(w.buffer, at));
        }
        e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]])
    }

    /// Writes the region's values of one column at four rows.
    fn write(&self, e: &mut Emit, found: &Found) {
        let Found { row, column, elements, results } = found;
        let (row, column) = (*row, *column);
        if self.in_fours() {
            let certain = self.rows.is_multiple_of(self.tile.m);
            e.if_below(row, (!certain).then_some(self.rows), |e| {
                for (buffer, result) in results {
                    let floats = e.layout.shape(*buffer).dtype == DType::F32;
                    if floats && is_run(&self.region.domain, &self.row_axes) {
                        let at = e.index(*buffer, column, elements[0]);
                        e.store_four(*buffer, at, *result);
                        continue;
                    }
                    for (lane, element) in elements.iter().enumerate() {
                        self.write_lane(e, (*buffer, *result), column, (lane as u32, *element));
                    }
                }
            });
            return;
        }
        for (lane, element) in elements.iter().enumerate() {
            let offset = e.b.u(lane as u32);
            let own = e.b.add(row, offset);
            e.if_below(own, Some(self.rows), |e| {
                for result in results {
                    self.write_lane(e, *result, column, (lane as u32, *element));
                }
            });
        }
    }

    fn write_lane(
        &self,
        e: &mut Emit,
        (buffer, result): (BufferId, Value),
        column: Value,
        (lane, element): (u32, Value),
    ) {
        let value = if result.vector { e.b.component(result, lane) } else { result };
        let at = e.index(buffer, column, element);
        e.store(buffer, at, value);
    }
}
