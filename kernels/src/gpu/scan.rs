//! Scans along an axis: an invocation runs along one line of the domain, in as many passes as directions alternate.
//!
//! A cumulative sum is a variable of the pass that computes it. Passes after it, and shifts, read it back from scratch
//! memory, where the pass writes it.

use super::builder::{Value, Var};
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, Position};
use super::reduce::{combine, neutral};
use super::{Kernel, LowerError};
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store};
use std::collections::HashMap;

/// Most channels of a value that is the same along a line and is computed before it.
const HOISTED: usize = 16;

/// One run along the line.
#[derive(Default)]
struct Pass {
    reverse: bool,
    sums: Vec<InstId>,
    stores: Vec<Store>,
}

struct Plan {
    passes: Vec<Pass>,
    /// Cumulative sums that later passes or shifts read.
    stored: HashMap<InstId, BufferId>,
}

/// The kernel of a region with scans. Its stores write, or reduce over exactly the scanned axis.
pub(super) fn kernel(layout: &mut Layout, limits: Limits, name: &str, region: &Region) -> Result<Kernel, LowerError> {
    let plan = plan(layout, region)?;
    let inner = region.inner.clone().unwrap_or_else(|| Axis::new("once", 1));
    let lines = region.domain.without(&inner);
    let (mut e, line) = Emit::over(layout, limits, lines.elements() as u64)?;
    let at_line = Position::new(&lines, line);
    let mut fixed = Values::new(region, vec![at_line.clone()]);
    let hoisted = hoist(&mut e, region, &inner, &mut fixed);
    for pass in &plan.passes {
        run(&mut e, region, &plan, pass, (&lines, line, &inner), &hoisted);
    }
    e.finish(name)
}

/// Values that are the same along a line.
fn hoist(e: &mut Emit, region: &Region, inner: &Axis, values: &mut Values) -> Vec<(InstId, u32, Value)> {
    let varies = |id: InstId| region.inst(id).axes.contains(inner);
    let mut used = vec![false; region.body.len()];
    for inst in region.body.iter().filter(|i| i.axes.contains(inner)) {
        inst.inputs.iter().for_each(|i| used[i.0 as usize] = true);
    }
    region.stores.iter().flat_map(|s| s.values()).for_each(|v| used[v.0 as usize] = true);
    let mut all = vec![];
    for id in region.ids().filter(|id| used[id.0 as usize] && !varies(*id)) {
        let inst = region.inst(id);
        if inst.channels <= HOISTED && !matches!(inst.op, RegionOp::Const(_)) {
            for (c, value) in values.all(e, id).into_iter().enumerate() {
                all.push((id, c as u32, value));
            }
        }
    }
    all
}

