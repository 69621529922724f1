//! Sums, maxima and layers of an invocation: unrolled, or loops where terms can be indexed.

use super::{Channel, Values};
use crate::gpu::builder::Value;
use crate::gpu::channels::{is_indexable, sequence};
use crate::gpu::memory::Emit;
use crate::gpu::scalar::larger;
use raygrad_compiler::plan::region::{InstId, Weights};

/// Sums of more terms than this are loops, where the terms can be indexed.
const UNROLL: usize = 16;

impl Values<'_> {
    pub(super) fn zero(&mut self, e: &mut Emit) -> Value {
        let zero = e.b.f(0.0);
        if self.at.len() == 4 { e.b.splat(zero) } else { zero }
    }

    /// Combines `count` terms in a loop, some of them each time; term `i` is built by `term`.
    pub(super) fn fold(
        &mut self,
        e: &mut Emit,
        count: usize,
        first: Value,
        mut step: impl FnMut(&mut Self, &mut Emit, Value, Value) -> Value,
    ) -> Value {
        let unroll = [4, 2, 1].into_iter().find(|u| count.is_multiple_of(*u)).unwrap_or(1) as u32;
        let sum = e.b.var("sum", first);
        let (from, to) = (e.b.u(0), e.b.u(count as u32));
        let term = e.b.open_loop("term", from, to, unroll);
        for i in 0..unroll {
            let offset = e.b.u(i);
            let at = e.b.add(term, offset);
            let before = e.b.get(sum);
            let after = step(self, e, before, at);
            let after = if sum.is_vector() { e.b.splat(after) } else { after };
            e.b.set(sum, after);
        }
        e.b.close_loop();
        e.b.get(sum)
    }

    /// Sum of some channels.
    pub(super) fn sum(&mut self, e: &mut Emit, of: InstId, group: &[u32]) -> Value {
        if let Some((first, step)) = sequence(group)
            && group.len() > UNROLL
            && step >= 0
            && is_indexable(self.region, of)
        {
            let zero = self.zero(e);
            return self.fold(e, group.len(), zero, |values, e, sum, i| {
                let (first, step) = (e.b.u(first), e.b.u(step as u32));
                let i = e.b.mul(i, step);
                let i = e.b.add(i, first);
                let term = values.channel(e, of, Channel::Var(i));
                e.b.add(sum, term)
            });
        }
        let mut sum: Option<Value> = None;
        for c in group {
            let term = self.channel(e, of, Channel::At(*c));
            e.b.topic("sum");
            sum = Some(sum.map_or(term, |s| e.b.add(s, term)));
        }
        sum.unwrap_or_else(|| e.b.f(0.0))
    }

    pub(super) fn channel_max(&mut self, e: &mut Emit, of: InstId) -> Value {
        let channels = self.region.inst(of).channels;
        let first = self.channel(e, of, Channel::At(0));
        if channels > UNROLL && is_indexable(self.region, of) {
            let first = if self.at.len() == 4 { e.b.splat(first) } else { first };
            return self.fold(e, channels, first, |values, e, most, i| {
                let next = values.channel(e, of, Channel::Var(i));
                larger(&mut e.b, most, next)
            });
        }
        (1..channels as u32).fold(first, |most, c| {
            let next = self.channel(e, of, Channel::At(c));
            e.b.topic("largest");
            larger(&mut e.b, most, next)
        })
    }

    /// A channel of a layer, element by element: for what no tiled kernel covers.
    pub(super) fn linear(&mut self, e: &mut Emit, x: InstId, w: &Weights, channel: Channel) -> Value {
        let (buffer, first) = (w.buffer, w.first as u32);
        let weight = move |values: &mut Self, e: &mut Emit, c: Channel| {
            e.b.topic("weight");
            let (c, first) = (c.value(e), e.b.u(first));
            let c = e.b.add(c, first);
            values.load(e, buffer, Channel::Var(c))
        };
        self.contract(e, x, (w.rows, w.columns), w.transposed, channel, true, weight)
    }

    /// `sum_i x_i W_io` (or with W transposed), where `weight` gives a channel of W.
    #[expect(clippy::too_many_arguments, reason = "what the three kinds of layers differ in")]
    pub(super) fn contract(
        &mut self,
        e: &mut Emit,
        x: InstId,
        (rows, columns): (usize, usize),
        transposed: bool,
        out: Channel,
        indexable: bool,
        mut weight: impl FnMut(&mut Self, &mut Emit, Channel) -> Value,
    ) -> Value {
        let terms = if transposed { columns } else { rows };
        let columns = columns as u32;
        let at = |e: &mut Emit, i: Channel| match (i, out) {
            (Channel::At(i), Channel::At(o)) if transposed => Channel::At(o * columns + i),
            (Channel::At(i), Channel::At(o)) => Channel::At(i * columns + o),
            _ => {
                let (i, o, columns) = (i.value(e), out.value(e), e.b.u(columns));
                let (row, column) = if transposed { (o, i) } else { (i, o) };
                let row = e.b.mul(row, columns);
                Channel::Var(e.b.add(row, column))
            }
        };
        if terms > UNROLL && indexable && is_indexable(self.region, x) {
            let zero = self.zero(e);
            return self.fold(e, terms, zero, |values, e, sum, i| {
                let c = at(e, Channel::Var(i));
                let (x, w) = (values.channel(e, x, Channel::Var(i)), weight(values, e, c));
                e.b.fma(x, w, sum)
            });
        }
        let mut sum: Option<Value> = None;
        for i in 0..terms as u32 {
            let c = at(e, Channel::At(i));
            let (x, w) = (self.channel(e, x, Channel::At(i)), weight(self, e, c));
            e.b.topic("layer");
            sum = Some(match sum {
                Some(sum) => e.b.fma(x, w, sum),
                None => e.b.mul(x, w),
            });
        }
        sum.unwrap_or_else(|| e.b.f(0.0))
    }
}
