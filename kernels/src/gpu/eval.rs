//! Values of a region at one position of its domain (or four side by side), built on demand, each once.
//!
//! A channel is a number known now or a value of the kernel: the first unrolls, the second indexes.

mod folds;

use super::builder::{Memory, Value};
use super::channels::{Linear, Run, affine, is_indexable, runs_of};
use super::memory::{Emit, kind};
use super::position::{Position, is_constant, is_run};
use super::{eigen, scalar};
use naga::BinaryOperator as Op;
use raygrad_compiler::graph::{Axes, Axis};
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp};
use raygrad_compiler::scalar::DType;
use std::collections::HashMap;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Channel {
    At(u32),
    Var(Value),
}

impl Channel {
    pub fn value(self, e: &mut Emit) -> Value {
        match self {
            Channel::At(c) => e.b.u(c),
            Channel::Var(v) => v,
        }
    }
}

pub(super) struct Values<'r> {
    region: &'r Region,
    at: Vec<Position>,
    /// Axes along which the four positions neighbour, the first at a multiple of four.
    neighbours: Vec<Axes>,
    /// Values with the block they were built in.
    known: HashMap<(InstId, Channel), (Value, u32)>,
    eigen: HashMap<InstId, (Memory, u32)>,
    /// Scans that are read back.
    stored: HashMap<InstId, BufferId>,
    /// The same values at another position, for shifts.
    shifted: HashMap<InstId, (Box<Values<'r>>, u32)>,
}

impl<'r> Values<'r> {
    /// Values at one position, or at four as vectors.
    pub fn new(region: &'r Region, at: Vec<Position>) -> Values<'r> {
        Values {
            region,
            at,
            neighbours: vec![],
            known: HashMap::new(),
            eigen: HashMap::new(),
            stored: HashMap::new(),
            shifted: HashMap::new(),
        }
    }

    /// Values at an element of `rows`, or if `fours` at four neighbours from it on; `position` is where an element is.
    pub fn from(
        e: &mut Emit,
        region: &'r Region,
        (rows, first, fours): (&Axes, Value, bool),
        position: impl Fn(Value) -> Position,
    ) -> Values<'r> {
        if !fours {
            return Values::new(region, vec![position(first)]);
        }
        let all = [0, 1, 2, 3].map(|i| {
            let offset = e.b.u(i);
            position(e.b.add(first, offset))
        });
        Values::new(region, all.to_vec()).side_by_side(rows)
    }

