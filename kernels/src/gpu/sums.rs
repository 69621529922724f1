//! What a tile of a matrix product accumulates: blocks in variables, or cooperative matrices.

use super::builder::{Factor, MatrixSum, Value, Var};
use super::give::{Epilogue, Strips, give_blocks};
use super::half::Matrices;
use super::memory::Emit;
use super::product::Staged;
use super::tile::Tile;
use naga::BuiltIn;

/// What is accumulated.
pub(super) enum Sums {
    Block {
        /// By n, then by vectors of m.
        sums: Vec<Vec<Var>>,
        column: Value,
        row: Value,
    },
    Matrices {
        /// By n, then by m.
        sums: Vec<Vec<MatrixSum>>,
        /// Where the subgroup's block begins in the tile.
        first_m: Value,
        first_n: Value,
        subgroup: Value,
        sizes: Matrices,
    },
}

impl Sums {
    pub fn new(e: &mut Emit, tile: Tile) -> Sums {
        let across = e.b.u(tile.m / tile.own_m);
        let Some(sizes) = tile.matrices else {
            let (column, row) = (e.b.rem(e.invocation, across), e.b.div(e.invocation, across));
            e.b.name(column, "block_m");
            e.b.name(row, "block_n");
            let zero = e.b.f(0.0);
            let zeros = e.b.splat(zero);
            let mut sums = vec![];
            for j in 0..tile.own_n {
                let name = format!("sum_n{j}_m");
                sums.push((0..tile.own_m / 4).map(|_| e.b.var(&name, zeros)).collect::<Vec<_>>());
            }
            return Sums::Block { sums, column, row };
        };
        let subgroup = e.b.built_in("subgroup", BuiltIn::SubgroupId);
        let (own_m, own_n) = (e.b.u(tile.own_m), e.b.u(tile.own_n));
        let (m, n) = (e.b.rem(subgroup, across), e.b.div(subgroup, across));
        let (first_m, first_n) = (e.b.mul(m, own_m), e.b.mul(n, own_n));
        e.b.name(first_m, "subgroup_m");
        e.b.name(first_n, "subgroup_n");
        let mut sums = vec![];
        for j in 0..tile.own_n / sizes.side {
            let name = format!("sum_n{j}_m");
            sums.push((0..tile.own_m / sizes.side).map(|_| e.b.matrix_sum(&name, sizes.side)).collect::<Vec<_>>());
        }
        Sums::Matrices { sums, first_m, first_n, subgroup, sizes }
    }

    /// Adds the product of a stage.
    pub fn accumulate(&self, e: &mut Emit, tile: Tile, a: &Staged, b: &Staged) {
        match self {
            Sums::Block { sums, column, row } => {
                let (none, depth) = (e.b.u(0), e.b.u(tile.k));
                let own_k = e.b.open_loop("own_k", none, depth, 4);
                for i in 0..4 {
                    let offset = e.b.u(i);
                    let k = e.b.add(own_k, offset);
                    e.b.topic("a");
                    let across = tile.m / tile.own_m;
                    let a: Vec<Value> = (0..tile.own_m / 4).map(|i| a.vector(e, k, *column, i * across)).collect();
                    e.b.topic("b");
                    let down = tile.n / tile.own_n;
                    let b: Vec<Value> = (0..tile.own_n / 4).map(|i| b.vector(e, k, *row, i * down)).collect();
                    e.b.topic("sum");
                    for (j, sums) in sums.iter().enumerate() {
                        let factor = e.b.component(b[j / 4], j as u32 % 4);
                        for (i, sum) in sums.iter().enumerate() {
                            let before = e.b.get(*sum);
                            let after = e.b.fma(a[i], factor, before);
                            e.b.set(*sum, after);
                        }
                    }
                }
                e.b.close_loop();
            }
            Sums::Matrices { sums, first_m, first_n, sizes, .. } => {
                // Small matrices are a loop: software drivers write out each product.
                let side = sizes.side;
                let steps = if side < 16 { 1 } else { tile.k / side };
                let (none, depth) = (e.b.u(0), e.b.u(tile.k));
                let own_k = e.b.open_loop("own_k", none, depth, steps * side);
                for step in 0..steps {
                    let offset = e.b.u(step * side);
                    let k = e.b.add(own_k, offset);
                    let at = |e: &mut Emit, first: Value, i: usize| {
                        let offset = e.b.u(i as u32 * side);
                        e.b.add(first, offset)
                    };
                    let mut left = vec![];
                    for i in 0..sums[0].len() {
                        let m = at(e, *first_m, i);
                        let place = a.matrix(e, Factor::Left, k, m);
                        left.push(e.b.matrix(Factor::Left, side, place));
                    }
                    for (j, sums) in sums.iter().enumerate() {
                        let n = at(e, *first_n, j);
                        let place = b.matrix(e, Factor::Right, k, n);
                        let right = e.b.matrix(Factor::Right, side, place);
                        for (left, sum) in left.iter().zip(sums) {
                            e.b.matrix_multiply_add(*left, right, *sum);
                        }
                    }
                }
                e.b.close_loop();
            }
        }
    }

    /// Hands the sums out.
    pub fn give(&self, e: &mut Emit, tile: Tile, epilogue: &mut dyn Epilogue) {
        match self {
            Sums::Block { sums, column, row } => give_blocks(e, tile, sums, (*column, *row), epilogue),
            Sums::Matrices { sums, first_m, first_n, subgroup, sizes } => {
                let strips = Strips::new(e, tile, *sizes, *subgroup);
                strips.give(e, tile, sums, (*first_m, *first_n), epilogue);
            }
        }
    }
}
