//! Builds regions from the cuts: walks from what must be stored to what can be loaded.

use super::cuts::{Cuts, Key, view};
use super::reread::reread;
use super::store::{Candidate, NEVER, choose};
use super::{Target, TargetKind, merge};
use crate::graph::{Axes, Shape, Tensor};
use crate::ops::input::Input;
use crate::ops::{Form, Reduction};
use crate::plan::region::{BufferId, Inst, InstId, Region, RegionOp, Store, Weights};
use crate::scalar::DType;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

/// Where a buffer's contents come from.
#[derive(Clone, Debug)]
pub enum Origin {
    Input(Input),
    /// A value computed by a region.
    Computed(Tensor),
}

/// Regions in launch order, and the buffers they name.
pub struct Fused {
    pub regions: Vec<Region>,
    pub buffers: Vec<(Origin, Shape)>,
    /// Buffer of each root, in order.
    pub roots: Vec<BufferId>,
    /// Per region, how many of its values an earlier region also computes.
    pub recomputed: Vec<usize>,
}

/// Fuses everything that `roots` need.
pub fn fuse(roots: &[Tensor], target: Target) -> Fused {
    let reread = (target.kind == TargetKind::Gpu).then(|| reread(roots));
    let roots = reread.as_deref().unwrap_or(roots);
    // An input that is a root is read where it lies; a computed identity is a root of its own.
    let computed: Vec<Tensor> = roots.iter().filter(|r| r.input_name().is_none()).cloned().collect();
    let mut builder = Builder {
        cuts: Cuts::new(&computed, target),
        stored: HashSet::new(),
        buffers: vec![],
        by_node: HashMap::new(),
        by_name: HashMap::new(),
        work: BTreeMap::new(),
        seen: HashSet::new(),
    };
    for r in &computed {
        builder.store(r);
    }
    for id in builder.cuts.order.clone() {
        let info = &builder.cuts.nodes[&id];
        let through_memory: Vec<Tensor> = (0..info.operands.len())
            .filter(|i| builder.cuts.stored_for(info, *i))
            .map(|i| info.operands[i].clone())
            .filter(|o| builder.cuts.get(o).form != Form::Input)
            .collect();
        let once = builder.cuts.once.contains(&id).then(|| info.tensor.clone());
        for o in through_memory.into_iter().chain(once) {
            builder.store(&o);
        }
        // Weights seen as a part of an input are not stored, but an input's own buffer must exist.
    }
    let mut regions = vec![];
    while let Some((key, ids)) = builder.work.pop_last() {
        let (region, nodes) = builder.region(&key, &ids);
        regions.push((region, nodes));
    }
    regions.reverse();
    let mut computed_before: HashSet<u64> = HashSet::new();
    let mut recomputed = vec![];
    for (_, nodes) in &regions {
        recomputed.push(nodes.iter().filter(|n| computed_before.contains(n)).count());
        computed_before.extend(nodes);
    }
    let roots = roots.iter().map(|r| builder.buffer(r)).collect();
    Fused {
        regions: regions.into_iter().map(|(r, _)| merge::merge(r)).collect(),
        buffers: builder.buffers,
        roots,
        recomputed,
    }
}

struct Builder {
    cuts: Cuts,
    stored: HashSet<u64>,
    buffers: Vec<(Origin, Shape)>,
    by_node: HashMap<u64, BufferId>,
    by_name: HashMap<String, BufferId>,
    /// Regions to build, by key, with the nodes they must store. Built from the last one backwards.
    work: BTreeMap<Key, BTreeSet<u64>>,
    seen: HashSet<Key>,
}

impl Builder {
    fn store(&mut self, t: &Tensor) {
        if self.stored.insert(t.id()) {
            let key = self.cuts.get(t).key();
            debug_assert!(!self.seen.contains(&key), "{t:?} is needed from a region that is already built");
            self.work.entry(key).or_default().insert(t.id());
        }
    }

    fn buffer(&mut self, t: &Tensor) -> BufferId {
        let next = BufferId(self.buffers.len() as u32);
        let id = match t.op_as::<Input>() {
            Some(input) => *self.by_name.entry(input.name.clone()).or_insert(next),
            None => *self.by_node.entry(t.id()).or_insert(next),
        };
        if id == next {
            let origin = t.op_as::<Input>().map_or_else(|| Origin::Computed(t.clone()), |i| Origin::Input(i.clone()));
            self.buffers.push((origin, t.shape().clone()));
        }
        id
    }

