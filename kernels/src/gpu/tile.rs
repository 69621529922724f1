//! Tiled matrix products: a workgroup computes a tile of `C_mn = sum_k A_km B_kn`, staged through workgroup memory. The
//! next stage is on its way from memory while one is multiplied.
//!
//! In single precision an invocation accumulates a block of the tile in variables, four `m` to a vector; in half precision
//! a subgroup accumulates a block in cooperative matrices, which then pass through workgroup memory. Either way the sums
//! come out four `m` at a time. Channel-major buffers make this one kernel for layers and for weight gradients.

use super::builder::{Factor, Kind, MatrixAt, MatrixSum, Memory, Value, Var};
use super::layout::{Limits, Matrices};
use super::memory::Emit;
use naga::BuiltIn;

/// Workgroups that keep a device busy.
const ENOUGH: u64 = 128;
/// Invocations of a workgroup that every device can start.
const MOST_INVOCATIONS: u32 = 256;
/// Terms of sums after which writing them does not count.
const LONG: usize = 1024;

/// Sizes of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tile {
    /// Of the workgroup.
    pub m: u32,
    pub n: u32,
    /// Staged at a time.
    pub k: u32,
    /// Of an invocation, multiples of 4; or with matrices, of a subgroup, multiples of their side.
    pub own_m: u32,
    pub own_n: u32,
    pub matrices: Option<Matrices>,
}

impl Tile {
    /// A tile for products of `[m, k]` and `[k, n]`, so many of them: the largest that leaves enough workgroups.
    pub fn of(limits: &Limits, (m, n, k): (usize, usize, usize), products: usize) -> Tile {
        let fits = |t: &Tile| {
            let workgroups = m.div_ceil(t.m as usize) as u64 * n.div_ceil(t.n as usize) as u64 * products as u64;
            workgroups >= ENOUGH && t.bytes() <= limits.max_workgroup_bytes && t.invocations() <= MOST_INVOCATIONS
        };
        let skipped = limits.tiles as usize;
        if let Some(matrices) = limits.half.and_then(|h| h.matrices)
            && n > 32
            && k >= 16
        {
            // Blocks of a subgroup, in matrices.
            let side = matrices.side;
            let tile = |m, n, (own_m, own_n): (u32, u32)| {
                let (own_m, own_n) = (own_m * side, own_n * side);
                Tile { m, n, k: 32, own_m, own_n, matrices: Some(matrices) }
            };
            let all = match n {
                0..=64 => vec![tile(128, 64, (2, 2))],
                65..=128 => vec![tile(256, 128, (4, 4)), tile(64, 128, (2, 4))],
                // All columns at once: the other operand is then read once.
                _ => vec![tile(128, 256, (4, 4)), tile(64, 128, (2, 4))],
            };
            return all.into_iter().skip(skipped).find(fits).unwrap_or(tile(64, 64, (2, 2)));
        }
        let deep = match k {
            0..=4 => 4,
            5..=8 => 8,
            // A deeper tile of 256 rows would not fit into the 16 KiB that WebGPU guarantees.
            _ if n <= 4 => 8,
            _ => 16,
        };
        let tile = |m, n, k, own_m, own_n| Tile { m, n, k, own_m, own_n, matrices: None };
        match n {
            0..=4 => tile(256, 4, deep, 4, 4),
            5..=8 => tile(128, 8, deep, 4, 4),
            9..=16 => tile(128, 16, deep, 8, 4),
            17..=32 => tile(64, 32, deep, 8, 4),
            _ => {
                // Long sums write little.
                let largest = if k >= LONG { tile(128, 128, deep, 8, 8) } else { tile(128, 64, deep.min(8), 8, 8) };
                let all = [largest, tile(64, 64, deep, 8, 8)];
                all.into_iter().skip(skipped).find(fits).unwrap_or(tile(32, 32, deep, 4, 4))
            }
        }
    }

