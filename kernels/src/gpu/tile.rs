//! Tiled matrix products: a workgroup computes a tile of `C_mn = sum_k A_km B_kn`, staged through workgroup memory. The
//! next stage is on its way from memory while one is multiplied.
//!
//! In single precision an invocation accumulates a block of the tile in variables, four `m` to a vector; in half precision
//! a subgroup accumulates a block in cooperative matrices, which then pass through workgroup memory. Either way the sums
//! come out four `m` at a time. Channel-major buffers make this one kernel for layers and for weight gradients.

use super::builder::{Factor, Kind, MatrixAt, Memory, Value, Var};
use super::direct::{self, STEP};
use super::give::Epilogue;
use super::half::Matrices;
use super::layout::{Limits, SOFTWARE_TILES};
use super::memory::Emit;
use super::sums::Sums;
use std::ops::Range;

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
    /// Stages of `m` that are on their way from memory at a time.
    pub ahead: u32,
    /// Whether an invocation has all `n`, and reads its `m` where they lie.
    pub direct: bool,
}

impl Tile {
    /// The tile for products of `[m, k]` and `[k, n]`, so many of them, that takes the least time.
    pub fn of(limits: &Limits, sizes: (usize, usize, usize), products: usize) -> Tile {
        Tile::timed(limits, sizes, products).0
    }

    /// The same, with its time, which compares with that of other sizes: what a processor computes one after the other, at
    /// least one tile, at the tile's rate.
    pub fn timed(limits: &Limits, (m, n, k): (usize, usize, usize), products: usize) -> (Tile, f64) {
        let time = |(t, rate): (Tile, f64)| {
            let workgroups = m.div_ceil(t.m as usize) * n.div_ceil(t.n as usize) * products;
            let each = (workgroups as f64 / f64::from(limits.workgroups)).max(1.0);
            (t, each * f64::from(t.m * t.n) / rate)
        };
        let all = Tile::candidates(limits, (m, n, k));
        // The last one fits in any case: of matrices, see [`Limits::matrices`].
        let (last, larger) = (all[all.len() - 1], &all[..all.len() - 1]);
        let others = larger.iter().skip(limits.tiles as usize).filter(|(t, _)| t.fits(limits));
        others.chain([&last]).map(|t| time(*t)).min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or(time(last))
    }

    /// Tiles and their rates, relative to each other.
    fn candidates(limits: &Limits, (m, n, k): (usize, usize, usize)) -> Vec<(Tile, f64)> {
        if limits.tiles == SOFTWARE_TILES && n > 16 {
            return vec![(Tile::direct(m, n, k), 1.0)];
        }
        if let Some(matrices) = limits.matrices()
            && n > 32
            && k >= 16
        {
            let tile = |m, n, own| Tile::of_matrices(matrices, m, n, own);
            let smallest = (Tile::smallest(matrices), 0.5);
            return match n {
                0..=64 => vec![(tile(128, 64, (4, 2)), 0.8), smallest],
                65..=128 => vec![(tile(256, 128, (4, 4)), 1.0), (tile(64, 128, (2, 4)), 0.8), smallest],
                // All columns at once: the other operand is then read once.
                _ => vec![(tile(128, 256, (4, 4)), 1.0), (tile(64, 128, (2, 4)), 0.8), smallest],
            };
        }
        let deep = match k {
            0..=4 => 4,
            5..=8 => 8,
            // A deeper tile of 256 rows would not fit into the 16 KiB that WebGPU guarantees.
            _ if n <= 4 => 8,
            _ => 16,
        };
        let tile = |m, n, k, own_m, own_n| Tile { m, n, k, own_m, own_n, matrices: None, ahead: 1, direct: false };
        match n {
            0..=4 => vec![(tile(256, 4, deep, 4, 4), 1.0)],
            5..=8 => vec![(tile(128, 8, deep, 4, 4), 1.0)],
            9..=16 => vec![(tile(128, 16, deep, 8, 4), 1.0)],
            17..=32 => vec![(tile(64, 32, deep, 8, 4), 1.0)],
            _ => {
                // Long sums write little.
                let largest = match k >= LONG {
                    true => (tile(128, 128, deep, 8, 8), 1.0),
                    false => (tile(128, 64, deep.min(8), 8, 8), 0.9),
                };
                vec![largest, (tile(64, 64, deep, 8, 8), 0.84), (tile(32, 32, deep, 4, 4), 0.5)]
            }
        }
    }

