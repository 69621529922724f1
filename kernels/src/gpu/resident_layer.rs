//! A layer of a resident network: rows and results in the workgroup's memory, weights from where they lie.
//!
//! An invocation sums up four rows of neighbouring outputs. All have read before any writes, so that results may take the place
//! of what they were computed from.

use super::builder::{Value, Var};
use super::eval::Channel;
use super::memory::Emit;
use super::resident::{First, Network, PER_ROW};
use naga::MathFunction as Math;
use raygrad_compiler::plan::region::{BufferId, InstId, Region, RegionOp, Weights};

/// Blocks side by side: each has all outputs of four rows, divided by this.
const BLOCKS: u32 = 4 * PER_ROW;

/// The layer `linear` with what follows from it.
pub(super) fn emit(
    network: &Network,
    e: &mut Emit,
    region: &Region,
    (linear, results): (InstId, &[InstId]),
    first: First,
) {
    let inst = region.inst(linear);
    let (RegionOp::Linear(weights), RegionOp::Load(input)) = (&inst.op, &region.inst(inst.inputs[0]).op) else {
        unreachable!("the input of a layer is kept")
    };
    let outputs = inst.channels as u32;
    let own = block(outputs);
    let layer = Layer { network, weights: *weights, input: *input, outputs, own, first };
    layer.emit(e, region, linear, results);
}

/// Outputs of an invocation: as many as it takes, in fours where there are more than two.
fn block(outputs: u32) -> u32 {
    let own = outputs.div_ceil(BLOCKS);
    if own > 2 { own.next_multiple_of(4).min(outputs) } else { own }
}

struct Layer<'n> {
    network: &'n Network,
    weights: Weights,
    input: BufferId,
    outputs: u32,
    /// Of an invocation.
    own: u32,
    first: First,
}

