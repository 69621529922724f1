//! Long element-wise work in stages.
//!
//! Products of small matrices in a row (the gradient of an eigen-decomposition has dozens) are thousands of instructions
//! when an invocation computes all channels, and as many more when every channel is computed by itself from the start. So
//! a sum of channels that feeds another one is written to memory, and a stage computes channels each by itself from there.
//! So does a value of many channels that is written anyway, before what sums or picks of them.

use super::LowerError;
use super::elements::{self, closure, own_cost};
use super::layout::Layout;
use super::regions::{replace_by_load, written_by};
use raygrad_compiler::graph::Shape;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store};

/// Instructions for an element from which work is staged.
const LONG: usize = 1500;
/// Channels from which a value is worth a stage.
const WIDE: usize = 8;

/// The region as stages, in order: one if it is not long.
pub(super) fn stages(layout: &mut Layout, region: Region) -> Result<Vec<Region>, LowerError> {
    let values: Vec<InstId> = region.stores.iter().flat_map(|s| s.values()).collect();
    let needed = closure(&region, values.iter().copied());
    let body = || (0..region.body.len()).filter(|i| needed[*i]);
    let cost: usize = body().map(|i| own_cost(&region, i) * region.body[i].channels).sum();
    if cost <= LONG {
        return Ok(vec![region]);
    }
    // The stage in which a value is there. Contractions that another contraction needs go through memory.
    let contracts = |i: usize| own_cost(&region, i) > 1 && sums_channels(&region.body[i].op);
    let mut through_memory = vec![false; region.body.len()];
    let mut sources: Vec<Vec<usize>> = vec![vec![]; region.body.len()];
    for i in body() {
        let mut from: Vec<usize> =
            region.body[i].inputs.iter().flat_map(|x| sources[x.0 as usize].iter().copied()).collect();
        from.sort();
        from.dedup();
        if contracts(i) {
            from.iter().filter(|s| region.body[**s].channels >= WIDE).for_each(|s| through_memory[*s] = true);
            from = vec![i];
        }
        sources[i] = from;
    }
    own_stages(&region).iter().for_each(|value| through_memory[value.0 as usize] = true);
    let mut stage = vec![0usize; region.body.len()];
    for i in body() {
        let after = |x: &InstId| stage[x.0 as usize] + usize::from(through_memory[x.0 as usize]);
        stage[i] = region.body[i].inputs.iter().map(after).max().unwrap_or(0);
    }
    let last = values.iter().map(|v| stage[v.0 as usize]).max().unwrap_or(0);
    let mut rest = region.clone();
    let mut all = vec![];
    for now in 0..last {
        let mut own = Region { stores: vec![], ..rest.clone() };
        let mut written: Vec<(InstId, BufferId)> = vec![];
        for i in body().filter(|i| through_memory[*i] && stage[*i] == now) {
            let (value, inst) = (InstId(i as u32), &region.body[i]);
            let shape = Shape::of(inst.axes.clone(), inst.channels, inst.dtype);
            let whole = inst.axes == region.domain;
            let shape = if whole { shape } else { shape.with_axes(region.domain.clone()) };
            let buffer = match written_by(&region, value) {
                Some(buffer) => buffer,
                None => layout.scratch(&inst.label, shape)?,
            };
            rest.stores.retain(|s| s.buffer() != buffer);
            own.stores.push(Store::Write { value, buffer });
            written.push((value, buffer));
        }
        for (value, buffer) in written {
            replace_by_load(layout, &mut rest, value, buffer);
        }
        if !own.stores.is_empty() {
            all.push(own.swept());
        }
    }
    all.push(rest.swept());
    Ok(all)
}

/// Written values of few elements and more channels than are unrolled, of which a value with other channels is made: an
/// invocation that computed both would go through all channels one by one.
fn own_stages(region: &Region) -> Vec<InstId> {
    if region.domain.elements() >= elements::MANY {
        return vec![];
    }
    let of = |store: &Store| store.values()[0];
    let channels = |store: &Store| region.inst(of(store)).channels;
    let needed = |value: InstId, by: &Store| closure(region, by.values())[value.0 as usize];
    let staged = |s: &&Store| {
        channels(s) > elements::WIDE
            && written_by(region, of(s)).is_some()
            && region.stores.iter().any(|by| channels(by) != channels(s) && needed(of(s), by))
    };
    region.stores.iter().filter(staged).map(of).collect()
}

/// Eigen-decompositions that a scan's region needs and that need no scan themselves: as a stage before it, and the rest.
/// An invocation of a scan runs along a whole line. It would decompose one matrix after the other, and again for every
/// shift; old software drivers (llvmpipe) even stop an invocation for good after 65535 rounds of all its loops.
pub(super) fn before_scan(layout: &mut Layout, region: Region) -> Result<(Option<Region>, Region), LowerError> {
    let Some(inner) = region.inner.clone() else { return Ok((None, region)) };
    let mut scanned = vec![false; region.body.len()];
    let mut found = vec![];
    for id in region.ids() {
        let (at, inst) = (id.0 as usize, region.inst(id));
        scanned[at] = matches!(inst.op, RegionOp::CumSum { .. } | RegionOp::Shift { .. })
            || inst.inputs.iter().any(|i| scanned[i.0 as usize]);
        if matches!(inst.op, RegionOp::SymEig { .. }) && !scanned[at] && inst.axes.contains(&inner) {
            found.push(id);
        }
    }
    if found.is_empty() {
        return Ok((None, region));
    }
    let mut own = Region { stores: vec![], whole: false, ..region.clone() };
    let mut rest = region;
    for value in found {
        let inst = rest.inst(value);
        let shape = Shape::of(rest.domain.clone(), inst.channels, inst.dtype);
        let buffer = layout.scratch(&inst.label, shape)?;
        own.stores.push(Store::Write { value, buffer });
        replace_by_load(layout, &mut rest, value, buffer);
    }
    Ok((Some(own.swept()), rest.swept()))
}

fn sums_channels(op: &RegionOp) -> bool {
    matches!(op, RegionOp::ChannelSum(_) | RegionOp::RowLinear { .. } | RegionOp::ChannelMax | RegionOp::SymEig { .. })
}