    /// Whether `t`, needed by the region `key`, is read from memory.
    fn loads(&self, t: &Tensor, key: &Key) -> bool {
        let info = self.cuts.get(t);
        if info.form == Form::Input || info.reduces_line() && info.depth < key.depth {
            return true;
        }
        if self.stored.contains(&t.id()) && (info.key() != *key || info.reduces) {
            // A free value is stored for those who need a buffer; everybody else computes it.
            return !info.free;
        }
        if info.free || info.key() == *key {
            return false;
        }
        debug_assert!(info.domain == key.domain && info.depth < key.depth, "{t:?} of another domain must be stored");
        false
    }

    /// Stores what the region of `key` should not compute again, given what it needs at its own depth.
    fn store_for(&mut self, key: &Key, ids: &BTreeSet<u64>) {
        let mut candidates: Vec<Candidate> = vec![];
        let mut needed = vec![];
        // What the region reads in any case, and what it reads only to compute something again, with the channels.
        let (mut read, mut readable) = (HashSet::new(), BTreeMap::new());
        let mut seen: HashSet<u64> = ids.clone().into_iter().collect();
        let mut stack: Vec<u64> = ids.iter().copied().collect();
        while let Some(id) = stack.pop() {
            let mut operands = vec![];
            let earlier = self.cuts.nodes[&id].depth < key.depth;
            for (i, operand) in self.cuts.nodes[&id].operands.clone().into_iter().enumerate() {
                let user = &self.cuts.nodes[&id];
                if user.needs_buffer(i) {
                    continue;
                }
                if self.cuts.stored_for(user, i) || self.loads(&operand, key) {
                    if !earlier {
                        read.insert(operand.id());
                        continue;
                    }
                    let channels: &mut BTreeSet<u32> = readable.entry(operand.id()).or_default();
                    match &user.form {
                        Form::Pick(pick) => channels.extend(pick.iter().filter(|p| p.0 as usize == i).map(|p| p.1)),
                        _ => channels.extend(0..operand.width() as u32),
                    }
                    operands.push(operand.id());
                    continue;
                }
                let info = self.cuts.get(&operand);
                if info.free {
                    continue;
                }
                if info.depth < key.depth {
                    if earlier { operands.push(operand.id()) } else { needed.push(operand.id()) }
                }
                if seen.insert(operand.id()) {
                    stack.push(operand.id());
                }
            }
            if earlier {
                candidates.push(self.candidate(id, operands));
            }
        }
        for (id, channels) in &readable {
            let bytes = 4 * (self.cuts.nodes[id].tensor.axes().elements() * channels.len()) as u64;
            let stored = if read.contains(id) { 0 } else { cost(self.cuts.target.seconds_of_bytes(bytes)) };
            candidates.push(Candidate { id: *id, stored, again: NEVER, bytes: 0, operands: vec![] });
        }
        let chosen = choose(candidates, &needed, self.cuts.target.store_bytes);
        for id in chosen.into_iter().filter(|id| !readable.contains_key(id)) {
            let tensor = self.cuts.nodes[&id].tensor.clone();
            self.store(&tensor);
        }
    }

    /// What storing a node takes, and what computing it again from its operands.
    fn candidate(&self, id: u64, operands: Vec<u64>) -> Candidate {
        let (info, target) = (&self.cuts.nodes[&id], &self.cuts.target);
        let bytes = 4 * info.tensor.shape().lanes();
        // Where nothing is stored yet there will be one more launch.
        let launch = if self.work.contains_key(&info.key()) { 0.0 } else { target.seconds_of_start() };
        let (stored, again) = (cost(launch + self.cuts.stored(info)), cost(self.cuts.again(info)));
        // Wide values are stored as long as there is room; over few elements they take none worth mentioning.
        let narrow = info.tensor.width() <= target.store_channels || bytes <= target.store_free_bytes;
        // A copy has no buffer of its own: what follows a stored reduction is computed again.
        let stored = if info.copy_of.is_none() { stored } else { NEVER };
        Candidate { id, stored, again, bytes: if narrow { 0 } else { bytes }, operands }
    }

