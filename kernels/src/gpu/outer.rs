//! Sums of outer products, the gradients of layers' weights: a tiled product over rows, in chunks of rows that a second
//! kernel sums in order.

use super::builder::Value;
use super::chunks::{End, finish};
use super::give::Place;
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::position::{Position, is_run};
use super::product::{Along, Operand, multiply, plus};
use super::tile::{Tile, split};
use super::{Kernel, LowerError};
use naga::MathFunction as Math;
use raygrad_compiler::graph::{Axes, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;
use std::ops::Range;

/// Sums of a tile that leave a processor no room for another.
const WHOLE: u32 = 128 * 256;
/// Workgroups for a processor: of those, of large tiles, and of smaller ones.
const EACH_WHOLE: usize = 1;
const EACH: usize = 2;
const EACH_SMALL: usize = 4;
/// Rows from which two stages are on their way.
const LONG: usize = 1 << 14;
/// Rows of a chunk, at least.
const CHUNK_ROWS: usize = 64;
/// Chunks, at most.
const MAX_CHUNKS: usize = 256;

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
    let (rows, kept) = (over.elements(), keep.elements());
    let side = |buffer: BufferId, channels: usize| Side { buffer, channels: 0..channels };
    let (inputs, outputs) = (region.inst(*x).channels, region.inst(*d).channels);
    let products = kept * most_chunks(rows);
    // Four neighbouring m are one vector, and so should neighbouring outputs be; but narrow tiles are narrow along n, and none
    // should be padded much.
    let time = |m, n| Tile::timed(&limits, (m, n, rows), products).1;
    let swapped = outputs > 32 && (inputs <= 32 || time(outputs, inputs) < 1.2 * time(inputs, outputs));
    let (x, d) = (side(*x_buffer, inputs), side(*d_buffer, outputs));
    let (m, n) = if swapped { (d, x) } else { (x, d) };
    let outer = Outer { outputs, rows, buffer: *buffer, keep, over };
    let sizes = (m.channels.len(), n.channels.len(), rows);
    let terms = rows.div_ceil(most_chunks(rows));
    let mut parts: Vec<Part> = vec![];
    let m_parts = split(&limits, (sizes.1, sizes.0, rows), products, terms);
    for n_channels in split(&limits, sizes, products, terms) {
        for m_channels in &m_parts {
            let (m, n) = (m.part(m_channels.clone()), n.part(n_channels.clone()));
            let turned = m.channels.len() < 32;
            let (m, n) = if turned { (n, m) } else { (m, n) };
            let mut tile = Tile::of(&limits, (m.channels.len(), n.channels.len(), rows), products);
            // Both operands come from far, and the sums are long.
            tile.ahead = if tile.matrices.is_some() && rows >= LONG { 2 } else { 1 };
            parts.push(Part::new(&limits, &outer, m, n, swapped != turned, tile));
        }
    }
    let several = parts.len() > 1;
    let mut all = vec![];
    for (i, part) in parts.iter().enumerate() {
        let name = if several { format!("{name}.{}", i + 1) } else { name.to_string() };
        all.extend(outer.kernels(layout, limits, &name, part)?);
    }
    Ok(all)
}

/// Channels of a factor of the outer product.
#[derive(Clone)]
struct Side {
    buffer: BufferId,
    channels: Range<usize>,
}

impl Side {
    fn part(&self, channels: Range<usize>) -> Side {
        Side { channels, ..self.clone() }
    }
}

/// What one kernel computes: some channels of either side, in chunks of rows.
struct Part {
    m: Side,
    n: Side,
    /// Whether m counts outputs, and n inputs.
    swapped: bool,
    tile: Tile,
    /// Rows of a chunk.
    per_chunk: usize,
    chunks: usize,
}

impl Part {
    fn new(limits: &Limits, outer: &Outer, m: Side, n: Side, swapped: bool, tile: Tile) -> Part {
        let tiles = m.channels.len().div_ceil(tile.m as usize) * n.channels.len().div_ceil(tile.n as usize);
        let each = match () {
            _ if tile.m * tile.n >= WHOLE => EACH_WHOLE,
            _ if tile.invocations() > 64 => EACH,
            _ => EACH_SMALL,
        };
        let enough = each * limits.workgroups as usize;
        let wanted = enough.div_ceil(tiles * outer.keep.elements()).min(most_chunks(outer.rows));
        let per_chunk = outer.rows.div_ceil(wanted).next_multiple_of(tile.turn() as usize);
        Part { m, n, swapped, tile, per_chunk, chunks: outer.rows.div_ceil(per_chunk) }
    }