    /// Memory that a workgroup shares.
    fn bytes(&self) -> u32 {
        match self.matrices {
            None => self.k * (self.m / 4 + 1 + self.n / 4 + 1) * 16,
            Some(Matrices { side, subgroup }) => {
                let staged = (self.m + self.n) * (self.k / 4 + 2) * 8;
                staged + self.invocations() / subgroup * side * (self.strip(side) / 4 + 1) * 16
            }
        }
    }

    /// Rows of sums that a subgroup passes through workgroup memory at a time: of two matrices.
    fn strip(&self, side: u32) -> u32 {
        self.own_m.min(2 * side)
    }

    pub fn invocations(&self) -> u32 {
        (self.m / self.own_m) * (self.n / self.own_n) * self.matrices.map_or(1, |m| m.subgroup)
    }
}

/// Columns of a product of so many that are better computed by a kernel of their own: the few after the last whole tile.
pub(super) fn split(columns: usize) -> Vec<std::ops::Range<usize>> {
    const FEW: usize = 16;
    let rest = columns % 64;
    let few = columns > 64 && (1..=FEW).contains(&rest);
    let end = if few { columns - rest } else { columns };
    [0..end, end..columns].into_iter().filter(|r| !r.is_empty()).collect()
}

/// A direction through an operand.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Along {
    K,
    /// m of the first operand, n of the second.
    Edge,
}

/// Loads four neighbours along the operand's direction, given k and the position in the tile of the first. Neighbours lie
/// next to each other in memory.
pub(super) struct Operand<'a> {
    pub along: Along,
    pub load: &'a mut dyn FnMut(&mut Emit, Value, Value) -> Value,
}

/// Sums of four neighbouring m of one n: the positions in the tile of the first m and of n.
pub(super) struct Four {
    pub m: Value,
    pub n: Value,
    pub sums: Value,
}

/// Takes some of the sums. What they need from memory should be read before any of them is written: a device waits for
/// every read that follows a write.
pub(super) type UseSums<'a> = &'a mut dyn FnMut(&mut Emit, &[Four]);

/// Emits the product over `from..to` of k, and calls `use_sums` until all of the tile is given. Terms beyond `to` must come
/// as zeros from `a`.
pub(super) fn multiply(
    e: &mut Emit,
    tile: Tile,
    (from, to): (Value, Value),
    a: Operand,
    b: Operand,
    use_sums: UseSums,
) {
    let mut a = Staged::new(e, tile, "tile_a", tile.m, a);
    let mut b = Staged::new(e, tile, "tile_b", tile.n, b);
    let sums = Sums::new(e, tile);
    a.fetch(e, tile, from);
    b.fetch(e, tile, from);
    let k = e.b.open_loop("k", from, to, tile.k);
    // The last stage is multiplied.
    e.b.barrier();
    a.put(e, tile);
    b.put(e, tile);
    e.b.barrier();
    let depth = e.b.u(tile.k);
    let next = e.b.add(k, depth);
    let more = e.b.less(next, to);
    e.b.open_if(more);
    a.fetch(e, tile, next);
    b.fetch(e, tile, next);
    e.b.close_if();
    sums.accumulate(e, tile, &a, &b);
    e.b.close_loop();
    sums.give(e, tile, use_sums);
}

/// An operand's way through workgroup memory.
struct Staged<'a> {
    operand: Operand<'a>,
    memory: Memory,
    edge: u32,
    /// Vectors of a line of the memory, padding included. A line runs along the edge, except where matrices may lie as
    /// their operand does.
    line: u32,
    /// What this invocation has fetched.
    fetched: Vec<Var>,
}

