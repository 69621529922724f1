//! Regions: what one launch computes.
//!
//! A region loops over a domain of axes. Its body is a straight-line list of instructions over values that have some of
//! those axes; its stores write values, or combine them over the axes that the target buffer lacks. Both lowerings, to a
//! CPU tile program and to a naga module, start from here.

use crate::cost::Work;
use crate::graph::{Axes, Axis};
use crate::ops::Reduction;
use crate::scalar::{DType, ScalarProgram};
use std::collections::HashSet;
use std::panic::Location;
use std::sync::Arc;

/// Index of an instruction in its region.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct InstId(pub u32);

/// Index of a buffer in its program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct BufferId(pub u32);

/// A matrix of weights inside a buffer: channels `first..first + rows * columns`, row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Weights {
    pub buffer: BufferId,
    pub first: usize,
    pub rows: usize,
    pub columns: usize,
    /// Contract with the columns instead of the rows.
    pub transposed: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub enum RegionOp {
    /// All channels of a buffer, at the element that the domain's position names.
    Load(BufferId),
    /// Constant lanes, one a channel.
    Const(Arc<[u32]>),
    /// Lane by lane; operands of 1 channel are broadcast.
    Map(Arc<ScalarProgram>),
    Pick(Arc<[(u32, u32)]>),
    ChannelSum(Arc<[Vec<u32>]>),
    ChannelMax,
    /// Contracts the operand's channels with weights that do not vary along the inner axis.
    Linear(Weights),
    /// The same with weights as the second operand, `rows x columns` channels varying along the inner axis.
    RowLinear {
        rows: usize,
        columns: usize,
        transposed: bool,
    },
    /// All products of a channel of operand 0 and one of operand 1.
    RowOuter,
    /// Exclusive cumulative sum along the inner axis.
    CumSum {
        reverse: bool,
    },
    /// `y[i] = x[i - by]` along the inner axis, 0 outside.
    Shift {
        by: i64,
    },
    /// Reduction over the inner axis: the same for all positions along it. Only on a CPU.
    RowReduce(Reduction),
    /// Position along an axis of the domain.
    Index(Axis),
    /// The table's element at operand 0 along `axis`, clamped to the last one.
    Take {
        table: BufferId,
        axis: Axis,
    },
    SymEig {
        n: usize,
    },
}

impl RegionOp {
    /// The buffer it reads.
    pub fn buffer(&self) -> Option<BufferId> {
        match self {
            RegionOp::Load(b) | RegionOp::Take { table: b, .. } => Some(*b),
            RegionOp::Linear(w) => Some(w.buffer),
            _ => None,
        }
    }
    fn buffer_mut(&mut self) -> Option<&mut BufferId> {
        match self {
            RegionOp::Load(b) | RegionOp::Take { table: b, .. } => Some(b),
            RegionOp::Linear(w) => Some(&mut w.buffer),
            _ => None,
        }
    }
}

/// One value of a region.
#[derive(Clone, Debug)]
pub struct Inst {
    pub op: RegionOp,
    pub inputs: Vec<InstId>,
    /// Axes along which the value varies, a subset of the domain.
    pub axes: Axes,
    pub channels: usize,
    pub dtype: DType,
    /// Name of the op it was recorded as, or of several fused.
    pub label: String,
    pub source: &'static Location<'static>,
}

/// How a region's result reaches memory.
#[derive(Clone, Debug, PartialEq)]
pub enum Store {
    /// Element by element; the buffer has the domain's axes.
    Write { value: InstId, buffer: BufferId },
    /// Combined over the domain's axes that the buffer lacks.
    Reduce { kind: Reduction, value: InstId, buffer: BufferId },
    /// `sum x_i d_o` over the domain's axes that the buffer lacks; none of the buffer's axes is the inner axis.
    Outer { x: InstId, d: InstId, buffer: BufferId },
    /// Added into the slot `index` of the buffer's `axis`, over the domain's axes that the buffer lacks.
    Scatter { value: InstId, index: InstId, axis: Axis, buffer: BufferId },
}

impl Store {
    pub fn buffer(&self) -> BufferId {
        match self {
            Store::Write { buffer, .. }
            | Store::Reduce { buffer, .. }
            | Store::Outer { buffer, .. }
            | Store::Scatter { buffer, .. } => *buffer,
        }
    }
    fn buffer_mut(&mut self) -> &mut BufferId {
        match self {
            Store::Write { buffer, .. }
            | Store::Reduce { buffer, .. }
            | Store::Outer { buffer, .. }
            | Store::Scatter { buffer, .. } => buffer,
        }
    }
    pub fn values(&self) -> Vec<InstId> {
        match self {
            Store::Write { value, .. } | Store::Reduce { value, .. } => vec![*value],
            Store::Outer { x, d, .. } => vec![*x, *d],
            Store::Scatter { value, index, .. } => vec![*value, *index],
        }
    }
    /// The same store of other values.
    pub fn map_values(&self, f: impl Fn(InstId) -> InstId) -> Store {
        let mut s = self.clone();
        match &mut s {
            Store::Write { value, .. } | Store::Reduce { value, .. } => *value = f(*value),
            Store::Outer { x, d, .. } => (*x, *d) = (f(*x), f(*d)),
            Store::Scatter { value, index, .. } => (*value, *index) = (f(*value), f(*index)),
        }
        s
    }
}

