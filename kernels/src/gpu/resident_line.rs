//! What a workgroup of a resident network carries along a line: scans and sums so far.

use super::builder::{Value, Var};
use super::memory::Emit;
use super::phases::Phase;
use super::reduce::{combine, neutral};
use super::resident::{First, Network, PER_ROW};
use super::room::SMALLEST;
use naga::MathFunction as Math;
use raygrad_compiler::fuse::LINE_CHANNELS;
use raygrad_compiler::plan::region::{InstId, Store};

/// What an invocation carries along a line, a variable a channel that it has.
#[derive(Default)]
pub(super) struct Carried {
    pub sums: Vec<(InstId, Var)>,
    totals: Vec<(Store, Var)>,
}

impl Network {
    pub fn carried(&self, e: &mut Emit) -> Carried {
        let (zero, region) = (e.b.f(0.0), &self.phases.region);
        let scans = self.phases.all.iter().filter_map(|p| if let Phase::Scan(id) = p { Some(*id) } else { None });
        let sums = scans.map(|id| (id, e.b.var("before", zero))).collect();
        let mut totals = vec![];
        for store in &region.stores {
            if let Store::Reduce { kind, .. } = store {
                let first = neutral(&mut e.b, *kind);
                totals.push((store.clone(), e.b.var("total", first)));
            }
        }
        Carried { sums, totals }
    }

    /// An invocation a channel runs along the tile, with what it carries from the tiles before.
    pub fn scan(&self, e: &mut Emit, id: InstId, first: First, carried: &Carried) {
        let region = &self.phases.region;
        let term = self.places[&region.inst(id).inputs[0]];
        let Some((_, sum)) = carried.sums.iter().find(|s| s.0 == id) else { return };
        e.if_below(e.invocation, Some(region.inst(id).channels as u32), |e| {
            let channel = e.invocation;
            let (none, all) = (e.b.u(0), e.b.u(self.tile));
            let own = e.b.open_loop("own_row", none, all, 1);
            let before = e.b.get(*sum);
            let term = self.held(e, term, channel, first, own);
            let all: Vec<_> = self.buffers(id).into_iter().map(|buffer| (buffer, channel, before)).collect();
            self.set(e, &all, first, own);
            let after = e.b.add(before, term);
            e.b.set(*sum, after);
            e.b.close_loop();
        });
    }

    /// An invocation a channel combines the rows of a tile.
    pub fn totals(&self, e: &mut Emit, first: First, carried: &Carried) {
        self.each_total(e, carried, |e, store, total, channel| {
            let Store::Reduce { kind, value, .. } = store else { return };
            let (none, all) = (e.b.u(0), e.b.u(self.tile));
            let mut end = all;
            if self.is_ragged() {
                let count = e.b.u(self.rows.elements() as u32);
                let left = e.b.sub(count, first.row);
                end = e.b.math(Math::Min, &[all, left]);
            }
            let own = e.b.open_loop("own_row", none, end, 1);
            let next = self.held(e, self.places[value], channel, first, own);
            let so_far = e.b.get(total);
            let next = combine(&mut e.b, *kind, so_far, next);
            e.b.set(total, next);
            e.b.close_loop();
        });
    }

    /// Writes what was combined over the line.
    pub fn finish(&self, e: &mut Emit, first: First, carried: &Carried) {
        self.each_total(e, carried, |e, store, total, channel| {
            let axes = e.layout.shape(store.buffer()).axes.clone();
            let element = self.batch_element(e, first, &axes);
            let (at, value) = (e.index(store.buffer(), channel, element), e.b.get(total));
            e.store(store.buffer(), at, value);
        });
    }

    /// Does something for every channel of what is combined, in an invocation each: different ones for different stores, as far
    /// as they go.
    fn each_total(&self, e: &mut Emit, carried: &Carried, act: impl Fn(&mut Emit, &Store, Var, Value)) {
        let mut before = 0;
        for (store, total) in &carried.totals {
            let channels = self.phases.region.inst(store.values()[0]).channels as u32;
            let first = e.b.u(before);
            // Invocations before the first one wrap around to large numbers.
            let channel = e.b.sub(e.invocation, first);
            e.if_below(channel, Some(channels), |e| act(e, store, *total, channel));
            before = (before + channels) % (PER_ROW * SMALLEST - LINE_CHANNELS as u32);
        }
    }
}
