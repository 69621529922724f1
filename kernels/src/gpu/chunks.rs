//! Partial results of chunks of rows, combined in order by a kernel of their own.

use super::builder::Value;
use super::layout::{Layout, Limits};
use super::memory::Emit;
use super::reduce::{combine, neutral};
use super::{Kernel, LowerError};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::BufferId;

/// Chunks that are read before they are combined.
const TOGETHER: u32 = 8;

/// Lanes of a buffer from `first` on, as one stretch of a chunk's partial results.
pub(super) struct End {
    pub buffer: BufferId,
    pub first: usize,
    pub lanes: usize,
    /// If not all lie side by side: how many do, and how far from each other such lines begin.
    pub lines: Option<(usize, usize)>,
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
            Some(m)
                if (m.buffer, m.first + m.lanes, m.kind) == (end.buffer, end.first, end.kind)
                    && (m.lines, end.lines) == (None, None) =>
            {
                m.lanes += end.lanes
            }
            _ => merged.push(End { ..*end }),
        }
    }
    let (mut e, number) = Emit::over(layout, limits, per_chunk as u64)?;
    let sum = |e: &mut Emit, kind: Reduction| {
        let start = neutral(&mut e.b, kind);
        let total = e.b.var("total", start);
        // Several are on their way from memory while they are combined in order.
        let some = |e: &mut Emit, first: Value, count: u32| {
            let loads: Vec<Value> = (0..count)
                .map(|i| {
                    let (offset, stride) = (e.b.u(i), e.b.u(per_chunk as u32));
                    let chunk = e.b.add(first, offset);
                    let at = e.b.mul(chunk, stride);
                    let at = e.b.add(at, number);
                    e.load(partials, at)
                })
                .collect();
            let so_far = e.b.get(total);
            let after = loads.into_iter().fold(so_far, |sum, next| combine(&mut e.b, kind, sum, next));
            e.b.set(total, after);
        };
        let rest = chunks as u32 % TOGETHER;
        let (from, to) = (e.b.u(0), e.b.u(chunks as u32 - rest));
        if chunks as u32 >= TOGETHER {
            let chunk = e.b.open_loop("chunk", from, to, TOGETHER);
            some(e, chunk, TOGETHER);
            e.b.close_loop();
        }
        some(e, to, rest);
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
        let mut at = e.b.sub(number, before);
        if let Some((lanes, apart)) = end.lines {
            let (lanes, apart) = (e.b.u(lanes as u32), e.b.u(apart as u32));
            let (line, lane) = (e.b.div(at, lanes), e.b.rem(at, lanes));
            let before = e.b.mul(line, apart);
            at = e.b.add(before, lane);
        }
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