    /// The smallest tile of matrices, which must fit where they are used.
    pub fn smallest(matrices: Matrices) -> Tile {
        Tile::of_matrices(matrices, 64, 64, (2, 2))
    }

    /// A tile of matrices, with the block of a subgroup in matrices.
    fn of_matrices(matrices: Matrices, m: u32, n: u32, own: (u32, u32)) -> Tile {
        let (own_m, own_n) = (own.0 * matrices.side, own.1 * matrices.side);
        Tile { m, n, k: 32, own_m, own_n, matrices: Some(matrices), ahead: 1, direct: false }
    }

    /// Whether a device can start its workgroups.
    pub fn fits(&self, limits: &Limits) -> bool {
        self.bytes() <= limits.max_workgroup_bytes && self.starts()
    }

    /// Whether a workgroup has no more invocations than any device starts.
    pub fn starts(&self) -> bool {
        self.invocations() <= MOST_INVOCATIONS
    }

    /// A tile for drivers in software.
    fn direct(m: usize, n: usize, k: usize) -> Tile {
        const MOST_N: usize = 32;
        let n = n.div_ceil(n.div_ceil(MOST_N)).next_multiple_of(4) as u32;
        let (m, own_m) = match m {
            0..=32 => (32, 4),
            33..=64 => (64, 8),
            65..=128 => (128, 8),
            _ => (256, 8),
        };
        let k = k.next_multiple_of(STEP as usize).min(32) as u32;
        Tile { m, n, k, own_m, own_n: n, matrices: None, ahead: 1, direct: true }
    }

    /// Memory that a workgroup shares.
    fn bytes(&self) -> u32 {
        match self.matrices {
            // Staged, and what the columns' totals pass through.
            None => {
                let vectors = if self.direct { 0 } else { self.m / 4 + 1 } + self.n / 4 + 1;
                self.k * vectors * 16 + self.n * (self.m / self.own_m) * 4
            }
            Some(Matrices { side, subgroup }) => {
                let staged = (self.m + self.n) * (self.k / 4 + 2) * 8;
                staged + self.invocations() / subgroup * side * (self.strip(side) / 4 + 1) * 16
            }
        }
    }

    /// Rows of sums that a subgroup passes through workgroup memory at a time: of two matrices.
    pub fn strip(&self, side: u32) -> u32 {
        self.own_m.min(2 * side)
    }

    /// Parts of the tile's m over which values are combined.
    pub fn parts(&self) -> u32 {
        if self.matrices.is_some() { self.m / self.own_m } else { 1 }
    }

    /// Terms that the loop over them takes at a time.
    pub fn turn(&self) -> u32 {
        self.k * self.ahead
    }

    pub fn invocations(&self) -> u32 {
        (self.m / self.own_m) * (self.n / self.own_n) * self.matrices.map_or(1, |m| m.subgroup)
    }
}

/// Columns of products, of sizes as for [`Tile::of`] and of so many terms each, that one kernel computes each: the few after the
/// last whole tile get one of their own where that saves more than it takes to start.
pub(super) fn split(
    limits: &Limits,
    (m, columns, k): (usize, usize, usize),
    products: usize,
    terms: usize,
) -> Vec<Range<usize>> {
    const FEW: usize = 16;
    /// Multiply-adds of a processor in the time of a kernel that has little to do.
    const START: f64 = 1e6;
    let rest = columns % 64;
    let end = columns - rest;
    let time = |n| Tile::timed(limits, (m, n, k), products).1;
    let start = START / terms as f64;
    let apart = end > 0 && (1..=FEW).contains(&rest) && time(end) + time(rest) + start < time(columns);
    let end = if apart { end } else { columns };
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

/// Emits the product over `from..to` of k, and gives all of the tile's sums to `epilogue`. Terms beyond `to` must come as zeros
/// from `a`, up to a multiple of [`Tile::turn`].
pub(super) fn multiply<'a>(
    e: &mut Emit,
    tile: Tile,
    (from, to): (Value, Value),
    a: Operand<'a>,
    b: Operand<'a>,
    epilogue: &mut dyn Epilogue,
) {
    if tile.direct {
        return direct::multiply(e, tile, (from, to), a, b, epilogue);
    }
    let mut operands =
        [Staged::new(e, tile, "tile_a", (tile.m, tile.ahead), a), Staged::new(e, tile, "tile_b", (tile.n, 1), b)];
    let sums = Sums::new(e, tile);
    let end = if tile.ahead > 1 { whole_turns(e, tile, from, to) } else { to };
    for own in &mut operands {
        own.fetch(e, tile, from, 0);
        for number in 1..own.ahead() {
            let at = plus(e, from, number * tile.k);
            own.fetch_or(e, tile, at, number, (from, end));
        }
    }
    let k = e.b.open_loop("k", from, to, tile.turn());
    for number in 0..tile.ahead {
        // The last stage is multiplied.
        e.b.barrier();
        operands.iter_mut().for_each(|own| own.put(e, tile, number));
        e.b.barrier();
        if tile.matrices.is_some() {
            for own in &mut operands {
                let at = plus(e, k, (number + own.ahead()) * tile.k);
                own.fetch_or(e, tile, at, number, (from, end));
            }
        } else {
            let next = plus(e, k, tile.k);
            let more = e.b.less(next, to);
            e.b.open_if(more);
            operands.iter_mut().for_each(|own| own.fetch(e, tile, next, number));
            e.b.close_if();
        }
        let [a, b] = &operands;
        sums.accumulate(e, tile, a, b);
    }
    e.b.close_loop();
    sums.give(e, tile, epilogue);
}