/// What a GPU invocation of the region works on; the CPU does not distinguish.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Grain {
    /// One position of the domain, all channels.
    Row,
    /// One channel of one position: wide layers.
    Lane,
    /// A workgroup shares a tile of positions, or a line of them, and keeps what its layers read.
    Tile,
}

/// One fused launch.
#[derive(Clone, Debug)]
pub struct Region {
    pub domain: Axes,
    /// The axis that tiles run along: the last of the domain unless a scan needs another. `None` for a domain of one element.
    pub inner: Option<Axis>,
    /// Whether a scan or a reduction inside the tile needs the whole inner axis in one tile.
    pub whole: bool,
    pub grain: Grain,
    pub body: Vec<Inst>,
    pub stores: Vec<Store>,
}

impl Region {
    pub fn inst(&self, id: InstId) -> &Inst {
        &self.body[id.0 as usize]
    }
    /// Whether a value is the same for all positions along the inner axis.
    pub fn is_uniform(&self, id: InstId) -> bool {
        self.inner.as_ref().is_none_or(|inner| !self.inst(id).axes.contains(inner))
    }
    /// Ids of the body, in order.
    pub fn ids(&self) -> impl Iterator<Item = InstId> + use<> {
        (0..self.body.len() as u32).map(InstId)
    }
    /// Every buffer the region reads, weights and tables included.
    pub fn reads(&self) -> Vec<BufferId> {
        let mut all: Vec<BufferId> = self.body.iter().filter_map(|i| i.op.buffer()).collect();
        all.sort();
        all.dedup();
        all
    }
    /// Every mention of a buffer, read or written.
    pub fn buffers_mut(&mut self) -> impl Iterator<Item = &mut BufferId> {
        let read = self.body.iter_mut().filter_map(|i| i.op.buffer_mut());
        read.chain(self.stores.iter_mut().map(Store::buffer_mut))
    }
    /// The buffers of which a channel is needed to compute another one: of the instructions that count, some that depends on
    /// them does more than compute every channel from the same channel. Whoever computes one channel must not replace it in them.
    pub fn mixed(&self, counts: impl Fn(usize) -> bool) -> HashSet<BufferId> {
        let mut mixed = vec![false; self.body.len()];
        let mut buffers = HashSet::new();
        for (at, inst) in self.body.iter().enumerate().rev().filter(|(at, _)| counts(*at)) {
            for input in &inst.inputs {
                let apart = matches!(inst.op, RegionOp::Map(_)) && self.inst(*input).channels == inst.channels;
                mixed[input.0 as usize] |= mixed[at] || !apart;
            }
            if let RegionOp::Load(b) = inst.op
                && mixed[at]
            {
                buffers.insert(b);
            }
        }
        buffers
    }
    /// Arithmetic of one run.
    pub fn work(&self) -> Work {
        let (products, others) = (Work::products, Work::others);
        let body = self.body.iter().map(|i| {
            let width = i.channels as u64;
            let each = match &i.op {
                RegionOp::Map(p) => others(p.flops() * width),
                RegionOp::Linear(w) => products(w.rows * w.columns),
                RegionOp::RowLinear { rows, columns, .. } => products(rows * columns),
                RegionOp::SymEig { n } => others(60 * (n * n * n) as u64),
                RegionOp::ChannelSum(g) => others(g.iter().map(|g| g.len() as u64).sum()),
                RegionOp::RowReduce(_) => others(width * self.inner.as_ref().map_or(1, Axis::size) as u64),
                RegionOp::RowOuter | RegionOp::ChannelMax | RegionOp::CumSum { .. } => others(width),
                _ => Work::default(),
            };
            each * i.axes.elements() as u64
        });
        let stores = self.stores.iter().map(|s| {
            let each = match s {
                Store::Write { .. } => Work::default(),
                Store::Reduce { value, .. } | Store::Scatter { value, .. } => others(self.inst(*value).channels as u64),
                Store::Outer { x, d, .. } => products(self.inst(*x).channels * self.inst(*d).channels),
            };
            each * self.domain.elements() as u64
        });
        body.chain(stores).sum()
    }
    /// Floating-point operations of one run.
    pub fn flops(&self) -> u64 {
        self.work().flops()
    }

    /// The region without instructions that no store needs, renumbered.
    pub fn swept(self) -> Region {
        let mut live = vec![false; self.body.len()];
        for value in self.stores.iter().flat_map(|s| s.values()) {
            live[value.0 as usize] = true;
        }
        for at in (0..self.body.len()).rev() {
            if live[at] {
                self.body[at].inputs.iter().for_each(|i| live[i.0 as usize] = true);
            }
        }
        let mut new_id = vec![InstId(0); self.body.len()];
        let mut body = vec![];
        for (at, inst) in self.body.into_iter().enumerate() {
            if live[at] {
                new_id[at] = InstId(body.len() as u32);
                let inputs = inst.inputs.iter().map(|i| new_id[i.0 as usize]).collect();
                body.push(Inst { inputs, ..inst });
            }
        }
        let stores = self.stores.iter().map(|s| s.map_values(|v| new_id[v.0 as usize])).collect();
        Region { body, stores, ..self }
    }
}
