//! The way of a tile's sums to the epilogue of its kernel, from variables or through workgroup memory, and of what the
//! epilogue wants to be combined over m.

use super::builder::{Kind, MatrixAt, MatrixSum, Memory, Value, Var};
use super::half::Matrices;
use super::memory::Emit;
use super::reduce::{combine, combine_lanes, neutral};
use super::tile::Tile;
use raygrad_compiler::ops::Reduction;
use std::collections::VecDeque;

/// Strips for which what they need from memory is on its way at a time.
const AHEAD: usize = 3;

/// Where in the tile sums of four neighbouring m of one n are: the first m, and n.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub m: Value,
    pub n: Value,
}

/// Takes the sums, some at a time. What they need from memory should be read ahead, and in any case before any of them is
/// written: a device waits for every read that follows a write.
pub(super) trait Epilogue {
    /// Reads what the sums at the next places need. Called while those before are on their way.
    fn ahead(&mut self, _: &mut Emit, _: &[Place]) {}

    /// Uses the sums at some places, those of the least recent call of `ahead` that was not answered. Returns what it wants
    /// to be combined over m: for each of `kinds`, one value a place.
    fn sums(&mut self, e: &mut Emit, places: &[Place], sums: &[Value]) -> Vec<Vec<Value>>;

    /// How values are combined over m.
    fn kinds(&self) -> Vec<Reduction> {
        vec![]
    }

    /// Takes the values of the kind with a number, combined over a part of the tile's m, of which there are [`Tile::parts`].
    fn total(&mut self, _: &mut Emit, _: usize, _: Total) {}
}

/// Values of one n combined over part number `part` of the tile's m.
pub(super) struct Total {
    pub n: Value,
    pub part: Value,
    pub value: Value,
}

impl<F: FnMut(&mut Emit, &[Place], &[Value])> Epilogue for F {
    fn sums(&mut self, e: &mut Emit, places: &[Place], sums: &[Value]) -> Vec<Vec<Value>> {
        self(e, places, sums);
        vec![]
    }
}

/// Totals that an invocation keeps: of each kind, one a place.
struct Totals(Vec<(Reduction, Vec<Var>)>);

impl Totals {
    fn new(e: &mut Emit, kinds: &[Reduction], places: usize) -> Totals {
        let each = |kind: &Reduction| {
            let first = neutral(&mut e.b, *kind);
            (*kind, (0..places).map(|_| e.b.var("total", first)).collect())
        };
        Totals(kinds.iter().map(each).collect())
    }

    fn add(&self, e: &mut Emit, values: &[Vec<Value>]) {
        for ((kind, totals), values) in self.0.iter().zip(values) {
            for (total, value) in totals.iter().zip(values) {
                let before = e.b.get(*total);
                let after = combine(&mut e.b, *kind, before, *value);
                e.b.set(*total, after);
            }
        }
    }

    /// Begins anew.
    fn clear(&self, e: &mut Emit) {
        for (kind, totals) in &self.0 {
            let first = neutral(&mut e.b, *kind);
            totals.iter().for_each(|t| e.b.set(*t, first));
        }
    }
}

/// Hands out what invocations hold in variables.
pub(super) fn give_blocks(
    e: &mut Emit,
    tile: Tile,
    sums: &[Vec<Var>],
    (column, row): (Value, Value),
    epilogue: &mut dyn Epilogue,
) {
    let (across, down) = (tile.m / tile.own_m, tile.n / tile.own_n);
    let kinds = epilogue.kinds();
    let totals = Totals::new(e, &kinds, tile.own_n as usize);
    let own_n: Vec<Value> = (0..tile.own_n).map(|j| place(e, row, j / 4 * down, j % 4)).collect();
    for i in 0..tile.own_m / 4 {
        let m = place(e, column, i * across, 0);
        let (mut places, mut found) = (vec![], vec![]);
        for (n, sums) in own_n.iter().zip(sums) {
            places.push(Place { m, n: *n });
            found.push(e.b.get(sums[i as usize]));
        }
        epilogue.ahead(e, &places);
        let values = epilogue.sums(e, &places, &found);
        totals.add(e, &values);
    }
    through_columns(e, tile, &own_n, column, epilogue, &mut |e, which, j| e.b.get(totals.0[which].1[j]));
}

