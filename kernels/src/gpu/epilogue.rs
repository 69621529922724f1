//! The epilogue of a layer's kernel: what a region computes from the layer channel by channel, written, or combined over rows.

use super::builder::Value;
use super::channels::runs_of;
use super::eval::{Channel, Values};
use super::give::{Epilogue, Place, Total};
use super::layer::Layer;
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::position::is_run;
use super::product::plus;
use super::reduce::{self, combine_all, neutral};
use super::regions::{empty, push_load};
use super::{Kernel, LowerError};
use naga::MathFunction as Math;
use raygrad_compiler::graph::{Axis, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;
use std::collections::VecDeque;

/// Where a workgroup's tile begins.
#[derive(Clone, Copy)]
pub(super) struct First {
    /// Number of the tile along the rows.
    pub tile: Value,
    pub row: Value,
    pub column: Value,
    pub batch: Value,
}

/// A combination over all rows, of each column, of what follows from a layer.
pub(super) struct RowTotal {
    kind: Reduction,
    result: BufferId,
    /// Of parts of tiles.
    partials: BufferId,
}

impl RowTotal {
    /// Combines the parts.
    pub fn finish(
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
pub(super) struct Finish<'l, 'r> {
    layer: &'l Layer<'r>,
    first: First,
    /// What was read for sums that are on their way.
    read: VecDeque<Vec<Rows<'l>>>,
}

impl<'l, 'r> Finish<'l, 'r> {
    pub fn new(layer: &'l Layer<'r>, first: First) -> Finish<'l, 'r> {
        Finish { layer, first, read: VecDeque::new() }
    }
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

/// What a region combines over all rows, with memory for that of each of so many parts.
pub(super) fn totals(layout: &mut Layout, region: &Region, parts: usize) -> Result<Vec<RowTotal>, LowerError> {
    let mut all = vec![];
    for store in &region.stores {
        let Store::Reduce { kind, value, buffer } = store else { continue };
        let shape = Shape::new(&[&Axis::new("part", parts)], region.inst(*value).channels);
        all.push(RowTotal { kind: *kind, result: *buffer, partials: layout.scratch("partial", shape)? });
    }
    Ok(all)
}

/// Loads of the region that the values after a layer use channel by channel, and little layers that are added to it.
pub(super) fn loads(region: &Region, linear: InstId) -> Vec<InstId> {
    let mut needed = vec![false; region.body.len()];
    region.stores.iter().flat_map(|s| s.values()).for_each(|v| needed[v.0 as usize] = true);
    let mut loads = vec![];
    for at in (0..region.body.len()).rev().filter(|at| InstId(*at as u32) != linear) {
        let inst = &region.body[at];
        match inst.op {
            // A layer of few terms: its operands' loads.
            RegionOp::Load(_) | RegionOp::Linear(_) if needed[at] => loads.push(InstId(at as u32)),
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

impl Layer<'_> {
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

    /// Four rows' values as one; rows past the end do not count.
    fn combined(&self, e: &mut Emit, kind: Reduction, row: Value, value: Value) -> Value {
        let end = e.b.u(self.rows);
        let nothing = neutral(&mut e.b, kind);
        let certain = self.rows.is_multiple_of(self.tile.m);
        let (together, apart) = (!certain && self.in_fours(), !certain && !self.in_fours());
        let counted = |e: &mut Emit, row: Value, value: Value| {
            let inside = e.b.less(row, end);
            e.b.select(inside, value, nothing)
        };
        let mut all = vec![];
        for lane in 0..4 {
            let mut own = if value.vector { e.b.component(value, lane) } else { value };
            if apart {
                let row = plus(e, row, lane);
                own = counted(e, row, own);
            }
            all.push(own);
        }
        let all = combine_all(&mut e.b, kind, &all);
        if together { counted(e, row, all) } else { all }
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