    /// The region of `key` that stores `ids`, and the nodes it computes.
    fn region(&mut self, key: &Key, ids: &BTreeSet<u64>) -> (Region, Vec<u64>) {
        self.seen.insert(key.clone());
        self.store_for(key, ids);
        let mut loads: BTreeSet<u64> = BTreeSet::new();
        let mut computes: BTreeSet<u64> = BTreeSet::new();
        let mut stack: Vec<u64> = ids.iter().copied().collect();
        computes.extend(ids);
        while let Some(id) = stack.pop() {
            for (i, operand) in self.cuts.nodes[&id].operands.clone().into_iter().enumerate() {
                if self.cuts.nodes[&id].needs_buffer(i) {
                    continue;
                }
                let through_memory = self.cuts.stored_for(&self.cuts.nodes[&id], i);
                if through_memory || self.loads(&operand, key) {
                    loads.insert(operand.id());
                    if let Some(reduction) = self.cuts.get(&operand).copy_of.clone() {
                        self.store(&reduction);
                    }
                } else if computes.insert(operand.id()) {
                    stack.push(operand.id());
                }
            }
        }
        let mut region = Region {
            domain: key.domain.clone(),
            inner: key.inner.clone(),
            whole: false,
            grain: key.grain,
            body: vec![],
            stores: vec![],
        };
        let mut values: HashMap<u64, InstId> = HashMap::new();
        let mut all: Vec<u64> = loads.union(&computes).copied().collect();
        all.sort_by_key(|id| self.cuts.nodes[id].rank());
        for id in all {
            let info = &self.cuts.nodes[&id];
            let tensor = info.copy_of.as_ref().unwrap_or(&info.tensor).clone();
            if loads.contains(&id) && !computes.contains(&id) {
                let buffer = self.buffer(&tensor);
                values.insert(id, push(&mut region, &tensor, RegionOp::Load(buffer), vec![]));
            } else {
                self.compute(&mut region, &mut values, id, ids.contains(&id));
            }
        }
        let originals: BTreeSet<u64> = computes.iter().map(|id| self.cuts.nodes[id].rank().0).collect();
        (region, originals.into_iter().collect())
    }

    /// Adds node `id` to a region: its instruction, and its store if it is one of the region's results.
    fn compute(&mut self, region: &mut Region, values: &mut HashMap<u64, InstId>, id: u64, stored: bool) {
        let info = &self.cuts.nodes[&id];
        let t = info.tensor.clone();
        let operands: Vec<Tensor> = info.operands.clone();
        let (form, reduces, shared) = (info.form.clone(), info.reduces, info.shared_weights());
        let value = |o: &Tensor| values[&o.id()];
        if reduces {
            let buffer = self.buffer(&t);
            let store = match &form {
                Form::Reduce(kind) => Store::Reduce { kind: *kind, value: value(&operands[0]), buffer },
                Form::Scatter { axis } => Store::Scatter {
                    value: value(&operands[0]),
                    index: value(&operands[1]),
                    axis: axis.clone(),
                    buffer,
                },
                _ if region.inner.as_ref().is_some_and(|i| t.axes().contains(i)) => {
                    let inputs = operands.iter().map(value).collect();
                    let product = push(region, &t, RegionOp::RowOuter, inputs);
                    Store::Reduce { kind: Reduction::Sum, value: product, buffer }
                }
                _ => Store::Outer { x: value(&operands[0]), d: value(&operands[1]), buffer },
            };
            region.stores.push(store);
            return;
        }
        let op = match form {
            Form::Identity => {
                let inner = value(&operands[0]);
                values.insert(id, inner);
                let buffer = self.buffer(&t);
                region.stores.push(Store::Write { value: inner, buffer });
                return;
            }
            Form::Const(bits) => RegionOp::Const(bits),
            Form::Pointwise(program) => RegionOp::Map(program),
            Form::Pick(pick) => RegionOp::Pick(pick),
            Form::ChannelSum(groups) => RegionOp::ChannelSum(groups),
            Form::ChannelMax => RegionOp::ChannelMax,
            Form::Linear { transposed } if shared => {
                let weights = self.weights(&operands[1], transposed, &t);
                values.insert(id, push(region, &t, RegionOp::Linear(weights), vec![values[&operands[0].id()]]));
                return self.write(region, values, &t, stored);
            }
            Form::Linear { transposed } => {
                let (rows, columns) = matrix(&t.inputs()[1]);
                RegionOp::RowLinear { rows, columns, transposed }
            }
            Form::Outer => RegionOp::RowOuter,
            Form::CumSum { reverse, .. } => {
                region.whole = true;
                RegionOp::CumSum { reverse }
            }
            Form::Shift { by, .. } => {
                region.whole = true;
                RegionOp::Shift { by }
            }
            Form::Index { axis } => RegionOp::Index(axis),
            Form::Take { axis } => {
                let table = self.buffer(&operands[0]);
                if !operands[0].axes().contains(&axis) {
                    // A table repeated along the axis is the same wherever it is read.
                    values.insert(id, push(region, &operands[0], RegionOp::Load(table), vec![]));
                    return self.write(region, values, &t, stored);
                }
                values.insert(id, push(region, &t, RegionOp::Take { table, axis }, vec![values[&operands[1].id()]]));
                return self.write(region, values, &t, stored);
            }
            Form::SymEig { n } => RegionOp::SymEig { n },
            Form::Reduce(kind) => {
                region.whole = true;
                RegionOp::RowReduce(kind)
            }
            Form::Input | Form::Scatter { .. } => {
                unreachable!("loads and reductions are handled above")
            }
        };
        let inputs = operands.iter().map(value).collect();
        values.insert(id, push(region, &t, op, inputs));
        self.write(region, values, &t, stored);
    }

