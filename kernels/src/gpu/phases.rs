//! What a workgroup of a resident network does, between barriers, and what it keeps for later.
//!
//! Kept are the inputs of layers, what leaves a layer's epilogue, scans with what they sum up, neighbours, and narrow values that
//! several phases would compute again. Everything else is computed where it is needed.

use super::channels::{indexable, indexable_from};
use super::elements::{lane_costs, own_cost};
use raygrad_compiler::plan::region::{Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;
use std::collections::{BTreeSet, HashMap};

/// Channels up to which an invocation computes all of a row.
const NARROW: usize = 16;
/// Operations of a channel that are computed again rather than kept.
const CHEAP: usize = 16;
/// The same of all channels of a value that several phases need.
const SHARED: usize = 64;

/// What is done between two barriers.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Phase {
    /// Values of which an invocation computes a row.
    Rows(Vec<InstId>),
    /// A value of which an invocation computes one channel of some rows.
    Lanes(InstId),
    /// A layer, and what follows from it channel by channel.
    Layer { linear: InstId, results: Vec<InstId> },
    /// A cumulative sum.
    Scan(InstId),
    /// What is combined over a line.
    Totals,
}

pub(super) struct Phases {
    /// What is lowered: the region, whose neighbours' values are instructions of their own.
    pub region: Region,
    /// Per instruction, whether later phases read it.
    pub kept: Vec<bool>,
    pub all: Vec<Phase>,
}

impl Phases {
    /// The phases of a region whose stores write, or reduce over the inner axis.
    pub fn of(region: &Region) -> Phases {
        let region = with_neighbours(region);
        let homes = homes(&region);
        let mut kept = kept(&region, &homes);
        loop {
            let found = Phases { all: order(&region, &homes, &kept), kept, region: region.clone() };
            let more = found.worth_keeping(&homes);
            if more.is_empty() {
                return found;
            }
            kept = found.kept;
            more.into_iter().for_each(|id| kept[id.0 as usize] = true);
        }
    }

    /// The region as phase `at` sees it: what others keep is loaded from where it lies.
    pub fn seen_by(&self, at: usize, place: impl Fn(InstId) -> Inst) -> Region {
        let own = self.all[at].results();
        let mut region = self.region.clone();
        for id in self.region.ids().filter(|id| self.kept[id.0 as usize] && !own.contains(id)) {
            region.body[id.0 as usize] = place(id);
        }
        region
    }

    /// What phase `at` reads of others.
    pub fn reads(&self, at: usize) -> BTreeSet<InstId> {
        reads(&self.region, &self.kept, &self.all[at])
    }

    /// Values that several phases compute at some expense, and nothing that does so is computed from.
    fn worth_keeping(&self, homes: &[Option<InstId>]) -> Vec<InstId> {
        let region = &self.region;
        let uses: Vec<BTreeSet<InstId>> = self.all.iter().map(|p| computes(region, &self.kept, p)).collect();
        let phases = |id: InstId| -> Vec<usize> { (0..uses.len()).filter(|p| uses[*p].contains(&id)).collect() };
        let mut cost = vec![0usize; region.body.len()];
        for (at, inst) in region.body.iter().enumerate() {
            let operands = inst.inputs.iter().filter(|i| !self.kept[i.0 as usize]).map(|i| cost[i.0 as usize]);
            let own = own_cost(region, at).saturating_mul(inst.channels);
            cost[at] = operands.fold(own, usize::saturating_add);
        }
        let may = |id: &InstId| {
            let at = id.0 as usize;
            let inst = region.inst(*id);
            !self.kept[at] && homes[at].is_none() && inst.dtype == DType::F32 && !is_at_hand(inst) && cost[at] > SHARED
        };
        let alone = |id: &InstId| {
            let own = phases(*id);
            let users = region.ids().filter(|u| region.inst(*u).inputs.contains(id));
            own.len() > 1 && !users.into_iter().any(|u| may(&u) && phases(u) == own)
        };
        region.ids().filter(may).filter(alone).collect()
    }
}

impl Phase {
    /// What it computes for others.
    pub fn results(&self) -> Vec<InstId> {
        match self {
            Phase::Rows(all) => all.clone(),
            Phase::Lanes(id) | Phase::Scan(id) => vec![*id],
            Phase::Layer { results, .. } => results.clone(),
            Phase::Totals => vec![],
        }
    }
}

/// Whether a value needs no computing.
fn is_at_hand(inst: &Inst) -> bool {
    matches!(inst.op, RegionOp::Load(_) | RegionOp::Const(_) | RegionOp::Index(_))
}

