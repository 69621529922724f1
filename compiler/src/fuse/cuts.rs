//! Domains, free values, forced cuts and depths.

use super::extremes::compared;
use super::lines::{self, Copies};
use super::resident::{After, Resident, after};
use super::{Target, TargetKind};
use crate::graph::{Axes, Axis, Tensor, topological};
use crate::ops::Form;
use crate::plan::region::Grain;
use std::collections::{HashMap, HashSet};

/// Channels from which a value counts as wide on a GPU.
pub(super) const WIDE: usize = 65;
/// Channels from which everything pointwise after a layer belongs to its epilogue; below, only what takes nothing else.
const EPILOGUE: usize = 16;
/// Channels from which sums of groups of channels are worth an invocation each.
const GROUPS: usize = 8;
/// Weights of an element's own layer from which its outputs are worth an invocation each.
const OWN_WEIGHTS: usize = 128;

/// The node whose lanes `t` has: reshapes, broadcasts and markers are seen through.
pub(super) fn resolve(t: &Tensor) -> Tensor {
    let mut t = t;
    while t.op().form() == Form::Identity {
        t = &t.inputs()[0];
    }
    t.clone()
}

/// What fusion knows of a node.
pub(super) struct Info {
    pub tensor: Tensor,
    /// Of a copy inside the tiles of a region (see [`lines`]): what it is a copy of.
    pub copy_of: Option<Tensor>,
    pub form: Form,
    pub domain: Axes,
    /// The axis its region's tiles run along.
    pub inner: Option<Axis>,
    pub grain: Grain,
    /// Operands with identities seen through.
    pub operands: Vec<Tensor>,
    /// Its result is complete only when its region ends.
    pub reduces: bool,
    pub free: bool,
    /// Whether one of its channels can be computed without the others, from inputs on.
    pub by_lane: bool,
    /// What it was last computed from.
    pub after: After,
    pub depth: usize,
    /// Operations to compute one element from inputs and what is surely stored.
    pub closure_flops: u64,
}