fn run(
    e: &mut Emit,
    region: &Region,
    plan: &Plan,
    pass: &Pass,
    (lines, line, inner): (&Axes, Value, &Axis),
    hoisted: &[(InstId, u32, Value)],
) {
    let mut sums: Vec<(InstId, Vec<Var>)> = vec![];
    for id in &pass.sums {
        let zero = e.b.f(0.0);
        let vars = (0..region.inst(*id).channels).map(|_| e.b.var("before", zero)).collect();
        sums.push((*id, vars));
    }
    let mut totals: Vec<Vec<Var>> = vec![];
    for store in &pass.stores {
        let mut vars = vec![];
        if let Store::Reduce { kind, value, .. } = store {
            for _ in 0..region.inst(*value).channels {
                let first = neutral(&mut e.b, *kind);
                vars.push(e.b.var("total", first));
            }
        }
        totals.push(vars);
    }
    let size = e.b.u(inner.size() as u32);
    let zero = e.b.u(0);
    let step = e.b.open_loop("step", zero, size, 1);
    let at = if pass.reverse {
        let last = e.b.u(inner.size() as u32 - 1);
        e.b.sub(last, step)
    } else {
        step
    };
    let position = Position::new(lines, line).with(inner, at);
    let mut values = Values::new(region, vec![position.clone()]).reading(&plan.stored);
    for (id, c, value) in hoisted {
        values.give(e, *id, Channel::At(*c), *value);
    }
    for (id, vars) in &sums {
        for (c, var) in vars.iter().enumerate() {
            let before = e.b.get(*var);
            values.give(e, *id, Channel::At(c as u32), before);
        }
    }
    let element = position.element(e, &region.domain);
    for (store, vars) in pass.stores.iter().zip(&totals) {
        let id = store.values()[0];
        // Only reductions have totals.
        let mut totals = vars.iter();
        for c in 0..region.inst(id).channels {
            let value = values.channel(e, id, Channel::At(c as u32));
            match (store, totals.next()) {
                (Store::Reduce { kind, .. }, Some(total)) => {
                    let so_far = e.b.get(*total);
                    let next = combine(&mut e.b, *kind, so_far, value);
                    e.b.set(*total, next);
                }
                _ => {
                    let c = e.b.u(c as u32);
                    let to = e.index(store.buffer(), c, element);
                    e.store(store.buffer(), to, value);
                }
            }
        }
    }
    for (id, vars) in &sums {
        for (c, var) in vars.iter().enumerate() {
            let before = values.channel(e, *id, Channel::At(c as u32));
            if let Some(buffer) = plan.stored.get(id) {
                let c = e.b.u(c as u32);
                let to = e.index(*buffer, c, element);
                e.store(*buffer, to, before);
            }
            let term = values.channel(e, region.inst(*id).inputs[0], Channel::At(c as u32));
            let after = e.b.add(before, term);
            e.b.set(*var, after);
        }
    }
    e.b.close_loop();
    for (store, vars) in pass.stores.iter().zip(&totals) {
        for (c, var) in vars.iter().enumerate() {
            let value = e.b.get(*var);
            let c = e.b.u(c as u32);
            let to = e.index(store.buffer(), c, line);
            e.store(store.buffer(), to, value);
        }
    }
}

fn plan(layout: &mut Layout, region: &Region) -> Result<Plan, LowerError> {
    let n = region.body.len();
    let mut passes: Vec<Pass> = vec![];
    // The first pass in which a value is there, and the first in which it is there at other positions, too.
    let (mut here, mut elsewhere) = (vec![0usize; n], vec![0usize; n]);
    // Cumulative sums a value depends on, directly or through a shift.
    let mut depends: Vec<Vec<InstId>> = vec![vec![]; n];
    let mut pass_of: HashMap<InstId, usize> = HashMap::new();
    let mut kept: Vec<InstId> = vec![];
    for id in region.ids() {
        let (at, inst) = (id.0 as usize, region.inst(id));
        let inputs = || inst.inputs.iter().map(|i| i.0 as usize);
        here[at] = inputs().map(|i| here[i]).max().unwrap_or(0);
        elsewhere[at] = inputs().map(|i| elsewhere[i]).max().unwrap_or(0);
        let mut sums: Vec<InstId> = inputs().flat_map(|i| depends[i].clone()).collect();
        match inst.op {
            RegionOp::CumSum { reverse } => {
                let found = (here[at]..passes.len()).find(|p| passes[*p].reverse == reverse);
                let pass = found.unwrap_or_else(|| {
                    passes.resize_with(passes.len().max(here[at]), Pass::default);
                    passes.push(Pass { reverse, ..Pass::default() });
                    passes.len() - 1
                });
                passes[pass].sums.push(id);
                kept.extend(sums.iter().filter(|s| pass_of[s] < pass));
                pass_of.insert(id, pass);
                here[at] = pass;
                elsewhere[at] = pass + 1;
                sums = vec![id];
            }
            RegionOp::Shift { .. } => {
                here[at] = elsewhere[at];
                kept.extend(sums.iter());
            }
            _ => {}
        }
        depends[at] = sums;
    }
    for store in &region.stores {
        let id = store.values()[0];
        let pass = here[id.0 as usize];
        if passes.len() <= pass {
            passes.resize_with(pass + 1, Pass::default);
        }
        kept.extend(depends[id.0 as usize].iter().filter(|s| pass_of[s] < pass));
        passes[pass].stores.push(store.clone());
    }
    let mut stored = HashMap::new();
    for id in kept {
        if let std::collections::hash_map::Entry::Vacant(new) = stored.entry(id) {
            let inst = region.inst(id);
            let shape = Shape::of(region.domain.clone(), inst.channels, inst.dtype);
            new.insert(layout.scratch("cumulative", shape)?);
        }
    }
    Ok(Plan { passes, stored })
}