    fn write(&mut self, region: &mut Region, values: &HashMap<u64, InstId>, t: &Tensor, stored: bool) {
        if stored {
            let buffer = self.buffer(t);
            region.stores.push(Store::Write { value: values[&t.id()], buffer });
        }
    }

    fn weights(&mut self, w: &Tensor, transposed: bool, layer: &Tensor) -> Weights {
        let (rows, columns) = matrix(&layer.inputs()[1]);
        let (buffer, first) = match view(w) {
            Some((base, first)) if self.cuts.is_view(w) => (self.buffer(&base), first),
            _ => (self.buffer(w), 0),
        };
        Weights { buffer, first, rows, columns, transposed }
    }
}

/// Picoseconds.
fn cost(seconds: f64) -> u64 {
    (seconds * 1e12) as u64
}

fn matrix(w: &Tensor) -> (usize, usize) {
    match w.channels() {
        crate::graph::Channels::Matrix(r, c) => (r, c),
        crate::graph::Channels::Vector(_) => unreachable!("the shape rule of `linear` asks for a matrix"),
    }
}

/// Adds an instruction. Its axes are those its operands really vary along: broadcasts were seen through.
fn push(region: &mut Region, t: &Tensor, op: RegionOp, inputs: Vec<InstId>) -> InstId {
    let along = |more: &Axes| inputs.iter().fold(more.clone(), |a, i| a.union(&region.inst(*i).axes));
    let axes = match &op {
        RegionOp::Map(_) | RegionOp::Pick(_) | RegionOp::ChannelSum(_) | RegionOp::ChannelMax => along(&Axes::none()),
        RegionOp::RowLinear { .. } | RegionOp::RowOuter | RegionOp::SymEig { .. } => along(&Axes::none()),
        RegionOp::Linear(_) => along(t.inputs()[1].axes()),
        RegionOp::Take { axis, .. } => along(&t.inputs()[0].axes().without(axis)),
        RegionOp::RowReduce(_) => region.inner.iter().fold(along(&Axes::none()), |axes, inner| axes.without(inner)),
        RegionOp::Load(_) | RegionOp::Const(_) | RegionOp::Index(_) => t.axes().clone(),
        RegionOp::CumSum { .. } | RegionOp::Shift { .. } => t.axes().clone(),
    };
    push_as(region, t, op, inputs, axes)
}

fn push_as(region: &mut Region, t: &Tensor, op: RegionOp, inputs: Vec<InstId>, axes: Axes) -> InstId {
    let dtype: DType = t.dtype();
    let label = t.op().name().to_string();
    region.body.push(Inst { op, inputs, axes, channels: t.width(), dtype, label, source: t.source() });
    InstId(region.body.len() as u32 - 1)
}