/// Combines the totals of the invocations that have the same n, of each of which `across` have one, through workgroup memory.
/// `own` gives this invocation's total of the kind with a number for the n with a number.
pub(super) fn through_columns(
    e: &mut Emit,
    tile: Tile,
    own_n: &[Value],
    column: Value,
    epilogue: &mut dyn Epilogue,
    own: &mut dyn FnMut(&mut Emit, usize, usize) -> Value,
) {
    let (kinds, across) = (epilogue.kinds(), tile.m / tile.own_m);
    if kinds.is_empty() {
        return;
    }
    e.b.topic("column");
    let memory = e.b.workgroup("columns", Kind::F32, false, tile.n * across);
    for (which, kind) in kinds.iter().enumerate() {
        if which > 0 {
            e.b.barrier();
        }
        let across_value = e.b.u(across);
        for (j, n) in own_n.iter().enumerate() {
            let at = e.b.mul(*n, across_value);
            let at = e.b.add(at, column);
            let value = own(e, which, j);
            e.b.store(memory, at, value);
        }
        e.b.barrier();
        let (mut n, part) = (e.invocation, e.b.u(0));
        for done in (0..tile.n).step_by(tile.invocations() as usize) {
            if done > 0 {
                let before = e.b.u(done);
                n = e.b.add(e.invocation, before);
            }
            e.if_below(n, Some(tile.n), |e| {
                let first = e.b.mul(n, across_value);
                let value = combine_lanes(e, *kind, memory, first, (across, 1));
                epilogue.total(e, which, Total { n, part, value });
            });
        }
    }
}

/// The way of a subgroup's matrices through memory of its own: a strip of a few of the same columns at a time, from which
/// each invocation takes vectors of four m.
pub(super) struct Strips {
    memory: Memory,
    /// The subgroup's first vector in the memory.
    first: Value,
    /// Vectors of a column, and with padding.
    vectors: u32,
    line: u32,
    sizes: Matrices,
    /// Number of the invocation in its subgroup.
    lane: Value,
    /// The vectors and columns that this invocation takes of each strip.
    mine: Vec<(Value, Value)>,
}

impl Strips {
    pub fn new(e: &mut Emit, tile: Tile, sizes: Matrices, subgroup: Value) -> Strips {
        let side = sizes.side;
        let vectors = tile.strip(side) / 4;
        let line = vectors + 1;
        let own = side * line;
        let subgroups = tile.invocations() / sizes.subgroup;
        let memory = e.b.workgroup("block", Kind::F32, true, subgroups * own);
        let own = e.b.u(own);
        let first = e.b.mul(subgroup, own);
        let count = e.b.u(sizes.subgroup);
        let lane = e.b.rem(e.invocation, count);
        let mut mine = vec![];
        for done in (0..vectors * side).step_by(sizes.subgroup as usize) {
            let vectors_value = e.b.u(vectors);
            // Where a subgroup takes whole columns at a time, its invocations stay with their vectors.
            let whole = sizes.subgroup.is_multiple_of(vectors);
            let mut number = lane;
            if !whole {
                let done = e.b.u(done);
                number = e.b.add(lane, done);
            }
            let (vector, mut column) = (e.b.rem(number, vectors_value), e.b.div(number, vectors_value));
            if whole {
                let before = e.b.u(done / vectors);
                column = e.b.add(column, before);
            }
            mine.push((vector, column));
        }
        Strips { memory, first, vectors, line, sizes, lane, mine }
    }

    /// Hands out the sums of a subgroup whose block of the tile begins at `first`.
    pub fn give(
        &self,
        e: &mut Emit,
        tile: Tile,
        sums: &[Vec<MatrixSum>],
        first: (Value, Value),
        epilogue: &mut dyn Epilogue,
    ) {
        let matrices = (tile.strip(self.sizes.side) / self.sizes.side) as usize;
        let strips = sums[0].len().div_ceil(matrices);
        let rounds: Vec<(usize, usize)> = (0..sums.len()).flat_map(|j| (0..strips).map(move |i| (j, i))).collect();
        let kinds = epilogue.kinds();
        let totals = Totals::new(e, &kinds, self.mine.len());
        let mut ahead = VecDeque::new();
        for round in rounds.iter().take(AHEAD) {
            ahead.push_back(self.read(e, *round, first, epilogue));
        }
        for (round, (j, i)) in rounds.iter().enumerate() {
            let found = self.pass(e, sums[*j].chunks(matrices).nth(*i).unwrap_or_default());
            let here = ahead.pop_front().unwrap_or_default();
            if let Some(after) = rounds.get(round + AHEAD) {
                ahead.push_back(self.read(e, *after, first, epilogue));
            }
            let values = epilogue.sums(e, &here, &found);
            totals.add(e, &values);
            if i + 1 == strips {
                // These columns are through.
                self.total(e, tile, *j, first, &totals, epilogue);
                if j + 1 < sums.len() {
                    totals.clear(e);
                }
            }
        }
    }

