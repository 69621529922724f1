//! Simplification: the same values from a smaller graph.
//!
//! The graph is rebuilt bottom-up; every rebuilt node meets the local rules of [`rules`] (algebra, broadcasts, channel
//! picks) and [`split`] (linear layers over operands with fewer axes) and is then shared with equal nodes. Passes
//! repeat until nothing changes. What no root needs is never rebuilt.

mod rules;
mod split;

use crate::graph::{Axes, Tensor, topological, with_source};
use crate::ops::Form;
use crate::ops::constant::Constant;
use crate::step::Step;
use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::sync::Arc;

/// Passes are repeated at most this often; each one strictly shrinks or moves work outwards, so few are needed.
const MAX_PASSES: usize = 8;

/// Simplifies all roots of a step together.
pub fn simplify(step: &Step) -> Step {
    let mut step = step.clone();
    for _ in 0..MAX_PASSES {
        let mut pass = Pass::default();
        pass.rebuild(step.roots());
        let next = Step {
            outputs: step.outputs.iter().map(|(n, t)| (n.clone(), pass.rebuilt(t))).collect(),
            updates: step.updates.iter().map(|(i, t)| (i.clone(), pass.rebuilt(t))).collect(),
        };
        step = next;
        if !pass.changed {
            break;
        }
    }
    step
}

/// One bottom-up rebuild.
#[derive(Default)]
struct Pass {
    done: HashMap<u64, Tensor>,
    /// Type, name and key of the op, operands and axes of every rebuilt node: common subexpressions. Keys tell ops of one name
    /// apart, and two axes may share a name.
    known: HashMap<(TypeId, &'static str, String, Vec<u64>, Axes), Tensor>,
    changed: bool,
}

impl Pass {
    fn rebuild(&mut self, roots: Vec<Tensor>) {
        for t in topological(roots) {
            let rebuilt = t.with_inputs(t.inputs().iter().map(|i| self.done[&i.id()].clone()).collect());
            let simpler = with_source(t.source(), || rules::rewrite(&rebuilt).or_else(|| split::rewrite(&rebuilt)));
            let result = match simpler {
                Some(s) => {
                    self.changed = true;
                    self.share(s)
                }
                None => self.share(rebuilt),
            };
            self.done.insert(t.id(), result);
        }
    }

    fn rebuilt(&self, root: &Tensor) -> Tensor {
        self.done[&root.id()].clone()
    }

    fn share(&mut self, t: Tensor) -> Tensor {
        let (op, operands) = (&**t.op(), t.inputs().iter().map(Tensor::id).collect());
        let key = (Any::type_id(op), op.name(), op.key(), operands, t.axes().clone());
        match self.known.get(&key) {
            Some(known) => {
                self.changed |= known.id() != t.id();
                known.clone()
            }
            None => {
                self.known.insert(key, t.clone());
                t
            }
        }
    }
}

/// Evaluates ops on constants.
fn fold(t: &Tensor) -> Option<Tensor> {
    const LIMIT: usize = 4096;
    let foldable = !t.inputs().is_empty()
        && t.width() <= LIMIT
        && t.axes().is_empty()
        && matches!(t.op().form(), Form::Pointwise(_) | Form::Pick(_) | Form::ChannelSum(_) | Form::Identity)
        && t.inputs().iter().all(|i| i.op_as::<Constant>().is_some());
    if !foldable {
        return None;
    }
    let inputs: Vec<_> = t.inputs().iter().map(|i| i.op().eval(&[], i.shape())).collect();
    let value = t.op().eval(&inputs.iter().collect::<Vec<_>>(), t.shape());
    let op = match value.data {
        crate::reference::Data::F(v) if v.iter().all(|x| x.is_finite()) => Constant::F(v, t.channels()),
        crate::reference::Data::U(v) => Constant::U(v),
        crate::reference::Data::F(_) => return None,
    };
    Some(Tensor::record_arc(Arc::new(op), vec![]))
}

/// Whether `op` is the pointwise op `P`.
fn is_map<P: crate::ops::Pointwise>(t: &Tensor) -> bool {
    t.op_as::<crate::ops::pointwise::Map<P>>().is_some()
}