/// The first multiple of a turn after `from` that is not below `to`.
fn whole_turns(e: &mut Emit, tile: Tile, from: Value, to: Value) -> Value {
    let (turn, rest) = (e.b.u(tile.turn()), e.b.u(tile.turn() - 1));
    let length = e.b.sub(to, from);
    let length = e.b.add(length, rest);
    let turns = e.b.div(length, turn);
    let length = e.b.mul(turns, turn);
    e.b.add(from, length)
}

/// `first + offset`
pub(super) fn plus(e: &mut Emit, first: Value, offset: u32) -> Value {
    let offset = e.b.u(offset);
    e.b.add(first, offset)
}

/// An operand's way through workgroup memory.
pub(super) struct Staged<'a> {
    operand: Operand<'a>,
    memory: Memory,
    edge: u32,
    /// What a line of the memory runs along: the edge, except that matrices may lie as their operand does.
    along: Along,
    /// Vectors of a line, padding included.
    line: u32,
    /// What this invocation has fetched, of as many stages as are on their way.
    fetched: Vec<Vec<Var>>,
}

impl<'a> Staged<'a> {
    /// With the length of the operand's edge, and the number of stages that are on their way at a time.
    pub fn new(e: &mut Emit, tile: Tile, name: &str, (edge, ahead): (u32, u32), operand: Operand<'a>) -> Staged<'a> {
        let half = tile.matrices.is_some();
        // Padding keeps the lines of a tile in different banks.
        let padding = if half { 2 } else { 1 };
        let along = if half { operand.along } else { Along::Edge };
        let (lines, line) = match along {
            Along::K => (edge, tile.k / 4 + padding),
            Along::Edge => (tile.k, edge / 4 + padding),
        };
        let kind = if half { Kind::F16 } else { Kind::F32 };
        let memory = e.b.workgroup(name, kind, true, lines * line);
        let zero = e.b.f(0.0);
        let mut zeros = e.b.splat(zero);
        if half {
            zeros = e.b.half(zeros);
        }
        let count = if !tile.direct { (tile.k * edge / 4).div_ceil(tile.invocations()) } else { 0 };
        let mut fetched = vec![];
        for _ in 0..ahead {
            fetched.push((0..count).map(|i| e.b.var(&format!("{name}_next_n{i}_"), zeros)).collect());
        }
        Staged { operand, memory, edge, along, line, fetched }
    }

    /// Does something for each of the vectors that this invocation fetches: `act` is given k and the position in the tile.
    fn each(&mut self, e: &mut Emit, tile: Tile, mut act: impl FnMut(&mut Self, &mut Emit, usize, Value, Value)) {
        let (vectors, invocations) = (tile.k * self.edge / 4, tile.invocations());
        for i in 0..self.fetched[0].len() {
            let done = i as u32 * invocations;
            let offset = e.b.u(done);
            let number = e.b.add(e.invocation, offset);
            let partly = vectors - done < invocations;
            e.if_below(number, partly.then_some(vectors), |e| {
                let (k, at) = self.locate(e, tile, number);
                act(self, e, i, k, at);
            });
        }
    }

    /// k and the position in the tile of a vector by its number in the order of the operand.
    fn locate(&self, e: &mut Emit, tile: Tile, number: Value) -> (Value, Value) {
        let four = e.b.u(4);
        match self.operand.along {
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
        }
    }

    /// From memory into workgroup memory, in a loop; `one` is 1.
    pub fn pass(&mut self, e: &mut Emit, tile: Tile, first: Value, one: Value) {
        let vectors = tile.k * self.edge / 4;
        let (none, all) = (e.b.u(0), e.b.u(vectors));
        let all = e.b.mul(all, one);
        let before = e.b.open_loop("staged", none, all, tile.invocations());
        let number = e.b.add(before, e.invocation);
        let partly = !vectors.is_multiple_of(tile.invocations());
        e.if_below(number, partly.then_some(vectors), |e| {
            let (own_k, at) = self.locate(e, tile, number);
            let k = e.b.add(first, own_k);
            let value = self.read(e, k, at);
            self.write(e, own_k, at, value);
        });
        e.b.close_loop();
    }

    /// Stages that are on their way at a time.
    fn ahead(&self) -> u32 {
        self.fetched.len() as u32
    }

    /// The stage that begins at `at`, or one that will not be used where there is none: drivers rearrange what a branch has
    /// loaded where the branch ends, and so wait for it before the product, which of matrices takes less time than the way from
    /// memory.
    fn fetch_or(&mut self, e: &mut Emit, tile: Tile, at: Value, number: u32, (other, end): (Value, Value)) {
        let exists = e.b.less(at, end);
        let at = e.b.select(exists, at, other);
        self.fetch(e, tile, at, number);
    }

    /// From memory the stage that begins at `first`, as the one with a number.
    fn fetch(&mut self, e: &mut Emit, tile: Tile, first: Value, number: u32) {
        let which = (number % self.ahead()) as usize;
        self.each(e, tile, |own, e, i, k, at| {
            let k = e.b.add(first, k);
            let value = own.read(e, k, at);
            let value = if tile.matrices.is_some() { e.b.half(value) } else { value };
            e.b.set(own.fetched[which][i], value);
        });
    }

    fn read(&mut self, e: &mut Emit, k: Value, at: Value) -> Value {
        let value = (self.operand.load)(e, k, at);
        e.b.splat(value)
    }

    /// Into workgroup memory.
    fn put(&mut self, e: &mut Emit, tile: Tile, number: u32) {
        let which = (number % self.ahead()) as usize;
        self.each(e, tile, |own, e, i, k, at| {
            let value = e.b.get(own.fetched[which][i]);
            own.write(e, k, at, value);
        });
    }

    fn write(&self, e: &mut Emit, k: Value, at: Value, value: Value) {
        if self.along == self.operand.along {
            let to = self.element(e, k, at);
            e.b.store(self.memory, to, value);
            return;
        }
        // Lines run along the edge, the four neighbours along k.
        let lanes = e.b.u(self.line * 4);
        for j in 0..4 {
            let (offset, lane) = (e.b.u(j), e.b.component(value, j));
            let k = e.b.add(k, offset);
            let to = e.b.mul(k, lanes);
            let to = e.b.add(to, at);
            e.b.store_lane(self.memory, to, lane);
        }
    }

    /// Number of the vector at `(k, edge)`.
    fn element(&self, e: &mut Emit, k: Value, edge: Value) -> Value {
        let (line, along) = if self.along == Along::K { (edge, k) } else { (k, edge) };
        let (length, four) = (e.b.u(self.line), e.b.u(4));
        let (first, along) = (e.b.mul(line, length), e.b.div(along, four));
        e.b.add(first, along)
    }

    /// The vector number `own + offset` of line `k`.
    pub fn vector(&self, e: &mut Emit, k: Value, own: Value, offset: u32) -> Value {
        let (line, offset) = (e.b.u(self.line), e.b.u(offset));
        let first = e.b.mul(k, line);
        let first = e.b.add(first, own);
        let at = e.b.add(first, offset);
        e.b.load(self.memory, at)
    }

    /// Where the matrix at `(k, edge)` lies.
    pub fn matrix(&self, e: &mut Emit, factor: Factor, k: Value, edge: Value) -> MatrixAt {
        let first = self.element(e, k, edge);
        // Rows of the left factor are its edge, rows of the right one are k.
        let row_major = (factor == Factor::Left) == (self.along == Along::K);
        MatrixAt { memory: self.memory, first, line: self.line, row_major }
    }
}
