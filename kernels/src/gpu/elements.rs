//! Kernels that write values element by element.
//!
//! The stores of a region fall into components that share computed values. A component runs either row by row (an
//! invocation computes all channels of one element, unrolled) or lane by lane (an invocation computes one channel of one
//! element, indexed): rows where channels share work, lanes where elements are few or channels many. The components of
//! a region are segments of one kernel.

use super::builder::Value;
use super::channels::is_indexable;
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, WORKGROUP};
use super::position::Position;
use super::{Kernel, LowerError};
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;

/// Elements from which rows alone fill a device.
pub(super) const MANY: usize = 4096;
/// Most channels that are unrolled.
pub(super) const WIDE: usize = 64;
/// Instructions from which unrolling is worth avoiding.
const LONG: usize = 2000;
/// Elements from which four a time still fill a device.
const MANY_FOURS: usize = 1 << 16;
/// Instructions of an element up to which an invocation takes four.
const SIMPLE: usize = 200;
/// Values that are computed before they are written.
const TOGETHER: usize = 16;
/// Most segments of one kernel.
const MAX_SEGMENTS: usize = 24;

/// Stores that share an invocation.
struct Component {
    stores: Vec<usize>,
    by_lane: bool,
    /// Unrolled instructions, about.
    size: usize,
}

/// Which instructions `roots` need.
pub(super) fn closure(region: &Region, roots: impl IntoIterator<Item = InstId>) -> Vec<bool> {
    let mut needed = vec![false; region.body.len()];
    roots.into_iter().for_each(|r| needed[r.0 as usize] = true);
    for at in (0..region.body.len()).rev() {
        if needed[at] {
            region.body[at].inputs.iter().for_each(|i| needed[i.0 as usize] = true);
        }
    }
    needed
}

/// Scalar instructions for one channel of an instruction, its operands given.
pub(super) fn own_cost(region: &Region, at: usize) -> usize {
    let inst = &region.body[at];
    match &inst.op {
        RegionOp::Map(p) => p.flops() as usize,
        RegionOp::ChannelSum(groups) => groups.iter().map(Vec::len).sum::<usize>().div_ceil(inst.channels),
        RegionOp::ChannelMax => region.inst(inst.inputs[0]).channels,
        RegionOp::Linear(w) => {
            if w.transposed {
                w.columns
            } else {
                w.rows
            }
        }
        RegionOp::RowLinear { rows, columns, transposed } => {
            if *transposed {
                *columns
            } else {
                *rows
            }
        }
        RegionOp::SymEig { n } => 60 * n,
        _ => 1,
    }
}

/// Scalar instructions for one channel, operands included, each computed for it alone.
pub(super) fn lane_costs(region: &Region) -> Vec<usize> {
    let mut costs: Vec<usize> = vec![];
    for (at, inst) in region.body.iter().enumerate() {
        let own = own_cost(region, at);
        let times = match inst.op {
            RegionOp::ChannelSum(_) | RegionOp::ChannelMax | RegionOp::Linear(_) | RegionOp::RowLinear { .. } => own,
            _ => 1,
        };
        let operands = inst.inputs.iter().map(|i| costs[i.0 as usize].saturating_mul(times));
        costs.push(operands.fold(own, usize::saturating_add));
    }
    costs
}

