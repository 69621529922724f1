//! Partial results of chunks of rows, combined in order by a kernel of their own.

use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::reduce::{combine, neutral};
use super::{Kernel, LowerError};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::BufferId;

/// Lanes `first..first + lanes` of a buffer, as one stretch of a chunk's partial results.
pub(super) struct End {
    pub buffer: BufferId,
    pub first: usize,
    pub lanes: usize,
    pub kind: Reduction,
}

/// Combines chunks: partial results lie chunk by chunk, each chunk with the stretches `ends` one after another.
pub(super) fn finish(
    layout: &Layout,
    limits: Limits,
    name: &str,
    partials: BufferId,
    chunks: usize,
    ends: &[End],
) -> Result<Kernel, LowerError> {
    let per_chunk: usize = ends.iter().map(|x| x.lanes).sum();
    // Neighbouring stretches of one buffer are one.
    let mut merged: Vec<End> = vec![];
    for end in ends {
        match merged.last_mut() {
            Some(m) if m.buffer == end.buffer && m.first + m.lanes == end.first && m.kind == end.kind => {
                m.lanes += end.lanes
            }
            _ => merged.push(End { ..*end }),
        }
    }
    let (mut e, number) = Emit::over(layout, limits, per_chunk as u64)?;
    let sum = |e: &mut Emit, kind: Reduction| {
        let start = neutral(&mut e.b, kind);
        let total = e.b.var("total", start);
        let (from, to) = (e.b.u(0), e.b.u(chunks as u32));
        let chunk = e.b.open_loop("chunk", from, to, 1);
        let stride = e.b.u(per_chunk as u32);
        let at = e.b.mul(chunk, stride);
        let at = e.b.add(at, number);
        let next = e.load(partials, at);
        let so_far = e.b.get(total);
        let next = combine(&mut e.b, kind, so_far, next);
        e.b.set(total, next);
        e.b.close_loop();
        e.b.get(total)
    };
    let mut from = 0;
    for (i, end) in merged.iter().enumerate() {
        let last = i + 1 == merged.len();
        if !last {
            let to = e.b.u((from + end.lanes) as u32);
            let here = e.b.less(number, to);
            e.b.open_if(here);
        }
        let total = sum(&mut e, end.kind);
        let (before, first) = (e.b.u(from as u32), e.b.u(end.first as u32));
        let at = e.b.sub(number, before);
        let at = e.b.add(at, first);
        e.store(end.buffer, at, total);
        if !last {
            e.b.open_else();
        }
        from += end.lanes;
    }
    (1..merged.len()).for_each(|_| e.b.close_if());
    e.finish(name)
}