/// The region with what each shift looks at computed apart: at another row, where nothing is kept.
fn with_neighbours(region: &Region) -> Region {
    let mut body: Vec<Inst> = vec![];
    let mut new: Vec<InstId> = vec![];
    for inst in &region.body {
        let mut inputs: Vec<InstId> = inst.inputs.iter().map(|i| new[i.0 as usize]).collect();
        if let RegionOp::Shift { .. } = inst.op {
            let mut copies = HashMap::new();
            inputs = vec![copied(&mut body, inputs[0], &mut copies)];
        }
        body.push(Inst { inputs, ..inst.clone() });
        new.push(InstId(body.len() as u32 - 1));
    }
    let stores = region.stores.iter().map(|s| s.map_values(|v| new[v.0 as usize])).collect();
    Region { body, stores, ..region.clone() }
}

/// A copy of a value and of all it is computed from.
fn copied(body: &mut Vec<Inst>, id: InstId, copies: &mut HashMap<InstId, InstId>) -> InstId {
    if let Some(known) = copies.get(&id) {
        return *known;
    }
    let inst = body[id.0 as usize].clone();
    let inputs = inst.inputs.iter().map(|i| copied(body, *i, copies)).collect();
    body.push(Inst { inputs, ..inst });
    let copy = InstId(body.len() as u32 - 1);
    copies.insert(id, copy);
    copy
}

/// What a value is computed from where it is needed: itself, but for integers such as masks, which nothing keeps, their operands.
fn sources(region: &Region, id: InstId) -> Vec<InstId> {
    let inst = region.inst(id);
    match inst.op {
        RegionOp::Map(_) if inst.dtype == DType::U32 => inst.inputs.iter().flat_map(|i| sources(region, *i)).collect(),
        _ => vec![id],
    }
}

/// Per value, the layer whose sums it follows from channel by channel. What else it is computed from does not depend on that
/// layer.
fn homes(region: &Region) -> Vec<Option<InstId>> {
    let can_index = indexable(region);
    let mut last: Vec<Option<InstId>> = vec![];
    let mut homes: Vec<Option<InstId>> = vec![];
    for (at, inst) in region.body.iter().enumerate() {
        if matches!(inst.op, RegionOp::Linear(_)) {
            let own = Some(InstId(at as u32));
            last.push(own);
            homes.push(own);
            continue;
        }
        let layer = inst.inputs.iter().filter_map(|i| last[i.0 as usize]).max();
        let follows = |i: &InstId| homes[i.0 as usize] == layer && region.inst(*i).channels == inst.channels;
        let available = |i: &InstId| {
            let other = region.inst(*i);
            is_at_hand(other) && can_index[i.0 as usize] || other.dtype == DType::F32
        };
        let beside = |i: &InstId| last[i.0 as usize] != layer && sources(region, *i).iter().all(available);
        let home = layer.filter(|_| {
            matches!(inst.op, RegionOp::Map(_))
                && inst.inputs.iter().any(follows)
                && inst.inputs.iter().all(|i| follows(i) || beside(i))
        });
        last.push(layer);
        homes.push(home);
    }
    homes
}

/// What phases keep in any case.
fn kept(region: &Region, homes: &[Option<InstId>]) -> Vec<bool> {
    let mut kept = vec![false; region.body.len()];
    let (costs, can_index) = (lane_costs(region), indexable(region));
    let is_cheap = |id: InstId| {
        let at = id.0 as usize;
        is_at_hand(region.inst(id)) || costs[at] <= CHEAP && can_index[at]
    };
    for (at, inst) in region.body.iter().enumerate() {
        match inst.op {
            RegionOp::Linear(_) => kept[inst.inputs[0].0 as usize] = true,
            RegionOp::CumSum { .. } => {
                kept[inst.inputs[0].0 as usize] = true;
                kept[at] = true;
            }
            RegionOp::Shift { .. } | RegionOp::SymEig { .. } => kept[at] = true,
            _ => {}
        }
        if homes[at].is_some() && !matches!(inst.op, RegionOp::Linear(_)) {
            for i in inst.inputs.iter().filter(|i| homes[i.0 as usize] != homes[at]) {
                sources(region, *i).into_iter().filter(|s| !is_cheap(*s)).for_each(|s| kept[s.0 as usize] = true);
            }
        }
    }
    for store in &region.stores {
        if let Store::Reduce { value, .. } = store {
            kept[value.0 as usize] = true;
        }
    }
    // What leaves a layer's epilogue. Integers do not: who needs one computes it from what it follows from.
    let mut leaves = vec![false; region.body.len()];
    for at in (0..region.body.len()).rev() {
        let inst = &region.body[at];
        let outside = leaves[at] && inst.dtype == DType::U32;
        for i in &inst.inputs {
            let i = i.0 as usize;
            if homes[i].is_some() && (outside || homes[at] != homes[i] || matches!(inst.op, RegionOp::Linear(_))) {
                leaves[i] = true;
                kept[i] |= region.body[i].dtype == DType::F32;
            }
        }
    }
    // Narrow values that wide ones would compute once a channel.
    let wide = |id: InstId| region.inst(id).channels > NARROW;
    for (at, inst) in region.body.iter().enumerate() {
        if wide(InstId(at as u32)) && homes[at].is_none() {
            for i in inst.inputs.iter().filter(|i| !wide(**i) && !is_at_hand(region.inst(**i))) {
                kept[i.0 as usize] |= costs[i.0 as usize] > CHEAP && region.inst(*i).dtype == DType::F32;
            }
        }
    }
    kept
}