fn components(region: &Region) -> Vec<Component> {
    let count = region.stores.len();
    let closures: Vec<Vec<bool>> = region.stores.iter().map(|s| closure(region, s.values())).collect();
    let written: Vec<_> = region.stores.iter().map(Store::buffer).collect();
    let elements = region.domain.elements();
    let mut group: Vec<usize> = (0..count).collect();
    let join = |group: &mut Vec<usize>, a: usize, b: usize| {
        let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    };
    for a in 0..count {
        for b in a + 1..count {
            let shared = (0..region.body.len()).any(|i| {
                let inst = &region.body[i];
                let computed = !matches!(inst.op, RegionOp::Load(_) | RegionOp::Const(_) | RegionOp::Index(_));
                closures[a][i]
                    && closures[b][i]
                    && computed
                    && (inst.channels > 1 || elements >= MANY && own_cost(region, i) > 16)
            });
            // What is replaced in place must be read by the invocation that replaces it.
            let reads = |x: usize, y: usize| {
                (0..region.body.len())
                    .any(|i| closures[x][i] && matches!(&region.body[i].op, RegionOp::Load(l) if *l == written[y]))
            };
            if shared || reads(a, b) || reads(b, a) {
                join(&mut group, a, b);
            }
        }
    }
    let costs = lane_costs(region);
    let mut all: Vec<Component> = vec![];
    for g in 0..count {
        let stores: Vec<usize> = (0..count).filter(|s| group[*s] == g).collect();
        if stores.is_empty() {
            continue;
        }
        let values: Vec<InstId> = stores.iter().flat_map(|s| region.stores[*s].values()).collect();
        let needed = closure(region, values.iter().copied());
        let row: usize = (0..region.body.len())
            .filter(|i| needed[*i])
            .map(|i| own_cost(region, i).saturating_mul(region.body[i].channels))
            .sum();
        let lane: usize = values.iter().map(|v| costs[v.0 as usize]).sum();
        let channels = region.inst(values[0]).channels;
        let mixed = region.mixed(|i| needed[i]);
        let possible = channels > 1
            && values.iter().all(|v| region.inst(*v).channels == channels && is_indexable(region, *v))
            && !stores.iter().any(|s| mixed.contains(&written[*s]));
        let by_lane = possible
            && if channels > WIDE {
                lane < row.saturating_mul(4)
            } else if elements < MANY {
                channels >= 4 && lane <= row
            } else {
                row > LONG && lane.saturating_mul(channels) <= row.saturating_mul(2)
            };
        all.push(Component { stores, by_lane, size: if by_lane { lane } else { row } });
    }
    // Where rows fill the device, rows that load the same buffers are better off together.
    if elements >= MANY {
        let (lanes, rows): (Vec<Component>, Vec<Component>) = all.into_iter().partition(|c| c.by_lane);
        all = lanes;
        if !rows.is_empty() {
            let size = rows.iter().map(|c| c.size).sum();
            let mut stores: Vec<usize> = rows.into_iter().flat_map(|c| c.stores).collect();
            stores.sort();
            all.push(Component { stores, by_lane: false, size });
        }
    }
    all
}

/// Kernels for a region whose stores all write element by element.
pub(super) fn kernels(layout: &Layout, limits: Limits, name: &str, region: &Region) -> Result<Vec<Kernel>, LowerError> {
    let mut batches: Vec<Vec<Component>> = vec![];
    for component in components(region) {
        match batches.last_mut() {
            Some(batch)
                if batch.len() < MAX_SEGMENTS
                    && batch.iter().map(|c| c.size).sum::<usize>() + component.size <= 4 * LONG =>
            {
                batch.push(component)
            }
            _ => batches.push(vec![component]),
        }
    }
    let one = batches.len() == 1;
    let mut all = vec![];
    for (i, batch) in batches.iter().enumerate() {
        let name = if one { name.to_string() } else { format!("{name}.{}", i + 1) };
        all.push(kernel(layout, limits, name, region, batch)?);
    }
    Ok(all)
}

fn kernel(
    layout: &Layout,
    limits: Limits,
    name: String,
    region: &Region,
    components: &[Component],
) -> Result<Kernel, LowerError> {
    let elements = region.domain.elements() as u64;
    let fours = in_fours(region, components);
    let count = |c: &Component| {
        let channels = region.inst(region.stores[c.stores[0]].values()[0]).channels as u64;
        let elements = if fours { elements / 4 } else { elements };
        if c.by_lane { elements * channels } else { elements }
    };
    if let [only] = components {
        let (e, number) = Emit::over(layout, limits, count(only))?;
        let mut e = e.with_vectors(fours);
        segment(&mut e, region, only, number, fours);
        return e.finish(name);
    }
    let padded = |c: &Component| count(c).next_multiple_of(WORKGROUP as u64);
    let total = components.iter().map(padded).sum();
    let (e, number) = Emit::over(layout, limits, total)?;
    let mut e = e.with_vectors(fours);
    let mut first = 0;
    for (i, component) in components.iter().enumerate() {
        let end = first + padded(component);
        if i + 1 < components.len() {
            let end = e.b.u(end as u32);
            let here = e.b.less(number, end);
            e.b.open_if(here);
        }
        let start = e.b.u(first as u32);
        let own = e.b.sub(number, start);
        let spare = padded(component) != count(component);
        let guard = spare.then_some(count(component) as u32);
        e.if_below(own, guard, |e| segment(e, region, component, own, fours));
        if i + 1 < components.len() {
            e.b.open_else();
        }
        first = end;
    }
    (1..components.len()).for_each(|_| e.b.close_if());
    e.finish(name)
}

