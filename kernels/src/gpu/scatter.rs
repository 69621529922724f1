//! Sums into slots that an index names, without atomics: every slot looks at every row of a chunk.

use super::builder::Var;
use super::channels::is_indexable;
use super::chunks::{End, finish};
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::position::Position;
use super::reduce::MAX_CHUNKS;
use super::{Kernel, LowerError};
use naga::{BinaryOperator as Op, MathFunction as Math};
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, Store};
use raygrad_compiler::scalar::DType;

/// Rows of a chunk, at most: below the iterations that old software drivers stop at.
const CHUNK_ROWS: usize = 16384;
/// Channels from which a channel is a dimension of the dispatch.
const BY_LANE: usize = 4;

/// Kernels for a region with one `Scatter` store.
pub(super) fn kernels(
    layout: &mut Layout,
    limits: Limits,
    name: &str,
    region: &Region,
) -> Result<Vec<Kernel>, LowerError> {
    let Some(Store::Scatter { value, index, axis, buffer }) = region.stores.first() else { return Ok(vec![]) };
    let channels = region.inst(*value).channels;
    let by_lane = channels >= BY_LANE && is_indexable(region, *value);
    let slots = layout.shape(*buffer).axes.clone();
    let over = region.domain.minus(&slots);
    let (rows, lanes) = (over.elements(), slots.elements() * channels);
    let invocations = if by_lane { lanes } else { slots.elements() };
    // Enough chunks for a full device, but a chunk has some rows, and partial results some bound.
    let wanted = limits.invocations().div_ceil(invocations).min(rows.div_ceil(64)).min(MAX_CHUNKS);
    let chunks = wanted.max(rows.div_ceil(CHUNK_ROWS));
    let per_chunk = rows.div_ceil(chunks);
    let chunks = rows.div_ceil(per_chunk);
    let work = Scatter { region, value: *value, index: *index, axis, slots, over, channels, by_lane };
    if chunks == 1 {
        return Ok(vec![work.kernel(layout, limits, name, *buffer, per_chunk, 1)?]);
    }
    let partials = layout.scratch("partial", Shape::of(Axes::none(), chunks * lanes, DType::F32))?;
    let first = work.kernel(layout, limits, name, partials, per_chunk, chunks)?;
    let end = End { buffer: *buffer, first: 0, lanes, lines: None, kind: Reduction::Sum };
    let last = finish(layout, limits, &format!("{name}.finish"), partials, chunks, &[end])?;
    Ok(vec![first, last])
}

struct Scatter<'r> {
    region: &'r Region,
    value: InstId,
    index: InstId,
    axis: &'r Axis,
    slots: Axes,
    over: Axes,
    channels: usize,
    by_lane: bool,
}

impl Scatter<'_> {
    fn kernel(
        &self,
        layout: &Layout,
        limits: Limits,
        name: &str,
        to: BufferId,
        per_chunk: usize,
        chunks: usize,
    ) -> Result<Kernel, LowerError> {
        let slots = self.slots.elements();
        let planes = if self.by_lane { self.channels } else { 1 };
        let (mut e, number) = Emit::over(layout, limits, (chunks * planes * slots) as u64)?;
        let (per_chunk_value, per_plane) = (e.b.u((planes * slots) as u32), e.b.u(slots as u32));
        let (chunk, lane) = (e.b.div(number, per_chunk_value), e.b.rem(number, per_chunk_value));
        let (channel, element) = (e.b.div(lane, per_plane), e.b.rem(lane, per_plane));
        let here = Position::new(&self.slots, element);
        let slot = here.coordinate(&mut e, self.axis);
        let kept = self.slots.without(self.axis);
        let kept_element = here.element(&mut e, &kept);

        let zero = e.b.f(0.0);
        let count = if self.by_lane { 1 } else { self.channels };
        let totals: Vec<Var> = (0..count).map(|_| e.b.var("total", zero)).collect();
        let length = e.b.u(per_chunk as u32);
        let first = e.b.mul(chunk, length);
        let end = e.b.add(first, length);
        let rows = e.b.u(self.over.elements() as u32);
        let end = e.b.math(Math::Min, &[end, rows]);
        let row = e.b.open_loop("row", first, end, 1);
        let position = Position::new(&kept, kept_element).and(&self.over, row);
        let mut values = Values::new(self.region, vec![position]);
        let index = values.channel(&mut e, self.index, Channel::At(0));
        let last = e.b.u(self.axis.size() as u32 - 1);
        let index = e.b.math(Math::Min, &[index, last]);
        let hit = e.b.binary(Op::Equal, index, slot);
        e.b.open_if(hit);
        for (c, total) in totals.iter().enumerate() {
            let c = if self.by_lane { Channel::Var(channel) } else { Channel::At(c as u32) };
            let next = values.channel(&mut e, self.value, c);
            let so_far = e.b.get(*total);
            let sum = e.b.add(so_far, next);
            e.b.set(*total, sum);
        }
        e.b.close_if();
        e.b.close_loop();

        let lanes = e.b.u((self.channels * slots) as u32);
        let block = e.b.mul(chunk, lanes);
        for (c, total) in totals.iter().enumerate() {
            let c = if self.by_lane { channel } else { e.b.u(c as u32) };
            let plane = e.b.mul(c, per_plane);
            let at = e.b.add(plane, element);
            let at = e.b.add(block, at);
            let value = e.b.get(*total);
            e.store(to, at, value);
        }
        e.finish(name)
    }
}
