//! Tiled matrix products: a workgroup computes a tile of `C_mn = sum_k A_km B_kn`, staged through workgroup memory; an
//! invocation accumulates a block of it in variables, four `m` to a vector.
//!
//! Channel-major buffers make this one kernel for layers (m: rows, contiguous) and for weight gradients (k: rows).

use super::builder::{Kind, Memory, Value, Var};
use super::memory::Emit;

/// Sizes of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tile {
    /// Of the workgroup.
    pub m: u32,
    pub n: u32,
    /// Staged at a time.
    pub k: u32,
    /// Of an invocation; multiples of 4.
    pub own_m: u32,
    pub own_n: u32,
}

impl Tile {
    /// A tile for a product of `n` columns and `k` terms: 64 invocations, fewer columns for narrow products.
    pub fn of(n: usize, k: usize) -> Tile {
        let deep = match k {
            0..=4 => 4,
            5..=8 => 8,
            // A deeper tile of 256 rows would not fit into the 16 KiB that WebGPU guarantees.
            _ if n <= 4 => 8,
            _ => 16,
        };
        let (m, n, own_m, own_n) = match n {
            0..=4 => (256, 4, 4, 4),
            5..=8 => (128, 8, 4, 4),
            9..=16 => (128, 16, 8, 4),
            17..=32 => (64, 32, 8, 4),
            _ => (64, 64, 8, 8),
        };
        Tile { m, n, k: deep, own_m, own_n }
    }

    pub fn invocations(&self) -> u32 {
        (self.m / self.own_m) * (self.n / self.own_n)
    }
}

/// Which direction neighbouring invocations load along, so that they read neighbouring addresses.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Along {
    K,
    Edge,
}

/// An invocation's block of the product.
pub(super) struct Block {
    tile: Tile,
    sums: Vec<Vec<Var>>,
    column: Value,
    row: Value,
}

impl Block {
    /// Position in the tile of the first of four neighbouring `m`.
    pub fn m(&self, e: &mut Emit, i: u32) -> Value {
        let across = self.tile.m / self.tile.own_m;
        place(e, self.column, i, across, 0)
    }

    /// Position of the n numbered `j`.
    pub fn n(&self, e: &mut Emit, j: u32) -> Value {
        let down = self.tile.n / self.tile.own_n;
        place(e, self.row, j / 4, down, j % 4)
    }

    /// Sums for vector `i` of m and number `j` of n.
    pub fn sum(&self, e: &mut Emit, i: u32, j: u32) -> Value {
        e.b.get(self.sums[j as usize][i as usize])
    }
}

/// `4 (i * across + own) + extra`
fn place(e: &mut Emit, own: Value, i: u32, across: u32, extra: u32) -> Value {
    let (before, four, extra) = (e.b.u(i * across), e.b.u(4), e.b.u(extra));
    let at = e.b.add(own, before);
    let at = e.b.mul(at, four);
    e.b.add(at, extra)
}

/// Loads four neighbours, given k and the position in the tile of the first.
pub(super) type LoadFour<'a> = &'a mut dyn FnMut(&mut Emit, Value, Value) -> Value;

/// Emits the product over `from..to` of k. `a` and `b` load four neighbours: given k and the position in the tile of the
/// first. Terms beyond `to` must come as zeros from `a`.
pub(super) fn multiply(
    e: &mut Emit,
    tile: Tile,
    (from, to): (Value, Value),
    (a, a_along): (LoadFour, Along),
    (b, b_along): (LoadFour, Along),
) -> Block {
    // A line of padding keeps the columns of a tile in different banks.
    let (a_line, b_line) = (tile.m / 4 + 1, tile.n / 4 + 1);
    let a_tile = e.b.workgroup("tile_a", Kind::F32, true, tile.k * a_line);
    let b_tile = e.b.workgroup("tile_b", Kind::F32, true, tile.k * b_line);
    let across = e.b.u(tile.m / tile.own_m);
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
    let block = Block { tile, sums, column, row };

    let k = e.b.open_loop("k", from, to, tile.k);
    stage(e, tile, a_tile, (tile.m, a_line), a_along, k, a);
    stage(e, tile, b_tile, (tile.n, b_line), b_along, k, b);
    e.b.barrier();
    let (none, depth) = (e.b.u(0), e.b.u(tile.k));
    let own_k = e.b.open_loop("own_k", none, depth, 4);
    for i in 0..4 {
        let offset = e.b.u(i);
        let at_k = e.b.add(own_k, offset);
        accumulate(e, &block, (a_tile, a_line), (b_tile, b_line), at_k);
    }
    e.b.close_loop();
    e.b.barrier();
    e.b.close_loop();
    block
}

/// Loads a tile of `k` by `edge` into workgroup memory, four neighbours along the edge at a time.
fn stage(
    e: &mut Emit,
    tile: Tile,
    memory: Memory,
    (edge, line): (u32, u32),
    along: Along,
    first: Value,
    load: &mut dyn FnMut(&mut Emit, Value, Value) -> Value,
) {
    let vectors = tile.k * edge / 4;
    let invocations = tile.invocations();
    let mut done = 0;
    while done < vectors {
        let offset = e.b.u(done);
        let number = e.b.add(e.invocation, offset);
        let partly = vectors - done < invocations;
        if partly {
            let all = e.b.u(vectors);
            let inside = e.b.less(number, all);
            e.b.open_if(inside);
        }
        let (k, at) = match along {
            Along::K => {
                let deep = e.b.u(tile.k);
                (e.b.rem(number, deep), e.b.div(number, deep))
            }
            Along::Edge => {
                let wide = e.b.u(edge / 4);
                (e.b.div(number, wide), e.b.rem(number, wide))
            }
        };
        let (four, line) = (e.b.u(4), e.b.u(line));
        let edge_at = e.b.mul(at, four);
        let global_k = e.b.add(first, k);
        let value = load(e, global_k, edge_at);
        let value = e.b.splat(value);
        let to = e.b.mul(k, line);
        let to = e.b.add(to, at);
        e.b.store(memory, to, value);
        if partly {
            e.b.close_if();
        }
        done += invocations;
    }
}

fn accumulate(e: &mut Emit, block: &Block, (a, a_line): (Memory, u32), (b, b_line): (Memory, u32), k: Value) {
    let tile = block.tile;
    let vectors = |e: &mut Emit, memory: Memory, line: u32, own: Value, count: u32, stride: u32| -> Vec<Value> {
        let line = e.b.u(line);
        let first = e.b.mul(k, line);
        let first = e.b.add(first, own);
        let at = |e: &mut Emit, i: u32| {
            let offset = e.b.u(i * stride);
            let at = e.b.add(first, offset);
            e.b.load(memory, at)
        };
        (0..count).map(|i| at(e, i)).collect()
    };
    e.b.topic("a");
    let a = vectors(e, a, a_line, block.column, tile.own_m / 4, tile.m / tile.own_m);
    e.b.topic("b");
    let b = vectors(e, b, b_line, block.row, tile.own_n / 4, tile.n / tile.own_n);
    e.b.topic("sum");
    for (j, sums) in block.sums.iter().enumerate() {
        let factor = e.b.component(b[j / 4], j as u32 % 4);
        for (i, sum) in sums.iter().enumerate() {
            let before = e.b.get(*sum);
            let after = e.b.fma(a[i], factor, before);
            e.b.set(*sum, after);
        }
    }
}
