//! Layers: rows of channels times a weight matrix, tiled, with the pointwise values after it as the epilogue.

use super::builder::Value;
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, Position};
use super::tile::{Along, Tile, multiply};
use super::{Kernel, LowerError};
use naga::MathFunction as Math;
use raygrad_compiler::graph::Axes;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Weights};

/// The kernel of a region whose stores all write the layer `linear` or what follows from it channel by channel.
pub(super) fn kernel(
    layout: &Layout,
    limits: Limits,
    name: &str,
    region: &Region,
    linear: InstId,
) -> Result<Kernel, LowerError> {
    let inst = region.inst(linear);
    let (RegionOp::Linear(weights), RegionOp::Load(input)) = (&inst.op, &region.inst(inst.inputs[0]).op) else {
        unreachable!("the part of a layer holds a layer of a loaded input")
    };
    let (terms, columns) =
        if weights.transposed { (weights.columns, weights.rows) } else { (weights.rows, weights.columns) };
    // One matrix for every element of the weights' axes; the rows are the other axes.
    let batch_axes = layout.shape(weights.buffer).axes.clone();
    let row_axes = region.domain.minus(&batch_axes);
    let layer = Layer {
        region,
        linear,
        weights: *weights,
        input: *input,
        tile: Tile::of(columns, terms),
        rows: row_axes.elements() as u32,
        terms: terms as u32,
        columns: columns as u32,
        batch_axes,
        row_axes,
    };
    layer.kernel(layout, limits, name)
}

struct Layer<'r> {
    region: &'r Region,
    linear: InstId,
    weights: Weights,
    input: BufferId,
    tile: Tile,
    rows: u32,
    terms: u32,
    columns: u32,
    batch_axes: Axes,
    row_axes: Axes,
}

impl Layer<'_> {
    fn kernel(&self, layout: &Layout, limits: Limits, name: &str) -> Result<Kernel, LowerError> {
        let tile = self.tile;
        let (row_tiles, column_tiles) = (self.rows.div_ceil(tile.m), self.columns.div_ceil(tile.n));
        let groups = self.batch_axes.elements() as u64 * row_tiles as u64 * column_tiles as u64;
        let mut e = Emit::new(layout, limits, groups, tile.invocations())?;
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
        e.b.name(first_row, "first_row");
        e.b.name(first_column, "first_column");
        e.b.name(batch, "batch");

        let (from, to) = (e.b.u(0), e.b.u(self.terms));
        let block = multiply(
            &mut e,
            tile,
            (from, to),
            (&mut |e, k, at| self.input_vector(e, batch, first_row, k, at), Along::Edge),
            (
                &mut |e, k, at| self.weight_vector(e, batch, first_column, k, at),
                if self.weights.transposed { Along::K } else { Along::Edge },
            ),
        );
        for i in 0..tile.own_m / 4 {
            let at = block.m(&mut e, i);
            let row = e.b.add(first_row, at);
            e.b.name(row, "row");
            let positions = self.positions(&mut e, batch, row);
            let elements: Vec<Value> = positions.iter().map(|p| p.element(&mut e, &self.region.domain)).collect();
            let mut values = Values::new(self.region, positions);
            for j in 0..tile.own_n {
                let at = block.n(&mut e, j);
                let column = e.b.add(first_column, at);
                e.b.name(column, "column");
                let whole = self.columns.is_multiple_of(tile.n);
                if !whole {
                    let columns = e.b.u(self.columns);
                    let inside = e.b.less(column, columns);
                    e.b.open_if(inside);
                }
                let sum = block.sum(&mut e, i, j);
                values.give(&e, self.linear, Channel::Var(column), sum);
                if self.columns == 1 {
                    values.give(&e, self.linear, Channel::At(0), sum);
                }
                self.write(&mut e, &mut values, column, row, &elements);
                if !whole {
                    e.b.close_if();
                }
            }
        }
        e.finish(name)
    }

    /// Four neighbouring rows, those past the end clamped to the last.
    fn positions(&self, e: &mut Emit, batch: Value, first: Value) -> Vec<Position> {
        let mut all = vec![];
        for i in 0..4 {
            let offset = e.b.u(i);
            let mut row = e.b.add(first, offset);
            if !self.rows.is_multiple_of(self.tile.m) {
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
        let lanes: Vec<Value> = positions
            .iter()
            .map(|p| {
                let element = p.element(e, &axes);
                let at = e.index(self.input, channel, element);
                e.load(self.input, at)
            })
            .collect();
        let vector = e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]]);
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

    /// Weights of term `k` for four neighbouring columns, those past the end clamped to the last.
    fn weight_vector(&self, e: &mut Emit, batch: Value, first_column: Value, k: Value, at: Value) -> Value {
        e.b.topic("weight");
        let w = self.weights;
        let (k, _) = self.term(e, k);
        let mut lanes = vec![];
        for j in 0..4 {
            let (offset, first) = (e.b.u(j), e.b.add(first_column, at));
            let mut column = e.b.add(first, offset);
            if !self.columns.is_multiple_of(self.tile.n) {
                let last = e.b.u(self.columns - 1);
                column = e.b.math(Math::Min, &[column, last]);
            }
            let (row, column) = if w.transposed { (column, k) } else { (k, column) };
            let stride = e.b.u(w.columns as u32);
            let row = e.b.mul(row, stride);
            let (channel, first) = (e.b.add(row, column), e.b.u(w.first as u32));
            let channel = e.b.add(channel, first);
            let at = e.index(w.buffer, channel, batch);
            lanes.push(e.load(w.buffer, at));
        }
        e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]])
    }

    /// Writes the region's values of one column at four rows.
    fn write(&self, e: &mut Emit, values: &mut Values, column: Value, row: Value, elements: &[Value]) {
        let results: Vec<(BufferId, Value)> = self
            .region
            .stores
            .iter()
            .map(|s| (s.buffer(), values.channel(e, s.values()[0], Channel::Var(column))))
            .collect();
        let aligned = self.rows.is_multiple_of(4);
        let certain = self.rows.is_multiple_of(self.tile.m);
        if aligned && !certain {
            let rows = e.b.u(self.rows);
            let inside = e.b.less(row, rows);
            e.b.open_if(inside);
        }
        for (lane, element) in elements.iter().enumerate() {
            if !aligned {
                let (offset, rows) = (e.b.u(lane as u32), e.b.u(self.rows));
                let own = e.b.add(row, offset);
                let inside = e.b.less(own, rows);
                e.b.open_if(inside);
            }
            for (buffer, result) in &results {
                let value = if result.vector { e.b.component(*result, lane as u32) } else { *result };
                let at = e.index(*buffer, column, *element);
                e.store(*buffer, at, value);
            }
            if !aligned {
                e.b.close_if();
            }
        }
        if aligned && !certain {
            e.b.close_if();
        }
    }
}