/// What a phase computes: its results, and what they follow from up to what is kept.
fn computes(region: &Region, kept: &[bool], phase: &Phase) -> BTreeSet<InstId> {
    let own = phase.results();
    let mut found: BTreeSet<InstId> = own.iter().copied().collect();
    let mut stack = own.clone();
    while let Some(id) = stack.pop() {
        // A scan is handed what it sums up.
        if matches!(phase, Phase::Scan(_)) {
            break;
        }
        for i in &region.inst(id).inputs {
            if (!kept[i.0 as usize] || own.contains(i)) && found.insert(*i) {
                stack.push(*i);
            }
        }
    }
    found
}

/// What a phase reads of what others keep.
fn reads(region: &Region, kept: &[bool], phase: &Phase) -> BTreeSet<InstId> {
    if *phase == Phase::Totals {
        let combined = region.stores.iter().filter(|s| matches!(s, Store::Reduce { .. }));
        return combined.flat_map(|s| s.values()).collect();
    }
    let found = computes(region, kept, phase);
    let inputs = found.iter().flat_map(|id| region.inst(*id).inputs.iter().copied());
    inputs.filter(|i| kept[i.0 as usize] && !found.contains(i)).collect()
}

/// The phases in order: each after those whose results it reads.
fn order(region: &Region, homes: &[Option<InstId>], kept: &[bool]) -> Vec<Phase> {
    let written = |id: InstId| region.stores.iter().any(|s| matches!(s, Store::Write { value, .. } if *value == id));
    let can_index = indexable_from(region, |id| kept[id.0 as usize]);
    let mut phases: Vec<Phase> = vec![];
    for id in region.ids().filter(|id| kept[id.0 as usize] || written(*id)) {
        let (at, inst) = (id.0 as usize, region.inst(id));
        let known = phases.iter_mut().find_map(|p| match p {
            Phase::Layer { linear, results } if Some(*linear) == homes[at] => Some(results),
            _ => None,
        });
        if let Some(results) = known {
            results.push(id);
            continue;
        }
        phases.push(match (&inst.op, homes[at]) {
            (_, Some(linear)) => Phase::Layer { linear, results: vec![id] },
            (RegionOp::CumSum { .. }, _) => Phase::Scan(id),
            (RegionOp::Shift { .. } | RegionOp::SymEig { .. }, _) => Phase::Rows(vec![id]),
            _ if inst.channels > NARROW && can_index[at] => Phase::Lanes(id),
            _ => Phase::Rows(vec![id]),
        });
    }
    if region.stores.iter().any(|s| matches!(s, Store::Reduce { .. })) {
        phases.push(Phase::Totals);
    }
    // Levels: rows may read what the same invocation computed.
    let all_reads: Vec<BTreeSet<InstId>> = phases.iter().map(|p| reads(region, kept, p)).collect();
    let mut producer: HashMap<InstId, usize> = HashMap::new();
    for (at, phase) in phases.iter().enumerate() {
        phase.results().into_iter().for_each(|id| {
            producer.insert(id, at);
        });
    }
    let is_rows = |at: usize| matches!(phases[at], Phase::Rows(_));
    let mut levels = vec![0usize; phases.len()];
    for _ in 0..phases.len() {
        for at in 0..phases.len() {
            let after = all_reads[at]
                .iter()
                .filter_map(|id| producer.get(id))
                .map(|p| levels[*p] + usize::from(!(is_rows(at) && is_rows(*p))));
            levels[at] = after.max().unwrap_or(0);
        }
    }
    let mut order: Vec<usize> = (0..phases.len()).collect();
    order.sort_by_key(|at| (levels[*at], !is_rows(*at), *at));
    let mut all: Vec<Phase> = vec![];
    let mut level = usize::MAX;
    for at in order {
        match (all.last_mut(), &phases[at]) {
            (Some(Phase::Rows(together)), Phase::Rows(more)) if levels[at] == level => together.extend(more),
            (_, phase) => all.push(phase.clone()),
        }
        level = levels[at];
    }
    for phase in &mut all {
        if let Phase::Rows(ids) = phase {
            ids.sort();
        }
    }
    all
}
