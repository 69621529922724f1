//! A launch's region cut into parts, each what one kind of kernel does.
//!
//! Values that a part needs and another computes go through memory: through the buffer they are written to anyway, or
//! through scratch memory. The order of parts is: sums over what the region reads, layers, other values written, sums
//! over what was written. A value that replaces an input which a later part still reads is put aside and copied last.

mod aside;

use super::elements::{self, closure};
use super::half::is_multiplied;
use super::homes::Homes;
use super::layout::{Layout, Limits};
use super::regions::{empty, push_load, replace_by_load, swept_with, written_by};
use super::{Kernel, LowerError, layer, outer, reduce, resident, scan, scatter, stages};
use raygrad_compiler::graph::{Axes, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::ops::pick::runs;
use raygrad_compiler::plan::Launch;
use raygrad_compiler::plan::region::{BufferId, Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;

/// Most products of an `Outer` that are sums of their own, of one invocation or of a workgroup each.
const SMALL_OUTER: usize = 64;
/// The same where one side has so few channels that tiles would be mostly padding.
const NARROW: usize = 4;
/// Operations per element from which a value is written once rather than computed by two parts.
const EXPENSIVE: usize = 200;

/// Channels of a layer from which it writes its part of a concatenation itself.
const WIDE: usize = 16;
/// Most parts of such a concatenation.
const MAX_SLICES: usize = 4;

enum Part {
    Elements(Region),
    Layer(Region, InstId),
    Scan(Region),
    Reduce(Region),
    Outer(Region),
    Scatter(Region),
    Resident(Region),
}

impl Part {
    fn region(&mut self) -> &mut Region {
        match self {
            Part::Elements(r)
            | Part::Layer(r, _)
            | Part::Scan(r)
            | Part::Reduce(r)
            | Part::Outer(r)
            | Part::Scatter(r)
            | Part::Resident(r) => r,
        }
    }
}

/// Kernels of a launch, in order.
pub(super) fn lower(layout: &mut Layout, limits: Limits, launch: &Launch) -> Result<Vec<Kernel>, LowerError> {
    let region = launch.region.clone();
    let mut split = Split { layout, limits, region, sums: vec![], writers: vec![], late: vec![] };
    split.run()?;
    let Split { sums, writers, late, .. } = split;
    let mut parts: Vec<Part> = sums.into_iter().chain(writers).chain(late).collect();
    aside::put_aside(layout, &launch.region, &mut parts)?;
    let several = parts.len() > 1;
    let mut kernels = vec![];
    for (i, part) in parts.into_iter().enumerate() {
        let name = if several { format!("{}.{}", launch.name, part_name(&part, i)) } else { launch.name.clone() };
        match part {
            Part::Elements(r) => {
                let stages = stages::stages(layout, r)?;
                let several = stages.len() > 1;
                for (i, stage) in stages.iter().enumerate() {
                    let name = if several { format!("{name}.stage_{}", i + 1) } else { name.clone() };
                    kernels.extend(elements::kernels(layout, limits, &name, stage)?);
                }
            }
            Part::Layer(r, linear) => kernels.extend(layer::kernels(layout, limits, &name, &r, linear)?),
            Part::Scan(r) => {
                let (before, scan) = stages::before_scan(layout, r)?;
                if let Some(before) = before {
                    kernels.extend(elements::kernels(layout, limits, &format!("{name}.before"), &before)?);
                }
                kernels.push(scan::kernel(layout, limits, &name, &scan)?);
            }
            Part::Reduce(r) => kernels.extend(reduce::kernels(layout, limits, &name, &r)?),
            Part::Outer(r) => kernels.extend(outer::kernels(layout, limits, &name, &r)?),
            Part::Scatter(r) => kernels.extend(scatter::kernels(layout, limits, &name, &r)?),
            Part::Resident(r) => kernels.push(resident::kernel(layout, limits, &name, &r)?),
        }
    }
    Ok(kernels)
}

fn part_name(part: &Part, i: usize) -> String {
    let kind = match part {
        Part::Elements(_) => "map",
        Part::Layer(..) => "layer",
        Part::Scan(_) => "scan",
        Part::Reduce(_) => "reduce",
        Part::Outer(_) => "outer",
        Part::Scatter(_) => "scatter",
        Part::Resident(_) => "network",
    };
    format!("{}_{kind}", i + 1)
}

struct Split<'l, 'a> {
    layout: &'l mut Layout<'a>,
    limits: Limits,
    region: Region,
    sums: Vec<Part>,
    writers: Vec<Part>,
    late: Vec<Part>,
}

impl Split<'_, '_> {
    fn run(&mut self) -> Result<(), LowerError> {
        let (writes, others): (Vec<Store>, Vec<Store>) =
            self.region.stores.clone().into_iter().partition(|s| matches!(s, Store::Write { .. }));
        self.region.stores = writes;
        let resident = resident::is_resident(&self.region);
        // All values are written by one kernel, which also combines what it can over lines.
        let together = self.region.whole || resident;
        if !together {
            self.slice_concatenations(&others);
        }
        let homes = Homes::of(&self.region);
        let (mut on_lines, mut in_layers) = (vec![], vec![]);
        let mut recomputed: Vec<Store> = vec![];
        let mut reloaded: Vec<Store> = vec![];
        for store in others {
            let followed = |s: &Store| !resident || resident::follows(&self.region, s);
            if together && self.is_along_lines(&store) && followed(&store) {
                on_lines.push(store);
            } else if !together && self.is_layers_total(&homes, &store) {
                in_layers.push(store);
            } else if together || self.must_reload(&store, &homes) {
                reloaded.push(store);
            } else {
                recomputed.push(store);
            }
        }
        self.combine(recomputed)?;
        let mut late_region = empty(&self.region);
        for store in reloaded {
            let mut values = vec![];
            let product = matches!(store, Store::Outer { .. });
            for value in store.values() {
                let buffer = self.materialize(value, product)?;
                values.push((value, self.push_load(&mut late_region, buffer)));
            }
            let find = |v: InstId| values.iter().find(|x| x.0 == v).map_or(v, |x| x.1);
            late_region.stores.push(store.map_values(find));
        }
        self.write(&homes, on_lines, in_layers)?;
        let late = std::mem::replace(&mut self.region, late_region);
        let stores = std::mem::take(&mut self.region.stores);
        let before = self.sums.len();
        self.combine(stores)?;
        self.late = self.sums.split_off(before);
        self.region = late;
        Ok(())
    }

    /// Lets a layer write its channels of a concatenation itself, and what lies beside them be written for itself, where
    /// nothing else needs the whole.
    fn slice_concatenations(&mut self, others: &[Store]) {
        let homes = Homes::of(&self.region);
        let reads = self.region.reads();
        for store in std::mem::take(&mut self.region.stores) {
            let (value, buffer) = (store.values()[0], store.buffer());
            let used = self.region.body.iter().any(|i| i.inputs.contains(&value))
                || self.region.stores.iter().chain(others).any(|s| s.values().contains(&value));
            let slices = if used || reads.contains(&buffer) { None } else { self.slices(&homes, value, buffer) };
            match slices {
                Some(slices) => self.region.stores.extend(slices),
                None => self.region.stores.push(store),
            }
        }
    }

    /// Writes of the parts of a concatenation with a layer's channels.
    fn slices(&mut self, homes: &Homes, value: InstId, buffer: BufferId) -> Option<Vec<Store>> {
        let inst = self.region.inst(value).clone();
        let RegionOp::Pick(pick) = &inst.op else { return None };
        if inst.dtype != DType::F32 || self.layout.shape(buffer).axes != self.region.domain {
            return None;
        }
        let runs: Vec<&[(u32, u32)]> = runs(pick).collect();
        let whole = |run: &[(u32, u32)]| {
            let operand = inst.inputs[run[0].0 as usize];
            (run[0].1 == 0 && run.len() == self.region.inst(operand).channels).then_some(operand)
        };
        let of_layer = |run: &&[(u32, u32)]| {
            run.len() >= WIDE && whole(run).is_some_and(|operand| homes.home[operand.0 as usize].is_some())
        };
        if runs.len() > MAX_SLICES || !runs.iter().any(of_layer) {
            return None;
        }
        let operands: Vec<Option<InstId>> = runs.iter().map(|run| whole(run)).collect();
        let (mut first, mut stores) = (0, vec![]);
        for (run, operand) in runs.into_iter().zip(operands) {
            let own = operand.unwrap_or_else(|| {
                let op = RegionOp::Pick(run.into());
                self.region.body.push(Inst { op, channels: run.len(), ..inst.clone() });
                InstId(self.region.body.len() as u32 - 1)
            });
            let buffer = self.layout.slice(buffer, first..first + run.len())?;
            stores.push(Store::Write { value: own, buffer });
            first += run.len();
        }
        Some(stores)
    }

    /// Reductions over exactly the axis that a scan's invocations run along.
    fn is_along_lines(&self, store: &Store) -> bool {
        let inner = Axes::new(self.region.inner.clone());
        matches!(store, Store::Reduce { buffer, .. }
            if self.layout.shape(*buffer).axes == self.region.domain.minus(&inner))
    }

    /// Reductions over the whole domain of what a layer's kernel computes.
    fn is_layers_total(&self, homes: &Homes, store: &Store) -> bool {
        let Store::Reduce { value, buffer, .. } = store else { return false };
        let home = homes.home[value.0 as usize].map(|level| homes.layers[level]);
        self.layout.shape(*buffer).axes.is_empty()
            && self.region.inst(*value).axes == self.region.domain
            && home.is_some_and(|linear| {
                self.region.inst(linear).channels == self.region.inst(*value).channels
                    && layer::has_totals(self.layout, &self.limits, &self.region, linear)
            })
    }

    /// Whether a combined value is better read back than computed by the kernel that combines it.
    fn must_reload(&self, store: &Store, homes: &Homes) -> bool {
        let needed = closure(&self.region, store.values());
        let layers = needed.iter().zip(&homes.level).any(|(n, l)| *n && l.is_some());
        let written: Vec<InstId> = self.region.stores.iter().flat_map(|s| s.values()).collect();
        let shared = closure(&self.region, written);
        let cost: usize = (0..self.region.body.len())
            .filter(|i| needed[*i] && shared[*i])
            .map(|i| self.region.body[i].channels * elements::own_cost(&self.region, i))
            .sum();
        let channels: usize = store.values().iter().map(|v| self.region.inst(*v).channels).sum();
        layers || cost > EXPENSIVE + 16 * channels
    }

    /// Parts for stores that combine values over axes, computed from the region's body.
    fn combine(&mut self, stores: Vec<Store>) -> Result<(), LowerError> {
        let mut reductions: Vec<(Axes, Region)> = vec![];
        for store in stores {
            let axes = self.layout.shape(store.buffer()).axes.clone();
            let store = match store {
                Store::Outer { x, d, buffer } if self.small_outer(x, d) => {
                    let product = self.push_product(x, d);
                    Store::Reduce { kind: Reduction::Sum, value: product, buffer }
                }
                other => other,
            };
            match &store {
                Store::Reduce { .. } => match reductions.iter_mut().find(|r| r.0 == axes) {
                    Some((_, region)) => region.stores.push(store),
                    None => reductions.push((axes, Region { stores: vec![store], ..empty(&self.region) })),
                },
                Store::Outer { x, d, buffer } => {
                    let mut loads = empty(&self.region);
                    let (x, d) = (self.loaded(&mut loads, *x)?, self.loaded(&mut loads, *d)?);
                    loads.stores = vec![Store::Outer { x, d, buffer: *buffer }];
                    self.sums.push(Part::Outer(loads));
                }
                Store::Scatter { value, index, axis, buffer } => {
                    // Every slot looks at every element: what it looks at should be a load.
                    let mut loads = empty(&self.region);
                    let (value, index) = (self.loaded(&mut loads, *value)?, self.loaded(&mut loads, *index)?);
                    loads.stores = vec![Store::Scatter { value, index, axis: axis.clone(), buffer: *buffer }];
                    self.sums.push(Part::Scatter(loads));
                }
                Store::Write { .. } => {}
            }
        }
        for (_, mut region) in reductions {
            region.body = self.region.body.clone();
            self.sums.push(Part::Reduce(region.swept()));
        }
        Ok(())
    }

    fn small_outer(&self, x: InstId, d: InstId) -> bool {
        let (x, d) = (self.region.inst(x).channels, self.region.inst(d).channels);
        x * d <= SMALL_OUTER || x.min(d) <= NARROW
    }

    fn push_product(&mut self, x: InstId, d: InstId) -> InstId {
        let channels = self.region.inst(x).channels * self.region.inst(d).channels;
        let product = Inst {
            op: RegionOp::RowOuter,
            inputs: vec![x, d],
            axes: self.region.domain.clone(),
            channels,
            label: "outer".into(),
            ..self.region.inst(x).clone()
        };
        self.region.body.push(product);
        InstId(self.region.body.len() as u32 - 1)
    }

    /// A value as a load in another region; written to scratch memory by a part of its own unless it is a load already.
    fn loaded(&mut self, into: &mut Region, value: InstId) -> Result<InstId, LowerError> {
        if let RegionOp::Load(_) = self.region.inst(value).op {
            into.body.push(self.region.inst(value).clone());
            return Ok(InstId(into.body.len() as u32 - 1));
        }
        let inst = self.region.inst(value);
        let shape = Shape::of(self.region.domain.clone(), inst.channels, inst.dtype);
        let buffer = self.layout.scratch_for_product(&inst.label.clone(), shape)?;
        let stores = vec![Store::Write { value, buffer }];
        self.sums.push(Part::Elements(Region { stores, ..self.region.clone() }.swept()));
        Ok(self.push_load(into, buffer))
    }

    /// The buffer that a value is written to: one of the region's own, or scratch memory. `product`: a matrix product
    /// reads it.
    fn materialize(&mut self, value: InstId, product: bool) -> Result<BufferId, LowerError> {
        if let RegionOp::Load(buffer) = self.region.inst(value).op {
            return Ok(buffer);
        }
        if let Some(buffer) = written_by(&self.region, value) {
            return Ok(buffer);
        }
        let inst = self.region.inst(value);
        let shape = Shape::of(self.region.domain.clone(), inst.channels, inst.dtype);
        let name = inst.label.clone();
        let buffer = match product {
            true => self.layout.scratch_for_product(&name, shape)?,
            false => self.layout.scratch(&name, shape)?,
        };
        self.region.stores.push(Store::Write { value, buffer });
        Ok(buffer)
    }

    fn push_load(&self, region: &mut Region, buffer: BufferId) -> InstId {
        push_load(self.layout, region, buffer)
    }

    /// Parts for values written element by element, and for reductions along a scan's lines or of what layers compute.
    fn write(&mut self, homes: &Homes, on_lines: Vec<Store>, in_layers: Vec<Store>) -> Result<(), LowerError> {
        let resident = resident::is_resident(&self.region);
        if self.region.whole || resident {
            let mut region = self.region.clone();
            region.stores.extend(on_lines);
            if !region.stores.is_empty() {
                let region = region.swept();
                self.writers.push(if resident { Part::Resident(region) } else { Part::Scan(region) });
            }
            return Ok(());
        }
        // Values that cross from one layer's kernel to another part.
        let mut cut: Vec<(InstId, BufferId)> = vec![];
        for id in self.region.ids() {
            if homes.cut.get(id.0 as usize).is_some_and(|c| *c) {
                let product = is_multiplied(&self.region, id);
                cut.push((id, self.materialize(id, product)?));
            }
        }
        let mut stores = std::mem::take(&mut self.region.stores);
        stores.extend(in_layers);
        let home = |s: &Store| homes.home.get(s.values()[0].0 as usize).copied().flatten();
        for (level, linear) in homes.layers.iter().enumerate() {
            let own: Vec<Store> = stores.iter().filter(|s| home(s) == Some(level)).cloned().collect();
            if own.is_empty() {
                continue;
            }
            let mut region = Region { stores: own, ..self.region.clone() };
            for (id, buffer) in cut.iter().filter(|c| homes.home[c.0.0 as usize] != Some(level)) {
                replace_by_load(self.layout, &mut region, *id, *buffer);
            }
            let (region, renamed) = swept_with(region, *linear);
            self.writers.push(Part::Layer(region, renamed));
        }
        let rest: Vec<Store> = stores.into_iter().filter(|s| home(s).is_none()).collect();
        if !rest.is_empty() {
            let mut region = Region { stores: rest, ..self.region.clone() };
            for (id, buffer) in &cut {
                replace_by_load(self.layout, &mut region, *id, *buffer);
            }
            self.writers.push(Part::Elements(region.swept()));
        }
        Ok(())
    }
}
