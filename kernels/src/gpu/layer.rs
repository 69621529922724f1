//! Layers: rows of channels times a weight matrix, tiled, with the pointwise values after it as the epilogue.

use super::builder::Value;
use super::epilogue::{Finish, First, RowTotal, loads, totals};
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::position::{Position, four_rows, is_run};
use super::product::{Along, Operand, multiply};
use super::regions::{empty, push_load};
use super::tile::{Tile, split};
use super::{Kernel, LowerError, elements};
use naga::MathFunction as Math;
use raygrad_compiler::graph::Axes;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store, Weights};
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
    let (terms, columns) = sides(weights);
    // One matrix for every element of the weights' axes; the rows are the other axes.
    let batch_axes = layout.shape(weights.buffer).axes.clone();
    let row_axes = region.domain.minus(&batch_axes);
    let rows = row_axes.elements();
    let stretches = split(&limits, (rows, columns, terms), batch_axes.elements(), terms);
    let several = stretches.len() > 1;
    let (mut weights, mut all) = (*weights, vec![]);
    let multiplied = limits.matrices().is_some() && weights.rows.min(weights.columns) > 32;
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
            read_ahead: loads(region, linear),
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
pub(super) fn has_totals(layout: &Layout, limits: &Limits, region: &Region, linear: InstId) -> bool {
    let RegionOp::Linear(weights) = &region.inst(linear).op else { return false };
    let (terms, columns) = sides(weights);
    let stretches = split(limits, (region.domain.elements(), columns, terms), 1, terms);
    layout.shape(weights.buffer).axes.is_empty() && stretches.len() == 1
}

/// Terms and columns of a layer.
fn sides(weights: &Weights) -> (usize, usize) {
    if weights.transposed { (weights.columns, weights.rows) } else { (weights.rows, weights.columns) }
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

pub(super) struct Layer<'r> {
    pub region: &'r Region,
    pub linear: InstId,
    /// Loads that the epilogue needs.
    pub read_ahead: Vec<InstId>,
    pub totals: Vec<RowTotal>,
    weights: Weights,
    input: BufferId,
    pub tile: Tile,
    pub rows: u32,
    terms: u32,
    /// Of the layer, which this kernel computes.
    pub columns: Range<u32>,
    pub layer_columns: u32,
    batch_axes: Axes,
    pub row_axes: Axes,
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
            &mut Finish::new(self, first),
        );
        e.finish(name)
    }

    pub fn whole_columns(&self) -> bool {
        (self.columns.end - self.columns.start).is_multiple_of(self.tile.n)
    }

    /// Whether four neighbouring rows from a multiple of four on all exist or all do not.
    pub fn in_fours(&self) -> bool {
        self.rows.is_multiple_of(4)
    }

    /// Four neighbouring rows, those past the end clamped to the last.
    pub fn positions(&self, e: &mut Emit, batch: Value, first: Value) -> Vec<Position> {
        let rows = four_rows(e, first, self.rows, !self.rows.is_multiple_of(self.tile.m));
        rows.into_iter().map(|row| self.position(batch, row)).collect()
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
        if self.terms.is_multiple_of(self.tile.turn()) {
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
            (column, self.columns.end, k, (self.terms, self.terms.is_multiple_of(self.tile.turn())))
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
}
