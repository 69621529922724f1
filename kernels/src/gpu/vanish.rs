//! What a line's later elements no longer change.
//!
//! A ray ends where it lets no light through: its graph counts the elements at which a condition held, and the weights of those
//! behind are zero where the count is not. A count only grows, so that a workgroup that follows a line can leave it there. This
//! is found in the graph, not declared: a count is a cumulative sum of truth values, and each sum over the line must come out
//! zero wherever the count is positive. (Where what is skipped is infinite or not a number, zero times it would have told.)

use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::{Prim, ScalarProgram, Val};

/// What is known of a lane where the count is positive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    Zero,
    /// The integer 1: true.
    True,
    /// A float above 0.
    Positive,
    Any,
}

/// A count behind whose first element nothing adds to any sum over the line. Of a region that writes along the line, none.
pub(super) fn vanishing(region: &Region) -> Option<InstId> {
    let sums: Option<Vec<InstId>> = region.stores.iter().map(summed).collect();
    let sums = sums.filter(|s| !s.is_empty())?;
    region.ids().find(|id| {
        let inst = region.inst(*id);
        matches!(inst.op, RegionOp::CumSum { reverse: false })
            && inst.channels == 1
            && is_truth(region, inst.inputs[0])
            && {
                let known = where_counted(region, *id);
                sums.iter().all(|s| known[s.0 as usize] == Known::Zero)
            }
    })
}

fn summed(store: &Store) -> Option<InstId> {
    match store {
        Store::Reduce { kind: Reduction::Sum, value, .. } => Some(*value),
        _ => None,
    }
}

/// Whether a value is a truth value as a float: 0 or 1.
fn is_truth(region: &Region, id: InstId) -> bool {
    let RegionOp::Map(program) = &region.inst(id).op else { return false };
    let truth = |v: &Val| match v {
        Val::Inst(i) => matches!(program.code[*i as usize].0, Prim::Lt | Prim::Le | Prim::Eq | Prim::ULt | Prim::UEq),
        _ => false,
    };
    matches!(program.code.last(), Some((Prim::ToF32, args)) if args.iter().all(truth))
}

/// What is known of every value where `count` is positive.
fn where_counted(region: &Region, count: InstId) -> Vec<Known> {
    let mut known: Vec<Known> = vec![];
    for id in region.ids() {
        let inst = region.inst(id);
        let operands: Vec<Known> = inst.inputs.iter().map(|i| known[i.0 as usize]).collect();
        known.push(match &inst.op {
            _ if id == count => Known::Positive,
            RegionOp::Const(bits) => bits.iter().map(|b| of_bits(*b)).reduce(both).unwrap_or(Known::Any),
            RegionOp::Map(program) => of_program(program, &operands),
            RegionOp::Pick(pick) => pick.iter().map(|p| operands[p.0 as usize]).reduce(both).unwrap_or(Known::Any),
            RegionOp::ChannelSum(_) if operands[0] == Known::Zero => Known::Zero,
            _ => Known::Any,
        });
    }
    known
}

fn both(a: Known, b: Known) -> Known {
    if a == b { a } else { Known::Any }
}

fn of_bits(bits: u32) -> Known {
    match bits {
        0 => Known::Zero,
        1 => Known::True,
        _ if f32::from_bits(bits) > 0.0 => Known::Positive,
        _ => Known::Any,
    }
}

/// Of the result of a scalar program.
fn of_program(program: &ScalarProgram, operands: &[Known]) -> Known {
    let mut known: Vec<Known> = vec![];
    for (prim, args) in &program.code {
        let args: Vec<Known> = args
            .iter()
            .map(|v| match v {
                Val::Input(i) => operands[*i as usize],
                Val::Const(bits) => of_bits(*bits),
                Val::Inst(i) => known[*i as usize],
            })
            .collect();
        known.push(of_prim(*prim, &args));
    }
    known.last().copied().unwrap_or(Known::Any)
}

fn of_prim(prim: Prim, args: &[Known]) -> Known {
    use Known::{Any, Positive, True, Zero};
    match (prim, args) {
        (Prim::Lt, [Zero, Positive]) => True,
        (Prim::Lt | Prim::Le, [Positive, Zero]) | (Prim::Eq, [Positive, Zero] | [Zero, Positive]) => Zero,
        (Prim::Le, [Zero, Positive]) => True,
        (Prim::UEq, [Zero, Zero]) => True,
        (Prim::UEq, [True, Zero] | [Zero, True]) => Zero,
        (Prim::UXor, [True, True]) => Zero,
        (Prim::UXor, [Zero, True] | [True, Zero]) => True,
        (Prim::Select, [True, taken, _]) | (Prim::Select, [Zero, _, taken]) => *taken,
        (Prim::Select, [_, a, b]) => both(*a, *b),
        (Prim::Mul, [Zero, _] | [_, Zero]) => Zero,
        (Prim::Add | Prim::Sub | Prim::Min | Prim::Max, [Zero, Zero]) | (Prim::Neg | Prim::Abs, [Zero]) => Zero,
        _ => Any,
    }
}
