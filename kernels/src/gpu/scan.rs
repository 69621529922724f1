//! Scans along an axis: an invocation runs along one line of the domain, in as many passes as directions alternate.
//!
//! A cumulative sum is a variable of the pass that computes it. Passes after it, and shifts, read it back from scratch
//! memory, where the pass writes it.
//!
//! Where lines are too few to fill a device, the invocations of a workgroup share one: each runs along a stretch of it,
//! beginning with the sum of what the ones before it have in theirs.

use super::builder::{Kind, Memory, Value, Var};
use super::eval::{Channel, Values};
use super::layout::{Layout, Limits};
use super::memory::{Emit, WORKGROUP};
use super::position::Position;
use super::reduce::{combine, neutral};
use super::{Kernel, LowerError};
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Store};
use std::collections::HashMap;

/// Shortest line that is shared.
const SHARED: usize = 32;
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
    /// Whether a cumulative sum adds up another of the same pass.
    chained: bool,
    /// Cumulative sums that later passes or shifts read.
    stored: HashMap<InstId, BufferId>,
}

impl Plan {
    /// Workgroup memory for what the invocations that share a line tell each other.
    fn shared_bytes(&self, region: &Region) -> usize {
        let reduced = |p: &Pass| {
            let reductions = p.stores.iter().filter(|s| matches!(s, Store::Reduce { .. }));
            reductions.map(|s| region.inst(s.values()[0]).channels).sum::<usize>()
        };
        let summed = |p: &Pass| p.sums.iter().map(|s| region.inst(*s).channels).sum::<usize>();
        let values: usize = self.passes.iter().map(|p| reduced(p) + summed(p)).sum();
        4 * WORKGROUP as usize * values
    }
}