    fn inputs(&self) -> &Range<usize> {
        if self.swapped { &self.n.channels } else { &self.m.channels }
    }

    fn outputs(&self) -> &Range<usize> {
        if self.swapped { &self.m.channels } else { &self.n.channels }
    }
}

/// Chunks that so many rows are cut into, at most.
fn most_chunks(rows: usize) -> usize {
    rows.div_ceil(CHUNK_ROWS).min(MAX_CHUNKS)
}

struct Outer {
    outputs: usize,
    rows: usize,
    buffer: BufferId,
    keep: Axes,
    over: Axes,
}

/// Where the products of some channels go: to lane `((input - inputs) line + output - outputs) kept + keep` of a chunk's block.
struct Block {
    buffer: BufferId,
    /// The first channels.
    inputs: u32,
    outputs: u32,
    /// Outputs from an input to the next.
    line: u32,
    /// Lanes of a chunk.
    lanes: u32,
}

impl Outer {
    /// The kernel of a part, and the one that sums its chunks.
    fn kernels(&self, layout: &mut Layout, limits: Limits, name: &str, part: &Part) -> Result<Vec<Kernel>, LowerError> {
        let kept = self.keep.elements();
        let (inputs, outputs) = (part.inputs(), part.outputs());
        if part.chunks == 1 {
            let line = self.outputs as u32;
            let block = Block { buffer: self.buffer, inputs: 0, outputs: 0, line, lanes: 0 };
            return Ok(vec![self.kernel(layout, limits, name, part, &block)?]);
        }
        let lanes = inputs.len() * outputs.len() * kept;
        let block = Block {
            buffer: layout.scratch("partial", Shape::of(Axes::none(), part.chunks * lanes, DType::F32))?,
            inputs: inputs.start as u32,
            outputs: outputs.start as u32,
            line: outputs.len() as u32,
            lanes: lanes as u32,
        };
        let first = self.kernel(layout, limits, name, part, &block)?;
        let first_lane = (inputs.start * self.outputs + outputs.start) * kept;
        let lines = Some((outputs.len() * kept, self.outputs * kept)).filter(|(own, all)| own < all);
        let end = End { buffer: self.buffer, first: first_lane, lanes, lines, kind: Reduction::Sum };
        let last = finish(layout, limits, &format!("{name}.finish"), block.buffer, part.chunks, &[end])?;
        Ok(vec![first, last])
    }

    fn kernel(
        &self,
        layout: &Layout,
        limits: Limits,
        name: &str,
        part: &Part,
        block: &Block,
    ) -> Result<Kernel, LowerError> {
        let tile = part.tile;
        let kept = self.keep.elements() as u32;
        let tiles_m = (part.m.channels.len() as u32).div_ceil(tile.m);
        let tiles_n = (part.n.channels.len() as u32).div_ceil(tile.n);
        let chunks = part.chunks as u32;
        let groups = chunks as u64 * kept as u64 * tiles_m as u64 * tiles_n as u64;
        let mut e = Emit::new(layout, limits, groups, tile.invocations())?.with_vectors(true);
        if tile.ahead > 1 {
            e = e.in_order();
        }
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
        let (keep, chunk) = (next(&mut e, kept), next(&mut e, chunks));
        let first = |e: &mut Emit, side: &Side, number: Value, size: u32| {
            let (size, before) = (e.b.u(size), e.b.u(side.channels.start as u32));
            let first = e.b.mul(number, size);
            e.b.add(first, before)
        };
        let (first_m, first_n) = (first(&mut e, &part.m, tile_m, tile.m), first(&mut e, &part.n, tile_n, tile.n));
        e.b.name(first_m, "first_m");
        e.b.name(first_n, "first_n");
        let (length, rows) = (e.b.u(part.per_chunk as u32), e.b.u(self.rows as u32));
        let from = e.b.mul(chunk, length);
        let end = e.b.add(from, length);
        let to = e.b.math(Math::Min, &[end, rows]);
        let lanes = e.b.u(block.lanes);
        let chunk_first = e.b.mul(chunk, lanes);
        multiply(
            &mut e,
            tile,
            (from, to),
            Operand {
                along: Along::K,
                load: &mut |e, k, at| self.rows(e, (&part.m, tile.m, tile.turn()), keep, first_m, k, at, true),
            },
            Operand {
                along: Along::K,
                load: &mut |e, k, at| self.rows(e, (&part.n, tile.n, tile.turn()), keep, first_n, k, at, false),
            },
            &mut |e: &mut Emit, places: &[Place], sums: &[Value]| {
                for (place, sums) in places.iter().zip(sums) {
                    let (m, n) = (e.b.add(first_m, place.m), e.b.add(first_n, place.n));
                    let guarded = !part.n.channels.len().is_multiple_of(tile.n as usize);
                    let end = guarded.then_some(part.n.channels.end as u32);
                    e.if_below(n, end, |e| self.write(e, (part, block), (m, n), *sums, (keep, chunk_first)));
                }
            },
        );
        e.finish(name)
    }