    /// Says that the positions are four neighbours in `rows`, the first at a multiple of four, so that a kernel `with_vectors`
    /// loads them at once.
    pub fn side_by_side(mut self, rows: &Axes) -> Values<'r> {
        self.neighbours.push(rows.clone());
        self
    }

    /// Reads the given scans from memory unless they are given.
    pub fn reading(mut self, stored: &HashMap<InstId, BufferId>) -> Values<'r> {
        self.stored.clone_from(stored);
        self
    }

    /// Makes a value known instead of building it.
    pub fn give(&mut self, e: &Emit, id: InstId, channel: Channel, value: Value) {
        self.known.insert((id, channel), (value, e.b.scope()));
    }

    /// All channels of a value.
    pub fn all(&mut self, e: &mut Emit, id: InstId) -> Vec<Value> {
        (0..self.region.inst(id).channels as u32).map(|c| self.channel(e, id, Channel::At(c))).collect()
    }

    pub fn channel(&mut self, e: &mut Emit, id: InstId, channel: Channel) -> Value {
        let inst = self.region.inst(id);
        let channel = if inst.channels == 1 { Channel::At(0) } else { channel };
        if let Some((value, scope)) = self.known.get(&(id, channel))
            && e.b.is_open(*scope)
        {
            return *value;
        }
        let value = self.build(e, id, channel);
        self.known.insert((id, channel), (value, e.b.scope()));
        value
    }

    fn build(&mut self, e: &mut Emit, id: InstId, channel: Channel) -> Value {
        let region = self.region;
        let inst = region.inst(id);
        match &inst.op {
            RegionOp::Load(buffer) => {
                let name = e.layout.name(*buffer).to_string();
                e.b.topic(&name);
                self.load(e, *buffer, channel)
            }
            RegionOp::Const(bits) => constant(e, bits, inst.dtype, channel),
            RegionOp::Map(program) => {
                let inputs: Vec<Value> = inst.inputs.iter().map(|i| self.channel(e, *i, channel)).collect();
                e.b.topic(&inst.label);
                scalar::emit(&mut e.b, program, &inputs, kind(inst.dtype))
            }
            RegionOp::Pick(pick) => match channel {
                Channel::At(c) => {
                    let (operand, from) = pick[c as usize];
                    self.channel(e, inst.inputs[operand as usize], Channel::At(from))
                }
                Channel::Var(c) => self.choose(e, id, c),
            },
            RegionOp::ChannelSum(groups) => match channel {
                Channel::At(c) => self.sum(e, inst.inputs[0], &groups[c as usize]),
                Channel::Var(c) => self.choose(e, id, c),
            },
            RegionOp::ChannelMax => self.channel_max(e, inst.inputs[0]),
            RegionOp::Linear(w) => self.linear(e, inst.inputs[0], w, channel),
            RegionOp::RowLinear { rows, columns, transposed } => {
                let (x, w) = (inst.inputs[0], inst.inputs[1]);
                let size = (*rows, *columns);
                let weight = |values: &mut Self, e: &mut Emit, c: Channel| values.channel(e, w, c);
                self.contract(e, x, size, *transposed, channel, is_indexable(region, w), weight)
            }
            RegionOp::RowOuter => {
                let width = region.inst(inst.inputs[1]).channels as u32;
                let (i, o) = match channel {
                    Channel::At(c) => (Channel::At(c / width), Channel::At(c % width)),
                    Channel::Var(c) => {
                        let width = e.b.u(width);
                        (Channel::Var(e.b.div(c, width)), Channel::Var(e.b.rem(c, width)))
                    }
                };
                let (x, d) = (self.channel(e, inst.inputs[0], i), self.channel(e, inst.inputs[1], o));
                e.b.topic(&inst.label);
                e.b.mul(x, d)
            }
            RegionOp::Index(axis) => {
                let at: Vec<Value> = self.at.clone().iter().map(|p| p.coordinate(e, axis)).collect();
                vector(e, &at)
            }
            RegionOp::Take { table, axis } => self.take(e, *table, axis, inst.inputs[0], channel),
            RegionOp::SymEig { n } => self.sym_eig(e, id, *n, channel),
            RegionOp::CumSum { .. } => match self.stored.get(&id) {
                Some(buffer) => self.load(e, *buffer, channel),
                None => unreachable!("scans are given by the kernel that runs along their axis"),
            },
            RegionOp::Shift { by } => self.shift(e, id, *by, channel),
            RegionOp::RowReduce(_) => unreachable!("on a GPU every reduction ends its region"),
        }
    }

    /// A channel of a buffer where the positions are.
    fn load(&mut self, e: &mut Emit, buffer: BufferId, channel: Channel) -> Value {
        let (axes, dtype) = (e.layout.shape(buffer).axes.clone(), e.layout.shape(buffer).dtype);
        let channel = channel.value(e);
        if dtype == DType::F32 && self.neighbours.iter().any(|rows| is_run(&axes, rows)) {
            let element = self.at[0].element(e, &axes);
            let at = e.index(buffer, channel, element);
            return e.load_four(buffer, at);
        }
        // Rows of a tile are no rows of a buffer in memory.
        let of_domain = |rows: &&Axes| rows.is_subset(&self.region.domain);
        if self.neighbours.iter().filter(of_domain).any(|rows| is_constant(&axes, rows)) {
            let element = self.at[0].element(e, &axes);
            let at = e.index(buffer, channel, element);
            return e.load(buffer, at);
        }
        self.gather(e, |e, position| {
            let element = position.element(e, &axes);
            (buffer, e.index(buffer, channel, element))
        })
    }

    /// One load for all positions if they agree, else one each.
    fn gather(&mut self, e: &mut Emit, index: impl Fn(&mut Emit, &Position) -> (BufferId, Value)) -> Value {
        let indices: Vec<(BufferId, Value)> = self.at.iter().map(|p| index(e, p)).collect();
        if indices.iter().all(|i| *i == indices[0]) {
            return e.load(indices[0].0, indices[0].1);
        }
        let lanes: Vec<Value> = indices.into_iter().map(|(buffer, index)| e.load(buffer, index)).collect();
        vector(e, &lanes)
    }

    fn take(&mut self, e: &mut Emit, table: BufferId, axis: &Axis, index: InstId, channel: Channel) -> Value {
        let index = self.channel(e, index, Channel::At(0));
        let channel = channel.value(e);
        let axes = e.layout.shape(table).axes.clone();
        let name = e.layout.name(table).to_string();
        e.b.topic(&name);
        let lanes: Vec<Value> = (0..self.at.len() as u32)
            .map(|i| {
                let index = if index.vector { e.b.component(index, i) } else { index };
                let last = e.b.u(axis.size() as u32 - 1);
                let slot = e.b.math(naga::MathFunction::Min, &[index, last]);
                let position = self.at[i as usize].clone().with(axis, slot);
                let element = position.element(e, &axes);
                let at = e.index(table, channel, element);
                e.load(table, at)
            })
            .collect();
        vector(e, &lanes)
    }

    /// Zero, a vector where there are four positions.
    /// Channel `c` of a choice or of sums of channels: a branch a range of c.
    fn choose(&mut self, e: &mut Emit, id: InstId, c: Value) -> Value {
        let inst = self.region.inst(id);
        let runs = runs_of(&inst.op);
        let Some((last, before)) = runs.split_last() else { return e.b.literal(kind(inst.dtype), 0) };
        if before.is_empty() {
            return self.run(e, id, last, c);
        }
        let zero = e.b.literal(kind(inst.dtype), 0);
        let zero = if self.at.len() == 4 { e.b.splat(zero) } else { zero };
        let chosen = e.b.var("chosen", zero);
        let mut branch = |e: &mut Emit, run: &Run| {
            let value = self.run(e, id, run, c);
            let value = if chosen.is_vector() { e.b.splat(value) } else { value };
            e.b.set(chosen, value);
        };
        for run in before {
            let end = e.b.u(run.end);
            let here = e.b.less(c, end);
            e.b.open_if(here);
            branch(e, run);
            e.b.open_else();
        }
        branch(e, last);
        before.iter().for_each(|_| e.b.close_if());
        e.b.get(chosen)
    }

    /// Channel `c` of a range of output channels.
    fn run(&mut self, e: &mut Emit, id: InstId, run: &Run, c: Value) -> Value {
        let inst = self.region.inst(id);
        let mut sum: Option<Value> = None;
        for term in &run.terms {
            let operand = inst.inputs[term.operand];
            let (count, step) = (term.count, term.step);
            let value = if run.end - run.first == 1 && count == 1 {
                self.channel(e, operand, Channel::At(term.from.base))
            } else {
                let first = e.b.u(run.first);
                let own = e.b.sub(c, first);
                let from = linear(e, &term.from, own);
                if count == 1 {
                    self.channel(e, operand, Channel::Var(from))
                } else {
                    let zero = self.zero(e);
                    self.fold(e, count, zero, |values, e, sum, i| {
                        let step = e.b.u(step);
                        let offset = e.b.mul(i, step);
                        let at = e.b.add(from, offset);
                        let term = values.channel(e, operand, Channel::Var(at));
                        e.b.add(sum, term)
                    })
                }
            };
            sum = Some(sum.map_or(value, |s| e.b.add(s, value)));
        }
        sum.unwrap_or_else(|| e.b.literal(kind(inst.dtype), 0))
    }

    /// The operand `by` places earlier along the inner axis, 0 outside.
    fn shift(&mut self, e: &mut Emit, id: InstId, by: i64, channel: Channel) -> Value {
        let Some(inner) = self.region.inner.clone() else { return e.b.f(0.0) };
        let here = self.at[0].coordinate(e, &inner);
        let (by, size) = (e.b.u(by as u32), e.b.u(inner.size() as u32));
        // Before the first one the difference wraps around to a large number.
        let from = e.b.sub(here, by);
        let inside = e.b.less(from, size);
        let mut there = match self.shifted.remove(&id) {
            Some((values, scope)) if e.b.is_open(scope) => values,
            _ => {
                let (zero, last) = (e.b.u(0), e.b.u(inner.size() as u32 - 1));
                let from = e.b.select(inside, from, zero);
                let from = e.b.math(naga::MathFunction::Min, &[from, last]);
                let at = self.at[0].clone().with(&inner, from);
                Box::new(Values::new(self.region, vec![at]).reading(&self.stored))
            }
        };
        let value = there.channel(e, self.region.inst(id).inputs[0], channel);
        self.shifted.insert(id, (there, e.b.scope()));
        let zero = e.b.f(0.0);
        e.b.select(inside, value, zero)
    }

    fn sym_eig(&mut self, e: &mut Emit, id: InstId, n: usize, channel: Channel) -> Value {
        let known = self.eigen.get(&id).filter(|(_, scope)| e.b.is_open(*scope)).map(|k| k.0);
        let result = match known {
            Some(result) => result,
            None => {
                let matrix = self.all(e, self.region.inst(id).inputs[0]);
                let result = eigen::sym_eig(&mut e.b, n as u32, &matrix);
                self.eigen.insert(id, (result, e.b.scope()));
                result
            }
        };
        e.b.topic("eigen");
        let at = channel.value(e);
        e.b.load(result, at)
    }
}