/// The kernel of a region with scans. Its stores write, or reduce over exactly the scanned axis.
pub(super) fn kernel(layout: &mut Layout, limits: Limits, name: &str, region: &Region) -> Result<Kernel, LowerError> {
    let plan = plan(layout, region)?;
    let inner = region.inner.clone().unwrap_or_else(|| Axis::new("once", 1));
    let lines = region.domain.without(&inner);
    let shared = lines.elements() < limits.invocations()
        && inner.size() >= SHARED
        && !plan.chained
        && plan.shared_bytes(region) <= limits.max_workgroup_bytes as usize;
    let (mut e, line) = match shared {
        false => Emit::over(layout, limits, lines.elements() as u64)?,
        true => {
            let mut e = Emit::new(layout, limits, lines.elements() as u64, WORKGROUP)?;
            if e.spare_workgroups() {
                e.leave_from(e.workgroup, lines.elements() as u32);
            }
            let line = e.workgroup;
            (e, line)
        }
    };
    let at_line = Position::new(&lines, line);
    let mut fixed = Values::new(region, vec![at_line.clone()]);
    let hoisted = hoist(&mut e, region, &inner, &mut fixed);
    for (i, pass) in plan.passes.iter().enumerate() {
        if shared && i > 0 {
            // A pass may read what another invocation wrote in the one before.
            e.b.barrier_of_storage();
        }
        Run { region, plan: &plan, pass, lines: &lines, line, inner: &inner, hoisted: &hoisted, shared }.emit(&mut e);
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

/// A pass being written.
struct Run<'r> {
    region: &'r Region,
    plan: &'r Plan,
    pass: &'r Pass,
    lines: &'r Axes,
    line: Value,
    inner: &'r Axis,
    hoisted: &'r [(InstId, u32, Value)],
    /// Whether a workgroup shares the line.
    shared: bool,
}

impl<'r> Run<'r> {
    fn emit(&self, e: &mut Emit) {
        let mut sums: Vec<(InstId, Vec<Var>)> = vec![];
        for id in &self.pass.sums {
            let zero = e.b.f(0.0);
            let vars = (0..self.region.inst(*id).channels).map(|_| e.b.var("before", zero)).collect();
            sums.push((*id, vars));
        }
        let mut totals: Vec<Vec<Var>> = vec![];
        for store in &self.pass.stores {
            let mut vars = vec![];
            if let Store::Reduce { kind, value, .. } = store {
                for _ in 0..self.region.inst(*value).channels {
                    let first = neutral(&mut e.b, *kind);
                    vars.push(e.b.var("total", first));
                }
            }
            totals.push(vars);
        }
        let (from, to) = self.stretch(e);
        if self.shared && !sums.is_empty() {
            self.begin(e, &sums, (from, to));
        }
        let step = e.b.open_loop("step", from, to, 1);
        let (mut values, element) = self.values(e, step);
        for (id, vars) in &sums {
            for (c, var) in vars.iter().enumerate() {
                let before = e.b.get(*var);
                values.give(e, *id, Channel::At(c as u32), before);
            }
        }
        self.store(e, &mut values, element, &totals);
        for (id, vars) in &sums {
            for (c, var) in vars.iter().enumerate() {
                let before = values.channel(e, *id, Channel::At(c as u32));
                if let Some(buffer) = self.plan.stored.get(id) {
                    let c = e.b.u(c as u32);
                    let to = e.index(*buffer, c, element);
                    e.store(*buffer, to, before);
                }
                let term = values.channel(e, self.region.inst(*id).inputs[0], Channel::At(c as u32));
                let after = e.b.add(before, term);
                e.b.set(*var, after);
            }
        }
        e.b.close_loop();
        self.finish(e, &totals);
    }

    /// The steps of this invocation.
    fn stretch(&self, e: &mut Emit) -> (Value, Value) {
        let size = e.b.u(self.inner.size() as u32);
        if !self.shared {
            return (e.b.u(0), size);
        }
        let length = e.b.u((self.inner.size() as u32).div_ceil(WORKGROUP));
        let from = e.b.mul(e.invocation, length);
        let to = e.b.add(from, length);
        let to = e.b.math(naga::MathFunction::Min, &[to, size]);
        (from, to)
    }

    /// Values at a step, and the element there.
    fn values(&self, e: &mut Emit, step: Value) -> (Values<'r>, Value) {
        let at = if self.pass.reverse {
            let last = e.b.u(self.inner.size() as u32 - 1);
            e.b.sub(last, step)
        } else {
            step
        };
        let position = Position::new(self.lines, self.line).with(self.inner, at);
        let element = position.element(e, &self.region.domain);
        let mut values = Values::new(self.region, vec![position]).reading(&self.plan.stored);
        for (id, c, value) in self.hoisted {
            values.give(e, *id, Channel::At(*c), *value);
        }
        (values, element)
    }

    /// Sets the sums to those of all stretches before this invocation's.
    fn begin(&self, e: &mut Emit, sums: &[(InstId, Vec<Var>)], (from, to): (Value, Value)) {
        let step = e.b.open_loop("ahead", from, to, 1);
        let (mut values, _) = self.values(e, step);
        for (id, vars) in sums {
            for (c, var) in vars.iter().enumerate() {
                let (so_far, input) = (e.b.get(*var), self.region.inst(*id).inputs[0]);
                let term = values.channel(e, input, Channel::At(c as u32));
                let next = e.b.add(so_far, term);
                e.b.set(*var, next);
            }
        }
        e.b.close_loop();
        let vars: Vec<Var> = sums.iter().flat_map(|s| s.1.clone()).collect();
        let ends = e.b.workgroup("ends", Kind::F32, false, vars.len() as u32 * WORKGROUP);
        self.put(e, ends, &vars);
        e.b.barrier();
        for (i, var) in vars.iter().enumerate() {
            gather(e, ends, i as u32, e.invocation, Reduction::Sum, *var);
        }
    }

    /// Every invocation's values of some variables, one after the other, to workgroup memory.
    fn put(&self, e: &mut Emit, memory: Memory, vars: &[Var]) {
        for (i, var) in vars.iter().enumerate() {
            let (value, first) = (e.b.get(*var), e.b.u(i as u32 * WORKGROUP));
            let at = e.b.add(e.invocation, first);
            e.b.store(memory, at, value);
        }
    }

    /// What the stores write or add up at a step.
    fn store(&self, e: &mut Emit, values: &mut Values, element: Value, totals: &[Vec<Var>]) {
        for (store, vars) in self.pass.stores.iter().zip(totals) {
            let id = store.values()[0];
            // Only reductions have totals.
            let mut totals = vars.iter();
            for c in 0..self.region.inst(id).channels {
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
    }

    /// Writes the totals of the line.
    fn finish(&self, e: &mut Emit, totals: &[Vec<Var>]) {
        let all: Vec<Var> = totals.concat();
        if all.is_empty() {
            return;
        }
        let found = self.shared.then(|| {
            let found = e.b.workgroup("found", Kind::F32, false, all.len() as u32 * WORKGROUP);
            self.put(e, found, &all);
            e.b.barrier();
            found
        });
        let mut number = 0;
        for (store, vars) in self.pass.stores.iter().zip(totals) {
            let Store::Reduce { kind, .. } = store else { continue };
            for (c, var) in vars.iter().enumerate() {
                if let Some(found) = found {
                    let own = e.b.u(number % WORKGROUP);
                    let mine = e.b.binary(naga::BinaryOperator::Equal, e.invocation, own);
                    e.b.open_if(mine);
                    let all = e.b.u(WORKGROUP);
                    gather(e, found, number, all, *kind, *var);
                }
                let value = e.b.get(*var);
                let c = e.b.u(c as u32);
                let to = e.index(store.buffer(), c, self.line);
                e.store(store.buffer(), to, value);
                if found.is_some() {
                    e.b.close_if();
                }
                number += 1;
            }
        }
    }
}

/// Combines into a variable what the first `count` invocations have put of value `number`, in order.
fn gather(e: &mut Emit, memory: Memory, number: u32, count: Value, kind: Reduction, into: Var) {
    let (none, first) = (e.b.u(0), e.b.u(number * WORKGROUP));
    let start = neutral(&mut e.b, kind);
    e.b.set(into, start);
    let other = e.b.open_loop("other", none, count, 1);
    let at = e.b.add(first, other);
    let (so_far, next) = (e.b.get(into), e.b.load(memory, at));
    let next = combine(&mut e.b, kind, so_far, next);
    e.b.set(into, next);
    e.b.close_loop();
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
    let mut chained = false;
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
                chained |= sums.iter().any(|s| pass_of[s] == pass);
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
    Ok(Plan { passes, chained, stored })
}