impl Info {
    /// Regions are nodes of equal keys.
    pub fn key(&self) -> Key {
        Key { depth: self.depth, domain: self.domain.clone(), inner: self.inner.clone(), grain: self.grain }
    }
    /// Whether it is computed element by element along the last axis of `domain`.
    pub fn runs_along(&self, domain: &Axes) -> bool {
        self.domain == *domain && self.inner.as_ref() == domain.last()
    }
    /// Order of instructions: a copy comes just before its original.
    pub fn rank(&self) -> (u64, bool) {
        (self.copy_of.as_ref().unwrap_or(&self.tensor).id(), self.copy_of.is_none())
    }
    /// Whether it is a reduction that is complete inside a tile.
    pub fn reduces_line(&self) -> bool {
        self.copy_of.is_some() && matches!(self.form, Form::Reduce(_))
    }
    /// Whether the weights of a layer (operand 1) are the same along the inner axis.
    pub fn shared_weights(&self) -> bool {
        matches!(self.form, Form::Linear { .. })
            && self.inner.as_ref().is_none_or(|i| !self.operands[1].axes().contains(i))
    }
    /// Whether operand `i` must be a buffer, not a value of the region.
    pub fn needs_buffer(&self, i: usize) -> bool {
        match self.form {
            Form::Linear { .. } => i == 1 && self.shared_weights(),
            Form::Take { .. } => i == 0,
            _ => false,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Key {
    pub depth: usize,
    pub domain: Axes,
    pub inner: Option<Axis>,
    pub grain: Grain,
}

pub(super) struct Cuts {
    pub nodes: HashMap<u64, Info>,
    /// Identifiers in topological order.
    pub order: Vec<u64>,
    pub target: Target,
    copies: Copies,
    resident: Resident,
    /// Values that nobody computes again.
    pub once: HashSet<u64>,
    /// Depth before which no region over a domain of whole lines starts.
    starts: HashMap<Axes, usize>,
}

impl Cuts {
    pub fn new(roots: &[Tensor], target: Target) -> Cuts {
        let (copies, starts) = (Copies::default(), HashMap::new());
        let (resident, once) = (Resident::of(roots, target.resident), compared(roots));
        let mut cuts = Cuts { nodes: HashMap::new(), order: vec![], target, copies, resident, once, starts };
        cuts.inspect_all(roots);
        let domains = lines::domains(&cuts);
        cuts.copies = lines::copies(&cuts, &domains);
        if !domains.is_empty() {
            cuts.inspect_all(roots);
        }
        let together: Vec<Axes> = domains.into_iter().chain(cuts.resident.domains()).collect();
        together.iter().for_each(|d| cuts.start_late(roots, d));
        cuts.sink(roots);
        cuts
    }

    fn inspect_all(&mut self, roots: &[Tensor]) {
        let is_root = |t: &Tensor| roots.iter().any(|r| r.id() == t.id());
        self.order.clear();
        for t in topological(roots.iter().cloned()) {
            // An identity is a node only if it must be written as such.
            if t.op().form() == Form::Identity && !is_root(&t) {
                continue;
            }
            for (domain, copy) in self.copies.of(t.id()).to_vec() {
                let info = self.inspect(&copy, Some((&t, &domain)));
                self.order.push(copy.id());
                self.nodes.insert(copy.id(), info);
            }
            let info = self.inspect(&t, None);
            self.order.push(t.id());
            self.nodes.insert(t.id(), info);
        }
        if !self.copies.is_empty() {
            self.keep_needed(roots);
        }
    }

    /// Drops nodes that only others' copies were for.
    fn keep_needed(&mut self, roots: &[Tensor]) {
        let mut needed: HashSet<u64> = HashSet::new();
        let mut stack: Vec<u64> = roots.iter().map(Tensor::id).collect();
        while let Some(id) = stack.pop() {
            if needed.insert(id) {
                stack.extend(self.nodes[&id].operands.iter().map(Tensor::id));
            }
        }
        self.order.retain(|id| needed.contains(id));
    }

    /// Starts the first region over `domain` as late as it can without making the last one later: what one layer needs
    /// from memory then does not part it from the layers before it, which need nothing.
    fn start_late(&mut self, roots: &[Tensor], domain: &Axes) {
        let Some((first, last)) = self.span(domain) else { return };
        for depth in (first + 1..=last).rev() {
            self.starts.insert(domain.clone(), depth);
            self.inspect_all(roots);
            if self.span(domain).is_some_and(|s| s.1 == last) {
                return;
            }
        }
        if self.starts.remove(domain).is_some() {
            self.inspect_all(roots);
        }
    }

    /// Least and greatest depth of what is computed over `domain`.
    fn span(&self, domain: &Axes) -> Option<(usize, usize)> {
        let here = self.order.iter().map(|id| &self.nodes[id]).filter(|i| i.runs_along(domain) && !i.free);
        here.map(|i| (i.depth, i.depth)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    pub fn get(&self, t: &Tensor) -> &Info {
        &self.nodes[&t.id()]
    }

    /// What is known of `t`, or of a copy of another node in the regions over a domain.
    fn inspect(&self, t: &Tensor, copy: Option<(&Tensor, &Axes)>) -> Info {
        let form = t.op().form();
        let operands: Vec<Tensor> = t.inputs().iter().map(resolve).collect();
        let mut domain = t.axes().clone();
        let mut reduces = false;
        if matches!(form, Form::Reduce(_) | Form::Outer | Form::Scatter { .. }) {
            domain = t.inputs().iter().fold(Axes::none(), |d, i| d.union(i.axes()));
            reduces = !(form == Form::Outer && domain == *t.axes());
        }
        if let Some((_, within)) = copy {
            (domain, reduces) = (within.clone(), false);
        }
        let mut inner = domain.last().cloned();
        if let Form::CumSum { axis, .. } | Form::Shift { axis, .. } = &form {
            inner = Some(axis.clone());
        }
        let mut info = Info {
            tensor: t.clone(),
            copy_of: copy.map(|(original, _)| original.clone()),
            form,
            domain,
            inner,
            grain: Grain::Row,
            operands,
            reduces,
            free: false,
            by_lane: false,
            after: After::Neither,
            depth: 0,
            closure_flops: 0,
        };
        let along = info.runs_along(&info.domain);
        for i in (0..info.operands.len()).filter(|_| along) {
            let copy = self.copies.within(info.operands[i].id(), &info.domain);
            if let Some(copy) = copy.filter(|_| !info.needs_buffer(i)) {
                info.operands[i] = copy.clone();
            }
        }
        info.after = after(self, &info);
        info.grain = self.resident.grain(&info).unwrap_or_else(|| self.grain(&info));
        info.by_lane = match info.form {
            Form::Input | Form::Const(_) | Form::Index { .. } | Form::Take { .. } => true,
            Form::Pointwise(_) | Form::Pick(_) | Form::Identity => info.operands.iter().all(|o| self.get(o).by_lane),
            _ => false,
        };
        let shapes: Vec<_> = info.operands.iter().map(|o| o.shape().clone()).collect();
        let own = t.op().work(&shapes, t.shape()).flops();
        let computed = |o: &&Tensor| !self.get(o).reduces;
        info.closure_flops = info
            .operands
            .iter()
            .filter(computed)
            .map(|o| self.get(o).closure_flops)
            .fold(own, |a, b| a.saturating_add(b));
        info.free = match &info.form {
            Form::Input | Form::Const(_) | Form::Index { .. } => true,
            _ if self.once.contains(&t.id()) => false,
            Form::Take { .. } => {
                matches!(self.get(&info.operands[0]).form, Form::Input) && self.get(&info.operands[1]).free
            }
            Form::Pointwise(_) | Form::Pick(_) | Form::ChannelSum(_) | Form::Identity => {
                info.operands.iter().all(|o| self.get(o).free)
            }
            _ => false,
        } && (info.closure_flops <= self.target.free_flops || matches!(info.form, Form::Pick(_)))
            && (0..info.operands.len()).all(|i| !self.stored_for(&info, i) || info.needs_buffer(i));
        info.depth = (0..info.operands.len())
            .map(|i| {
                let operand = self.get(&info.operands[i]);
                let stored = self.stored_for(&info, i);
                operand.depth + usize::from(stored && operand.form != Form::Input)
            })
            .max()
            .unwrap_or(0);
        if along {
            info.depth = info.depth.max(self.starts.get(&info.domain).copied().unwrap_or(0));
        }
        if info.free {
            info.depth = 0;
        }
        info
    }

    /// Seconds of storing what a node computes, and reading it once.
    pub fn stored(&self, info: &Info) -> f64 {
        // A CPU reads a line of memory before it writes to it.
        let passes = if self.target.kind == TargetKind::Cpu { 3 } else { 2 };
        self.target.seconds_of_bytes(passes * 4 * info.tensor.shape().lanes() as u64)
    }

    /// Seconds of computing a node again from its operands.
    pub fn again(&self, info: &Info) -> f64 {
        let shapes: Vec<_> = info.operands.iter().map(|o| o.shape().clone()).collect();
        let work = info.tensor.op().work(&shapes, info.tensor.shape());
        self.target.seconds_of(work * info.domain.elements() as u64, info.grain)
    }

    /// GPU: layers with the pointwise values after them, and wide values, work lane by lane, everything else row by row.
    fn grain(&self, info: &Info) -> Grain {
        let width = info.tensor.width();
        let along = |o: &Tensor| {
            let operand = self.get(o);
            operand.grain == Grain::Lane && operand.domain == info.domain && operand.inner == info.inner
        };
        let wide = match &info.form {
            Form::Linear { .. } => info.shared_weights() || info.operands[1].width() >= OWN_WEIGHTS,
            Form::Pointwise(_) => {
                let after = |o: &&Tensor| along(o) && o.width() == width;
                let only =
                    || info.operands.iter().filter(|o| !after(o)).all(|o| self.get(o).free && o.axes().is_empty());
                width >= WIDE || info.operands.iter().any(|o| after(&o)) && (width >= EPILOGUE || only())
            }
            Form::ChannelSum(_) => {
                let operand = self.get(&info.operands[0]);
                width >= GROUPS
                    && along(&info.operands[0])
                    && matches!(operand.form, Form::Pointwise(_) | Form::Pick(_))
            }
            Form::Identity => along(&info.operands[0]),
            Form::Const(_) | Form::Pick(_) | Form::Reduce(_) => width >= WIDE,
            _ => false,
        };
        if wide && self.target.kind == TargetKind::Gpu { Grain::Lane } else { Grain::Row }
    }

    /// Whether operand `i` of a node reaches it through memory. Free values are computed in place unless a buffer is needed.
    pub fn stored_for(&self, user: &Info, i: usize) -> bool {
        let operand = self.get(&user.operands[i]);
        if user.needs_buffer(i) {
            let weights = matches!(user.form, Form::Linear { .. });
            return operand.form != Form::Input && !(weights && self.is_view(&user.operands[i]));
        }
        let gpu = self.target.kind == TargetKind::Gpu;
        // Of a region's stores a GPU makes several kernels, each of which would compute the value again.
        if gpu && self.once.contains(&operand.tensor.id()) {
            return true;
        }
        let layer = matches!(user.form, Form::Linear { .. }) && user.grain == Grain::Lane;
        if gpu && (layer || user.form == Form::Outer && user.reduces) {
            return true;
        }
        let computable = operand.free && operand.by_lane;
        let wide_row = operand.tensor.width() > 1 && operand.grain == Grain::Row;
        if gpu && user.grain == Grain::Lane && wide_row && !computable {
            return true;
        }
        if operand.free {
            return false;
        }
        operand.reduces || operand.domain != user.domain || operand.inner != user.inner || operand.grain != user.grain
    }

    /// Weights that are consecutive channels of an input need no copy.
    pub fn is_view(&self, t: &Tensor) -> bool {
        view(t).is_some_and(|(buffer, _)| self.get(&buffer).form == Form::Input)
    }

    /// Over a single element, moves nodes as late as their users allow, and updates (which nobody waits for) to the last
    /// region: all parameters are then updated in one launch. Elsewhere nodes stay early: what they leave behind is smaller.
    fn sink(&mut self, roots: &[Tensor]) {
        let mut users: HashMap<u64, Vec<(u64, usize)>> = HashMap::new();
        for id in &self.order {
            for (i, o) in self.nodes[id].operands.iter().enumerate() {
                users.entry(o.id()).or_default().push((*id, i));
            }
        }
        let last =
            roots.iter().map(|r| self.get(r)).filter(|i| i.domain.is_empty()).map(|i| i.depth).max().unwrap_or(0);
        for id in self.order.clone().into_iter().rev() {
            let info = &self.nodes[&id];
            if info.free || info.reduces || !info.domain.is_empty() {
                continue;
            }
            let users = users.get(&id).map_or(&[][..], |u| u);
            let in_place = users.iter().all(|(u, i)| {
                let user = &self.nodes[u];
                !user.free && !self.stored_for(user, *i)
            });
            let is_root = roots.iter().any(|r| r.id() == id);
            let earliest = users.iter().map(|(u, _)| self.nodes[u].depth).min();
            let depth = match earliest {
                Some(d) if in_place => d.max(info.depth),
                None if is_root => last.max(info.depth),
                _ => info.depth,
            };
            if let Some(info) = self.nodes.get_mut(&id) {
                info.depth = depth;
            }
        }
    }
}

/// The tensor of which `t` is a range of consecutive channels, and the first of them.
pub(super) fn view(t: &Tensor) -> Option<(Tensor, usize)> {
    let Form::Pick(pick) = t.op().form() else { return Some((t.clone(), 0)) };
    let first = pick.first()?.1;
    let consecutive = pick.iter().enumerate().all(|(i, p)| p.0 == pick[0].0 && p.1 == first + i as u32);
    consecutive.then(|| (resolve(&t.inputs()[pick[0].0 as usize]), first as usize))
}