/// A formula's value for a number.
fn linear(e: &mut Emit, formula: &Linear, number: Value) -> Value {
    let mut at = e.b.u(formula.base);
    let mut rest = number;
    for (i, (radix, stride)) in formula.digits.iter().enumerate() {
        let radix = e.b.u(*radix);
        let last = i + 1 == formula.digits.len();
        let digit = if last { rest } else { e.b.rem(rest, radix) };
        let size = e.b.u(stride.unsigned_abs() as u32);
        let moved = e.b.mul(digit, size);
        at = if *stride < 0 { e.b.sub(at, moved) } else { e.b.add(at, moved) };
        if !last {
            rest = e.b.div(rest, radix);
        }
    }
    at
}

/// Constant lanes.
fn constant(e: &mut Emit, bits: &[u32], dtype: DType, channel: Channel) -> Value {
    let kind = kind(dtype);
    match channel {
        Channel::At(c) => e.b.literal(kind, bits[c as usize]),
        Channel::Var(_) if bits.iter().all(|b| *b == bits[0]) => e.b.literal(kind, bits[0]),
        Channel::Var(c) => match affine(bits) {
            Some((first, step)) if dtype == DType::U32 => {
                let (first, step) = (e.b.u(first), e.b.u(step));
                let moved = e.b.mul(c, step);
                e.b.add(moved, first)
            }
            _ => {
                let mut value = e.b.literal(kind, bits[0]);
                for (i, bits) in bits.iter().enumerate().skip(1) {
                    let (i, other) = (e.b.u(i as u32), e.b.literal(kind, *bits));
                    let here = e.b.binary(Op::Equal, c, i);
                    value = e.b.select(here, other, value);
                }
                value
            }
        },
    }
}

/// One value for all positions if they agree, else a vector.
fn vector(e: &mut Emit, lanes: &[Value]) -> Value {
    match lanes {
        [a, b, c, d] if !(a == b && b == c && c == d) => e.b.vector([*a, *b, *c, *d]),
        _ => lanes[0],
    }
}