impl Layer<'_> {
    fn emit(&self, e: &mut Emit, region: &Region, linear: InstId, results: &[InstId]) {
        let down = e.b.u(self.network.tile / 4);
        let (rows, block) = (e.b.rem(e.invocation, down), e.b.div(e.invocation, down));
        let (four, own) = (e.b.u(4), e.b.u(self.own));
        let (row, begin) = (e.b.mul(rows, four), e.b.mul(block, own));
        e.b.name(row, "own_row");
        e.b.name(begin, "block");
        // The last block begins earlier rather than end later.
        let last = e.b.u(self.outputs - self.own);
        let column = if self.outputs.is_multiple_of(self.own) { begin } else { e.b.math(Math::Min, &[begin, last]) };
        let busy = (self.own * (BLOCKS - 1) >= self.outputs).then_some(self.outputs);
        let zero = e.b.f(0.0);
        let zeros = e.b.splat(zero);
        let sums: Vec<Var> = (0..self.own).map(|_| e.b.var("sum", zeros)).collect();
        let kept: Vec<InstId> = results.iter().copied().filter(|r| self.network.kept(*r).is_some()).collect();
        // What is kept waits until all have read: the first result where its sum was.
        let mut waiting = vec![sums.clone()];
        for _ in 1..kept.len() {
            waiting.push((0..self.own).map(|_| e.b.var("waiting", zeros)).collect());
        }
        e.if_below(begin, busy, |e| {
            self.sum_up(e, row, column, &sums);
            let mut values = self.network.four(e, region, self.first, row);
            let mut written = vec![];
            for (j, sum) in sums.iter().enumerate() {
                let offset = e.b.u(j as u32);
                let column = e.b.add(column, offset);
                let channel = if self.outputs == 1 { Channel::At(0) } else { Channel::Var(column) };
                let sum = e.b.get(*sum);
                values.give(e, linear, channel, sum);
                let mut all = vec![];
                for id in results {
                    let value = values.channel(e, *id, channel);
                    all.push((*id, e.b.splat(value)));
                }
                for (id, value) in all {
                    written.extend(self.network.written(id).into_iter().map(|buffer| (buffer, column, value)));
                    if let Some(i) = kept.iter().position(|k| *k == id) {
                        e.b.set(waiting[i][j], value);
                    }
                }
            }
            self.network.set(e, &written, self.first, row);
        });
        e.b.barrier();
        e.if_below(begin, busy, |e| {
            let mut all = vec![];
            for (id, vars) in kept.iter().zip(&waiting) {
                for (j, var) in vars.iter().enumerate() {
                    let offset = e.b.u(j as u32);
                    let (column, value) = (e.b.add(column, offset), e.b.get(*var));
                    all.extend(self.network.kept(*id).map(|place| (place, column, value)));
                }
            }
            self.network.set(e, &all, self.first, row);
        });
    }

    /// Products of all terms with the weights of this invocation's outputs.
    fn sum_up(&self, e: &mut Emit, row: Value, column: Value, sums: &[Var]) {
        const STEP: u32 = 4;
        let w = self.weights;
        let terms = (if w.transposed { w.columns } else { w.rows }) as u32;
        let (none, whole) = (e.b.u(0), e.b.u(terms / STEP * STEP));
        if terms >= STEP {
            let k = e.b.open_loop("term", none, whole, STEP);
            self.stage(e, (row, column), k, STEP, sums);
            e.b.close_loop();
        }
        if !terms.is_multiple_of(STEP) {
            self.stage(e, (row, column), whole, terms % STEP, sums);
        }
    }

    /// Adds `count` terms from `k` on.
    fn stage(&self, e: &mut Emit, (row, column): (Value, Value), k: Value, count: u32, sums: &[Var]) {
        let mut inputs = vec![];
        for i in 0..count {
            let offset = e.b.u(i);
            let k = e.b.add(k, offset);
            e.b.topic("input");
            inputs.push(self.input(e, k, row));
        }
        let weights = self.weights(e, k, count, column);
        e.b.topic("sum");
        for (i, x) in inputs.into_iter().enumerate() {
            for (sum, weights) in sums.iter().zip(&weights) {
                let before = e.b.get(*sum);
                let after = e.b.fma(x, weights[i], before);
                e.b.set(*sum, after);
            }
        }
    }

    /// Channel `k` of four rows.
    fn input(&self, e: &mut Emit, k: Value, row: Value) -> Value {
        self.network.held_four(e, self.input, k, self.first, row)
    }

    /// Per output of this invocation, its weights of `count` terms from `k` on.
    fn weights(&self, e: &mut Emit, k: Value, count: u32, column: Value) -> Vec<Vec<Value>> {
        e.b.topic("weight");
        let w = self.weights;
        let (lines, along) = if w.transposed { (self.own, count) } else { (count, self.own) };
        let (line, start) = if w.transposed { (column, k) } else { (k, column) };
        let end = if w.transposed { along } else { self.outputs };
        let aligned = [w.first as u32, w.columns as u32, along, end].iter().all(|x| x.is_multiple_of(4));
        let fours = aligned && e.layout.shape(w.buffer).axes.elements() == 1;
        let (stride, before) = (e.b.u(w.columns as u32), e.b.u(w.first as u32));
        let mut found: Vec<Vec<Value>> = vec![];
        for i in 0..lines {
            let offset = e.b.u(i);
            let own = e.b.add(line, offset);
            let own = e.b.mul(own, stride);
            let own = e.b.add(own, before);
            let begin = e.b.add(own, start);
            let mut all = vec![];
            for j in (0..along).step_by(if fours { 4 } else { 1 }) {
                let offset = e.b.u(j);
                let channel = e.b.add(begin, offset);
                if fours {
                    let vector = e.load_four(w.buffer, channel);
                    all.extend((0..4).map(|c| e.b.component(vector, c)));
                } else {
                    let at = self.weight_at(e, channel);
                    all.push(e.load(w.buffer, at));
                }
            }
            found.push(all);
        }
        if w.transposed {
            return found;
        }
        (0..self.own as usize).map(|j| found.iter().map(|line| line[j]).collect()).collect()
    }

    /// Lane of a weight: of the network's element of the weights' axes.
    fn weight_at(&self, e: &mut Emit, channel: Value) -> Value {
        let axes = e.layout.shape(self.weights.buffer).axes.clone();
        let element = self.network.batch_element(e, self.first, &axes);
        e.index(self.weights.buffer, channel, element)
    }
}
