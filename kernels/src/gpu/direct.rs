//! Matrix products on drivers in software, where the invocations of a subgroup are lanes of a CPU's vectors. A value that is
//! the same for all is read once; one that differs is read lane by lane, ten times as dearly. So an invocation has rows of its own,
//! read where they lie, and all columns of the tile, whose factors pass through workgroup memory.

use super::builder::{Kind, Memory, Value};
use super::give::{Epilogue, Place, place, through_columns};
use super::memory::Emit;
use super::product::{Along, Operand, Staged, plus};
use super::reduce::{combine, neutral};
use super::tile::Tile;
use naga::{BuiltIn, MathFunction};
use raygrad_compiler::ops::Reduction;

/// Terms that are added to a sum between reading and writing it: those that operands give as a vector.
pub(super) const STEP: u32 = 4;

/// The product as of [`super::product::multiply`].
pub(super) fn multiply(
    e: &mut Emit,
    tile: Tile,
    (from, to): (Value, Value),
    mut a: Operand,
    b: Operand,
    epilogue: &mut dyn Epilogue,
) {
    // One, which compilers do not know: loops that count to known numbers they unroll, and take seconds for it.
    let workgroups = e.b.built_in("workgroups", BuiltIn::NumWorkGroups);
    let (workgroups, one) = (e.b.component(workgroups, 0), e.b.u(1));
    let one = e.b.math(MathFunction::Min, &[workgroups, one]);
    let mut b = Staged::new(e, tile, "tile_b", (tile.n, 1), b);
    let vectors = tile.own_m / 4;
    let sums = e.b.private("sum", Kind::F32, true, tile.n * vectors);
    let zero = e.b.f(0.0);
    let zeros = e.b.splat(zero);
    fill(e, sums, tile.n * vectors, zeros);
    let stage = e.b.open_loop("k", from, to, tile.k);
    e.b.barrier();
    b.pass(e, tile, stage, one);
    e.b.barrier();
    let (none, depth, left) = (e.b.u(0), e.b.u(tile.k), e.b.sub(to, stage));
    let depth = e.b.math(MathFunction::Min, &[depth, left]);
    let own_k = e.b.open_loop("own_k", none, depth, STEP);
    let k = e.b.add(stage, own_k);
    e.b.topic("a");
    let left: Vec<Vec<Value>> = (0..vectors).map(|i| four_terms(e, tile, &mut a, k, i)).collect();
    for n in (0..tile.n).step_by(4) {
        e.b.topic("b");
        let mut right = vec![];
        for i in 0..STEP {
            let k = plus(e, own_k, i);
            right.push(b.vector(e, k, none, n / 4));
        }
        e.b.topic("sum");
        for j in 0..4 {
            for (i, left) in left.iter().enumerate() {
                let at = e.b.u((n + j) * vectors + i as u32);
                let mut total = e.b.load(sums, at);
                for (left, right) in left.iter().zip(&right) {
                    let factor = e.b.component(*right, j);
                    total = e.b.fma(*left, factor, total);
                }
                e.b.store(sums, at, total);
            }
        }
    }
    e.b.close_loop();
    e.b.close_loop();
    give(e, tile, sums, one, epilogue);
}

/// Vector number `i` of the invocation's m, for each of four terms from `k` on.
fn four_terms(e: &mut Emit, tile: Tile, a: &mut Operand, k: Value, i: u32) -> Vec<Value> {
    let m = place(e, e.invocation, i * (tile.m / tile.own_m), 0);
    let mut read = vec![];
    for j in 0..STEP {
        let (k, m) = if a.along == Along::K { (k, plus(e, m, j)) } else { (plus(e, k, j), m) };
        let value = (a.load)(e, k, m);
        read.push(e.b.splat(value));
    }
    if a.along == Along::Edge {
        return read;
    }
    let term = |j: u32| {
        let lanes = [0, 1, 2, 3].map(|m: usize| e.b.component(read[m], j));
        e.b.vector(lanes)
    };
    (0..STEP).map(term).collect()
}

/// Hands out the sums, four columns at a time in a loop.
fn give(e: &mut Emit, tile: Tile, sums: Memory, one: Value, epilogue: &mut dyn Epilogue) {
    let vectors = tile.own_m / 4;
    let kinds = epilogue.kinds();
    let totals: Vec<(Reduction, Memory)> = kinds
        .iter()
        .map(|kind| {
            let memory = e.b.private("total", Kind::F32, false, tile.n);
            let first = neutral(&mut e.b, *kind);
            fill(e, memory, tile.n, first);
            (*kind, memory)
        })
        .collect();
    let (none, all) = (e.b.u(0), e.b.u(tile.n));
    let all = e.b.mul(one, all);
    for i in 0..vectors {
        let m = place(e, e.invocation, i * (tile.m / tile.own_m), 0);
        let first = e.b.open_loop("own_n", none, all, 4);
        let (mut places, mut found) = (vec![], vec![]);
        for j in 0..4 {
            let n = plus(e, first, j);
            let every = e.b.u(vectors);
            let at = e.b.mul(n, every);
            let at = plus(e, at, i);
            places.push(Place { m, n });
            found.push(e.b.load(sums, at));
        }
        epilogue.ahead(e, &places);
        let values = epilogue.sums(e, &places, &found);
        for ((kind, memory), values) in totals.iter().zip(&values) {
            for (place, value) in places.iter().zip(values) {
                let before = e.b.load(*memory, place.n);
                let after = combine(&mut e.b, *kind, before, *value);
                e.b.store(*memory, place.n, after);
            }
        }
        e.b.close_loop();
    }
    let own_n: Vec<Value> = (0..tile.n).map(|n| e.b.u(n)).collect();
    through_columns(e, tile, &own_n, e.invocation, epilogue, &mut |e, which, j| e.b.load(totals[which].1, own_n[j]));
}

fn fill(e: &mut Emit, memory: Memory, count: u32, value: Value) {
    for i in 0..count {
        let at = e.b.u(i);
        e.b.store(memory, at, value);
    }
}
