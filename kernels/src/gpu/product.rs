//! Tiled matrix products: a workgroup computes a tile of `C_mn = sum_k A_km B_kn`, staged through workgroup memory. The
//! next stage is on its way from memory while one is multiplied.
//!
//! In single precision an invocation accumulates a block of the tile in variables, four `m` to a vector; in half precision
//! a subgroup accumulates a block in cooperative matrices, which then pass through workgroup memory. Either way the sums
//! come out four `m` at a time. Channel-major buffers make this one kernel for layers and for weight gradients.

use super::builder::{Factor, Kind, MatrixAt, Memory, Value, Var};
use super::direct;
use super::give::Epilogue;
use super::memory::Emit;
use super::sums::Sums;
use super::tile::Tile;

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