    /// Lane of the product of input and output channels in a chunk's block.
    fn lane(
        &self,
        e: &mut Emit,
        (part, block): (&Part, &Block),
        (m, n): (Value, Value),
        (keep, chunk_first): (Value, Value),
    ) -> Value {
        let (input, output) = if part.swapped { (n, m) } else { (m, n) };
        let (inputs, outputs) = (e.b.u(block.inputs), e.b.u(block.outputs));
        let (input, output) = (e.b.sub(input, inputs), e.b.sub(output, outputs));
        let (line, kept) = (e.b.u(block.line), e.b.u(self.keep.elements() as u32));
        let channel = e.b.mul(input, line);
        let channel = e.b.add(channel, output);
        let at = e.b.mul(channel, kept);
        let at = e.b.add(at, keep);
        e.b.add(at, chunk_first)
    }

    /// Writes four neighbouring m of one n.
    fn write(&self, e: &mut Emit, at: (&Part, &Block), (m, n): (Value, Value), sum: Value, place: (Value, Value)) {
        let (part, block) = at;
        let Range { start, end } = part.m.channels.clone();
        let whole = (end - start).is_multiple_of(part.tile.m as usize);
        let guard = (!whole).then_some(end as u32);
        let ends = [start as u32, end as u32, block.outputs, block.line, block.lanes];
        let fours = ends.iter().all(|x| x.is_multiple_of(4));
        if part.swapped && self.keep.elements() == 1 && fours {
            e.if_below(m, guard, |e| {
                let lane = self.lane(e, at, (m, n), place);
                e.store_four(block.buffer, lane, sum);
            });
            return;
        }
        for lane in 0..4 {
            let m = plus(e, m, lane);
            e.if_below(m, guard, |e| {
                let to = self.lane(e, at, (m, n), place);
                let value = e.b.component(sum, lane);
                e.store(block.buffer, to, value);
            });
        }
    }

    /// A channel of four neighbouring rows; channels past the end are clamped to the last, rows past the end too, or zeros
    /// if asked for.
    #[expect(clippy::too_many_arguments, reason = "what the two operands of the product differ in")]
    fn rows(
        &self,
        e: &mut Emit,
        (side, edge, depth): (&Side, u32, u32),
        keep: Value,
        first: Value,
        row: Value,
        at: Value,
        zeros: bool,
    ) -> Value {
        e.b.topic("row");
        let whole = self.rows.is_multiple_of(depth as usize);
        let mut channel = e.b.add(first, at);
        if !side.channels.len().is_multiple_of(edge as usize) {
            let last = e.b.u(side.channels.end as u32 - 1);
            channel = e.b.math(Math::Min, &[channel, last]);
        }
        let axes = e.layout.shape(side.buffer).axes.clone();
        let index = |e: &mut Emit, row: Value| {
            let position = match self.keep.is_empty() {
                true => Position::new(&self.over, row),
                false => Position::new(&self.keep, keep).and(&self.over, row),
            };
            let element = position.element(e, &axes);
            e.index(side.buffer, channel, element)
        };
        let all = e.b.u(self.rows as u32);
        if self.rows.is_multiple_of(4) && is_run(&axes, &self.over) {
            let last = e.b.u(self.rows as u32 - 4);
            let own = if whole { row } else { e.b.math(Math::Min, &[row, last]) };
            let at = index(e, own);
            let vector = e.load_four(side.buffer, at);
            if whole || !zeros {
                return vector;
            }
            let (inside, zero) = (e.b.less(row, all), e.b.f(0.0));
            return e.b.select(inside, vector, zero);
        }
        let mut lanes = vec![];
        for i in 0..4 {
            let (offset, last) = (e.b.u(i), e.b.u(self.rows as u32 - 1));
            let row = e.b.add(row, offset);
            let own = if whole { row } else { e.b.math(Math::Min, &[row, last]) };
            let at = index(e, own);
            let value = e.load(side.buffer, at);
            let inside = e.b.less(row, all);
            let zero = e.b.f(0.0);
            lanes.push(if whole || !zeros { value } else { e.b.select(inside, value, zero) });
        }
        e.b.vector([lanes[0], lanes[1], lanes[2], lanes[3]])
    }
}
