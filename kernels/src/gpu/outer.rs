//! Sums of outer products, the gradients of layers' weights: a tiled product over rows, in chunks of rows that a second
//! kernel sums in order.

use super::builder::Value;
use super::layout::{Layout, Limits};
use super::memory::{Emit, Position};
use super::reduce::{End, finish};
use super::tile::{Along, Tile, multiply};
use super::{Kernel, LowerError};
use naga::MathFunction as Math;
use raygrad_compiler::graph::{Axes, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;

/// Workgroups that fill a device.
const ENOUGH: usize = 512;
/// Rows of a chunk, at least.
const CHUNK_ROWS: usize = 256;
/// Chunks, at most.
const MAX_CHUNKS: usize = 128;

/// Kernels for a region with one `Outer` store of loaded values.
pub(super) fn kernels(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
) -> Result<Vec<Kernel>, LowerError> {
    let Some(Store::Outer { x, d, buffer }) = region.stores.first() else { return Ok(vec![]) };
    let (RegionOp::Load(x_buffer), RegionOp::Load(d_buffer)) = (&region.inst(*x).op, &region.inst(*d).op) else {
        unreachable!("the part of an outer product holds loads")
    };
    let keep = layout.shape(*buffer).axes.clone();
    let over = region.domain.minus(&keep);
    let (inputs, outputs) = (region.inst(*x).channels, region.inst(*d).channels);
    let (rows, kept) = (over.elements(), keep.elements());
    let tile = Tile::of(outputs, rows);
    let tiles = inputs.div_ceil(tile.m as usize) * outputs.div_ceil(tile.n as usize) * kept;
    let wanted = ENOUGH.div_ceil(tiles).min(rows.div_ceil(CHUNK_ROWS)).min(MAX_CHUNKS);
    let per_chunk = rows.div_ceil(wanted).next_multiple_of(tile.k as usize);
    let chunks = rows.div_ceil(per_chunk);
    let lanes = inputs * outputs * kept;
    let partials = match chunks {
        1 => *buffer,
        _ => layout.scratch("partial", Shape::of(Axes::none(), chunks * lanes, DType::F32))?,
    };
    let outer = Outer {
        x: *x_buffer,
        d: *d_buffer,
        to: partials,
        tile,
        inputs: inputs as u32,
        outputs: outputs as u32,
        rows: rows as u32,
        per_chunk: per_chunk as u32,
        chunks: chunks as u32,
        keep,
        over,
    };
    let first = outer.kernel(layout, limits, name)?;
    if chunks == 1 {
        return Ok(vec![first]);
    }
    let end = End { buffer: *buffer, first: 0, lanes, kind: Reduction::Sum };
    let last = finish(layout, limits, &format!("{name}.finish"), partials, chunks, &[end])?;
    Ok(vec![first, last])
}

struct Outer {
    x: BufferId,
    d: BufferId,
    to: BufferId,
    tile: Tile,
    inputs: u32,
    outputs: u32,
    rows: u32,
    per_chunk: u32,
    chunks: u32,
    keep: Axes,
    over: Axes,
}

impl Outer {
    fn kernel(&self, layout: &Layout, limits: Limits, name: &str) -> Result<Kernel, LowerError> {
        let tile = self.tile;
        let kept = self.keep.elements() as u32;
        let (tiles_m, tiles_n) = (self.inputs.div_ceil(tile.m), self.outputs.div_ceil(tile.n));
        let groups = self.chunks as u64 * kept as u64 * tiles_m as u64 * tiles_n as u64;
        let mut e = Emit::new(layout, limits, groups, tile.invocations())?;
        if e.spare_workgroups() {
            e.leave_from(e.workgroup, groups as u32);
        }
        let mut rest = e.workgroup;
        let mut next = |e: &mut Emit, count: u32| {
            let count = e.b.u(count);
            let own = e.b.rem(rest, count);
            rest = e.b.div(rest, count);
            own
        };
        let (tile_m, tile_n) = (next(&mut e, tiles_m), next(&mut e, tiles_n));
        let (keep, chunk) = (next(&mut e, kept), next(&mut e, self.chunks));
        let (m, n) = (e.b.u(tile.m), e.b.u(tile.n));
        let (first_input, first_output) = (e.b.mul(tile_m, m), e.b.mul(tile_n, n));
        e.b.name(first_input, "first_input");
        e.b.name(first_output, "first_output");
        let (length, rows) = (e.b.u(self.per_chunk), e.b.u(self.rows));
        let from = e.b.mul(chunk, length);
        let end = e.b.add(from, length);
        let to = e.b.math(Math::Min, &[end, rows]);
        let block = multiply(
            &mut e,
            tile,
            (from, to),
            (&mut |e, k, at| self.vector(e, (self.x, self.inputs, tile.m), keep, first_input, k, at, true), Along::K),
            (
                &mut |e, k, at| self.vector(e, (self.d, self.outputs, tile.n), keep, first_output, k, at, false),
                Along::K,
            ),
        );
        let lanes = e.b.u(self.inputs * self.outputs * kept);
        let block_first = e.b.mul(chunk, lanes);
        for i in 0..tile.own_m / 4 {
            let at = block.m(&mut e, i);
            let input = e.b.add(first_input, at);
            for j in 0..tile.own_n {
                let at = block.n(&mut e, j);
                let output = e.b.add(first_output, at);
                let sum = block.sum(&mut e, i, j);
                let outputs = e.b.u(self.outputs);
                let guarded = !self.outputs.is_multiple_of(tile.n);
                if guarded {
                    let inside = e.b.less(output, outputs);
                    e.b.open_if(inside);
                }
                for lane in 0..4 {
                    self.write(&mut e, (input, lane), output, sum, keep, block_first);
                }
                if guarded {
                    e.b.close_if();
                }
            }
        }
        e.finish(name)
    }

    fn write(
        &self,
        e: &mut Emit,
        (first, lane): (Value, u32),
        output: Value,
        sum: Value,
        keep: Value,
        block_first: Value,
    ) {
        let offset = e.b.u(lane);
        let input = e.b.add(first, offset);
        let guarded = !self.inputs.is_multiple_of(self.tile.m);
        if guarded {
            let inputs = e.b.u(self.inputs);
            let inside = e.b.less(input, inputs);
            e.b.open_if(inside);
        }
        let (outputs, kept) = (e.b.u(self.outputs), e.b.u(self.keep.elements() as u32));
        let channel = e.b.mul(input, outputs);
        let channel = e.b.add(channel, output);
        let at = e.b.mul(channel, kept);
        let at = e.b.add(at, keep);
        let at = e.b.add(at, block_first);
        let value = e.b.component(sum, lane);
        e.store(self.to, at, value);
        if guarded {
            e.b.close_if();
        }
    }

    /// Four neighbouring channels of a row, those past the end clamped to the last; zeros past the last row if asked for.
    #[expect(clippy::too_many_arguments, reason = "what the two operands of the product differ in")]
    fn vector(
        &self,
        e: &mut Emit,
        (buffer, channels, edge): (BufferId, u32, u32),
        keep: Value,
        first: Value,
        row: Value,
        at: Value,
        zeros: bool,
    ) -> Value {
        e.b.topic("row");
        let (count, last) = (e.b.u(self.rows), e.b.u(self.rows - 1));
        let whole = self.rows.is_multiple_of(self.tile.k);
        let own = if whole { row } else { e.b.math(Math::Min, &[row, last]) };
        let position = match self.keep.is_empty() {
            true => Position::new(&self.over, own),
            false => Position::new(&self.keep, keep).and(&self.over, own),
        };
        let axes = e.layout.shape(buffer).axes.clone();
        let element = position.element(e, &axes);
        let first = e.b.add(first, at);
        let mut lanes = vec![];
        for i in 0..4 {
            let offset = e.b.u(i);
            let mut channel = e.b.add(first, offset);
            if !channels.is_multiple_of(edge) {
                let last = e.b.u(channels - 1);
                channel = e.b.math(Math::Min, &[channel, last]);
            }
            let at = e.index(buffer, channel, element);
            lanes.push(e.load(buffer, at));
        }
        let vector = e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]]);
        if whole || !zeros {
            return vector;
        }
        let (inside, zero) = (e.b.less(row, count), e.b.f(0.0));
        e.b.select(inside, vector, zero)
    }
}