    /// Reads what the sums of a strip need, and returns where in the tile they are.
    fn read(
        &self,
        e: &mut Emit,
        round: (usize, usize),
        first: (Value, Value),
        epilogue: &mut dyn Epilogue,
    ) -> Vec<Place> {
        let places = self.places(e, round, first);
        epilogue.ahead(e, &places);
        places
    }

    /// Where in the tile the vectors of this invocation are in strip `i` of columns `j`.
    fn places(&self, e: &mut Emit, (j, i): (usize, usize), (first_m, first_n): (Value, Value)) -> Vec<Place> {
        let (before_m, before_n) = (e.b.u(i as u32 * self.vectors * 4), e.b.u(j as u32 * self.sizes.side));
        let (m, n) = (e.b.add(first_m, before_m), e.b.add(first_n, before_n));
        let four = e.b.u(4);
        let mut all = vec![];
        for (vector, column) in &self.mine {
            let own = e.b.mul(*vector, four);
            all.push(Place { m: e.b.add(m, own), n: e.b.add(n, *column) });
        }
        all
    }

    /// Puts a strip into memory and takes this invocation's vectors from there.
    fn pass(&self, e: &mut Emit, strip: &[MatrixSum]) -> Vec<Value> {
        let (memory, line) = (self.memory, self.line);
        e.b.barrier();
        for (i, sum) in strip.iter().enumerate() {
            let offset = e.b.u(i as u32 * self.sizes.side / 4);
            let first = e.b.add(self.first, offset);
            e.b.matrix_store(*sum, MatrixAt { memory, first, line, row_major: false });
        }
        e.b.barrier();
        let mut found = vec![];
        for (vector, column) in &self.mine {
            let line = e.b.u(line);
            let at = e.b.mul(*column, line);
            let at = e.b.add(at, *vector);
            let at = e.b.add(at, self.first);
            found.push(e.b.load(memory, at));
        }
        found
    }

    /// Combines the totals of columns `j` through the same memory, a lane of it each.
    fn total(
        &self,
        e: &mut Emit,
        tile: Tile,
        j: usize,
        (first_m, first_n): (Value, Value),
        totals: &Totals,
        epilogue: &mut dyn Epilogue,
    ) {
        e.b.topic("column");
        let side = self.sizes.side;
        for (which, (kind, totals)) in totals.0.iter().enumerate() {
            let (four, line) = (e.b.u(4), e.b.u(4 * self.line));
            let first = e.b.mul(self.first, four);
            e.b.barrier();
            for ((vector, column), total) in self.mine.iter().zip(totals) {
                let at = e.b.mul(*column, line);
                let at = e.b.add(at, *vector);
                let at = e.b.add(at, first);
                let value = e.b.get(*total);
                e.b.store_lane(self.memory, at, value);
            }
            e.b.barrier();
            let own_m = e.b.u(tile.own_m);
            let part = e.b.div(first_m, own_m);
            for done in (0..side).step_by(self.sizes.subgroup as usize) {
                let (done, before) = (e.b.u(done), e.b.u(j as u32 * side));
                let column = e.b.add(self.lane, done);
                e.if_below(column, Some(side), |e| {
                    let own = e.b.mul(column, line);
                    let own = e.b.add(own, first);
                    let value = combine_lanes(e, *kind, self.memory, own, (self.vectors, 1));
                    let n = e.b.add(first_n, before);
                    let n = e.b.add(n, column);
                    epilogue.total(e, which, Total { n, part, value });
                });
            }
        }
    }
}

/// `4 (before + own) + extra`
pub(super) fn place(e: &mut Emit, own: Value, before: u32, extra: u32) -> Value {
    let (before, four, extra) = (e.b.u(before), e.b.u(4), e.b.u(extra));
    let at = e.b.add(own, before);
    let at = e.b.mul(at, four);
    e.b.add(at, extra)
}