/// Whether every invocation takes four neighbouring elements: where there are many, each simple to compute.
fn in_fours(region: &Region, components: &[Component]) -> bool {
    use RegionOp::{ChannelSum, Const, Index, Load, Map, Pick};
    let simple = |op: &RegionOp| matches!(op, Load(_) | Const(_) | Map(_) | Pick(_) | Index(_) | ChannelSum(_));
    let elements = region.domain.elements();
    elements.is_multiple_of(4)
        && elements >= MANY_FOURS
        && components.iter().all(|c| c.by_lane || c.size <= SIMPLE)
        && region.body.iter().all(|i| simple(&i.op))
}

/// The statements of one component for its invocation `number`.
fn segment(e: &mut Emit, region: &Region, component: &Component, number: Value, fours: bool) {
    let elements = region.domain.elements() as u32;
    let each = if fours { 4 } else { 1 };
    let domain = &region.domain;
    let values_at =
        |e: &mut Emit, first: Value| Values::from(e, region, (domain, first, fours), |at| Position::new(domain, at));
    if component.by_lane {
        let per_channel = e.b.u(elements / each);
        let (channel, element) = (e.b.div(number, per_channel), e.b.rem(number, per_channel));
        let each = e.b.u(each);
        let element = e.b.mul(element, each);
        e.b.name(channel, "channel");
        e.b.name(element, "element");
        let mut values = values_at(e, element);
        let results: Vec<Value> = component
            .stores
            .iter()
            .map(|s| values.channel(e, region.stores[*s].values()[0], Channel::Var(channel)))
            .collect();
        for (s, value) in component.stores.iter().zip(results) {
            let buffer = region.stores[*s].buffer();
            let at = e.index(buffer, channel, element);
            put(e, buffer, at, value, fours);
        }
        return;
    }
    let each = e.b.u(each);
    let number = e.b.mul(number, each);
    let mut values = values_at(e, number);
    let reads = region.reads();
    let in_place = component.stores.iter().any(|s| reads.contains(&region.stores[*s].buffer()));
    let mut late = vec![];
    for s in &component.stores {
        let store = &region.stores[*s];
        let (id, buffer) = (store.values()[0], store.buffer());
        for c in 0..region.inst(id).channels as u32 {
            let value = values.channel(e, id, Channel::At(c));
            late.push((buffer, c, value));
            // A device waits for every read that follows a write.
            if !in_place && late.len() == TOGETHER {
                write(e, &mut late, number, fours);
            }
        }
    }
    write(e, &mut late, number, fours);
}

/// Writes channels of an element, or of four.
fn write(e: &mut Emit, results: &mut Vec<(BufferId, u32, Value)>, element: Value, fours: bool) {
    for (buffer, c, value) in results.drain(..) {
        let c = e.b.u(c);
        let at = e.index(buffer, c, element);
        put(e, buffer, at, value, fours);
    }
}

fn put(e: &mut Emit, buffer: BufferId, at: Value, value: Value, fours: bool) {
    if !fours {
        e.store(buffer, at, value);
    } else if e.layout.shape(buffer).dtype == DType::F32 {
        e.store_four(buffer, at, value);
    } else {
        for i in 0..4 {
            let offset = e.b.u(i);
            let lane = if value.vector { e.b.component(value, i) } else { value };
            let at = e.b.add(at, offset);
            e.store(buffer, at, lane);
        }
    }
}