impl<'a> Staged<'a> {
    fn new(e: &mut Emit, tile: Tile, name: &str, edge: u32, operand: Operand<'a>) -> Staged<'a> {
        let half = tile.matrices.is_some();
        // Padding keeps the lines of a tile in different banks.
        let (lines, line) = match operand.along {
            Along::K if half => (edge, tile.k / 4 + 2),
            _ => (tile.k, edge / 4 + if half { 2 } else { 1 }),
        };
        let kind = if half { Kind::F16 } else { Kind::F32 };
        let memory = e.b.workgroup(name, kind, true, lines * line);
        let zero = e.b.f(0.0);
        let mut zeros = e.b.splat(zero);
        if half {
            zeros = e.b.half(zeros);
        }
        let count = (tile.k * edge / 4).div_ceil(tile.invocations());
        let fetched = (0..count).map(|i| e.b.var(&format!("{name}_next_n{i}_"), zeros)).collect();
        Staged { operand, memory, edge, line, fetched }
    }

    /// Does something for each of the vectors that this invocation fetches: `act` is given k and the position in the tile.
    fn each(&mut self, e: &mut Emit, tile: Tile, mut act: impl FnMut(&mut Self, &mut Emit, usize, Value, Value)) {
        let (vectors, invocations) = (tile.k * self.edge / 4, tile.invocations());
        for i in 0..self.fetched.len() {
            let done = i as u32 * invocations;
            let offset = e.b.u(done);
            let number = e.b.add(e.invocation, offset);
            let partly = vectors - done < invocations;
            if partly {
                let all = e.b.u(vectors);
                let inside = e.b.less(number, all);
                e.b.open_if(inside);
            }
            let four = e.b.u(4);
            let (k, at) = match self.operand.along {
                Along::K => {
                    let deep = e.b.u(tile.k / 4);
                    let k = e.b.rem(number, deep);
                    (e.b.mul(k, four), e.b.div(number, deep))
                }
                Along::Edge => {
                    let wide = e.b.u(self.edge / 4);
                    let at = e.b.rem(number, wide);
                    (e.b.div(number, wide), e.b.mul(at, four))
                }
            };
            act(self, e, i, k, at);
            if partly {
                e.b.close_if();
            }
        }
    }

    /// From memory.
    fn fetch(&mut self, e: &mut Emit, tile: Tile, first: Value) {
        self.each(e, tile, |own, e, i, k, at| {
            let k = e.b.add(first, k);
            let value = (own.operand.load)(e, k, at);
            let value = e.b.splat(value);
            let value = if tile.matrices.is_some() { e.b.half(value) } else { value };
            e.b.set(own.fetched[i], value);
        });
    }

    /// Into workgroup memory.
    fn put(&mut self, e: &mut Emit, tile: Tile) {
        self.each(e, tile, |own, e, i, k, at| {
            let value = e.b.get(own.fetched[i]);
            let (line, four) = (e.b.u(own.line), e.b.u(4));
            match own.operand.along {
                Along::Edge => {
                    let (to, column) = (e.b.mul(k, line), e.b.div(at, four));
                    let to = e.b.add(to, column);
                    e.b.store(own.memory, to, value);
                }
                Along::K if tile.matrices.is_some() => {
                    let (to, column) = (e.b.mul(at, line), e.b.div(k, four));
                    let to = e.b.add(to, column);
                    e.b.store(own.memory, to, value);
                }
                Along::K => {
                    let lanes = e.b.u(own.line * 4);
                    for j in 0..4 {
                        let (offset, lane) = (e.b.u(j), e.b.component(value, j));
                        let k = e.b.add(k, offset);
                        let to = e.b.mul(k, lanes);
                        let to = e.b.add(to, at);
                        e.b.store_lane(own.memory, to, lane);
                    }
                }
            }
        });
    }

    /// The vector number `own + i * stride` of line `k`.
    fn vector(&self, e: &mut Emit, k: Value, own: Value, offset: u32) -> Value {
        let (line, offset) = (e.b.u(self.line), e.b.u(offset));
        let first = e.b.mul(k, line);
        let first = e.b.add(first, own);
        let at = e.b.add(first, offset);
        e.b.load(self.memory, at)
    }

    /// Where the matrix at `(k, edge)` lies.
    fn matrix(&self, e: &mut Emit, factor: Factor, k: Value, edge: Value) -> MatrixAt {
        let lines_along_k = self.operand.along == Along::K;
        let (line, along) = if lines_along_k { (edge, k) } else { (k, edge) };
        let (length, four) = (e.b.u(self.line), e.b.u(4));
        let first = e.b.mul(line, length);
        let along = e.b.div(along, four);
        let first = e.b.add(first, along);
        // Rows of the left factor are its edge, rows of the right one are k.
        let row_major = (factor == Factor::Left) == lines_along_k;
        MatrixAt { memory: self.memory, first, line: self.line, row_major }
    }
}

/// What is accumulated.
enum Sums {
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
    fn new(e: &mut Emit, tile: Tile) -> Sums {
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
    fn accumulate(&self, e: &mut Emit, tile: Tile, a: &Staged, b: &Staged) {
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
    fn give(&self, e: &mut Emit, tile: Tile, use_sums: UseSums) {
        match self {
            Sums::Block { sums, column, row } => {
                let across = tile.m / tile.own_m;
                let down = tile.n / tile.own_n;
                for i in 0..tile.own_m / 4 {
                    let m = place(e, *column, i * across, 0);
                    let mut found = vec![];
                    for j in 0..tile.own_n {
                        let n = place(e, *row, j / 4 * down, j % 4);
                        found.push(Four { m, n, sums: e.b.get(sums[j as usize][i as usize]) });
                    }
                    use_sums(e, &found);
                }
            }
            Sums::Matrices { sums, first_m, first_n, subgroup, sizes } => {
                // A few matrices after the other, in memory of each subgroup's own.
                let side = sizes.side;
                let strip = tile.strip(side);
                let line = strip / 4 + 1;
                let own = side * line;
                let subgroups = tile.invocations() / sizes.subgroup;
                let memory = e.b.workgroup("block", Kind::F32, true, subgroups * own);
                let own = e.b.u(own);
                let own_first = e.b.mul(*subgroup, own);
                let count = e.b.u(sizes.subgroup);
                let lane = e.b.rem(e.invocation, count);
                for (j, sums) in sums.iter().enumerate() {
                    for (i, sums) in sums.chunks((strip / side) as usize).enumerate() {
                        e.b.barrier();
                        for (i, sum) in sums.iter().enumerate() {
                            let offset = e.b.u(i as u32 * side / 4);
                            let first = e.b.add(own_first, offset);
                            e.b.matrix_store(*sum, MatrixAt { memory, first, line, row_major: false });
                        }
                        e.b.barrier();
                        let mut found = vec![];
                        for done in (0..strip / 4 * side).step_by(sizes.subgroup as usize) {
                            let offset = e.b.u(done);
                            let number = e.b.add(lane, offset);
                            let (down, four) = (e.b.u(strip / 4), e.b.u(4));
                            let (vector, column) = (e.b.rem(number, down), e.b.div(number, down));
                            let (own_m, before_m) = (e.b.mul(vector, four), e.b.u(i as u32 * strip));
                            let m = e.b.add(*first_m, before_m);
                            let m = e.b.add(m, own_m);
                            let before_n = e.b.u(j as u32 * side);
                            let n = e.b.add(*first_n, before_n);
                            let n = e.b.add(n, column);
                            let line = e.b.u(line);
                            let at = e.b.mul(column, line);
                            let at = e.b.add(at, vector);
                            let at = e.b.add(at, own_first);
                            found.push(Four { m, n, sums: e.b.load(memory, at) });
                        }
                        use_sums(e, &found);
                    }
                }
            }
        }
    }
}

/// `4 (before + own) + extra`
fn place(e: &mut Emit, own: Value, before: u32, extra: u32) -> Value {
    let (before, four, extra) = (e.b.u(before), e.b.u(4), e.b.u(extra));
    let at = e.b.add(own, before);
    let at = e.b.mul(at, four);
    e.b.add(at, extra)
}
