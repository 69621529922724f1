//! What a tile of a matrix product accumulates: blocks in variables, or cooperative matrices.

use super::builder::{Factor, Kind, MatrixAt, MatrixSum, Memory, Value, Var};
use super::half::Matrices;
use super::memory::Emit;
use super::reduce::{combine, neutral};
use super::tile::{Staged, Tile};
use naga::BuiltIn;
use raygrad_compiler::ops::Reduction;

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

/// `count` lanes of a memory from `first` on, combined in order.
fn combined(e: &mut Emit, kind: Reduction, memory: Memory, first: Value, count: u32) -> Value {
    let mut total = e.b.load_lane(memory, first);
    for i in 1..count {
        let offset = e.b.u(i);
        let at = e.b.add(first, offset);
        let next = e.b.load_lane(memory, at);
        total = combine(&mut e.b, kind, total, next);
    }
    total
}

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
            Sums::Block { sums, column, row } => {
                let across = tile.m / tile.own_m;
                let down = tile.n / tile.own_n;
                let kinds = epilogue.kinds();
                let totals = Totals::new(e, &kinds, tile.own_n as usize);
                let own_n: Vec<Value> = (0..tile.own_n).map(|j| place(e, *row, j / 4 * down, j % 4)).collect();
                for i in 0..tile.own_m / 4 {
                    let m = place(e, *column, i * across, 0);
                    let (mut places, mut found) = (vec![], vec![]);
                    for (n, sums) in own_n.iter().zip(sums) {
                        places.push(Place { m, n: *n });
                        found.push(e.b.get(sums[i as usize]));
                    }
                    epilogue.ahead(e, &places);
                    let values = epilogue.sums(e, &places, &found);
                    totals.add(e, &values);
                }
                // Through workgroup memory, one kind after the other: invocations of the same columns are `across`.
                if kinds.is_empty() {
                    return;
                }
                let memory = e.b.workgroup("columns", Kind::F32, false, tile.n * across);
                for (which, (kind, totals)) in totals.0.iter().enumerate() {
                    if which > 0 {
                        e.b.barrier();
                    }
                    let across_value = e.b.u(across);
                    for (n, total) in own_n.iter().zip(totals) {
                        let at = e.b.mul(*n, across_value);
                        let at = e.b.add(at, *column);
                        let value = e.b.get(*total);
                        e.b.store(memory, at, value);
                    }
                    e.b.barrier();
                    let (n, part) = (e.invocation, e.b.u(0));
                    e.if_below(n, Some(tile.n), |e| {
                        let first = e.b.mul(n, across_value);
                        let value = combined(e, *kind, memory, first, across);
                        epilogue.total(e, which, Total { n, part, value });
                    });
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
                // Vectors of four m and columns that this invocation takes, where lanes are vectors of columns.
                let vectors = strip / 4;
                let mut mine = vec![];
                for done in (0..vectors * side).step_by(sizes.subgroup as usize) {
                    let vectors_value = e.b.u(vectors);
                    let number = match sizes.subgroup.is_multiple_of(vectors) {
                        true => lane,
                        false => {
                            let done = e.b.u(done);
                            e.b.add(lane, done)
                        }
                    };
                    let (vector, mut column) = (e.b.rem(number, vectors_value), e.b.div(number, vectors_value));
                    if number == lane {
                        let before = e.b.u(done / vectors);
                        column = e.b.add(column, before);
                    }
                    mine.push((vector, column));
                }
                let rounds: Vec<(usize, usize)> = (0..sums.len())
                    .flat_map(|j| (0..sums[0].len().div_ceil((strip / side) as usize)).map(move |i| (j, i)))
                    .collect();
                let places = |e: &mut Emit, (j, i): (usize, usize)| {
                    let (before_m, before_n) = (e.b.u(i as u32 * strip), e.b.u(j as u32 * side));
                    let (m, n) = (e.b.add(*first_m, before_m), e.b.add(*first_n, before_n));
                    let four = e.b.u(4);
                    let mut all = vec![];
                    for (vector, column) in &mine {
                        let own = e.b.mul(*vector, four);
                        all.push(Place { m: e.b.add(m, own), n: e.b.add(n, *column) });
                    }
                    all
                };
                let strips = rounds.len() / sums.len();
                let kinds = epilogue.kinds();
                let totals = Totals::new(e, &kinds, mine.len());
                let mut next = places(e, rounds[0]);
                epilogue.ahead(e, &next);
                for (round, (j, i)) in rounds.iter().enumerate() {
                    e.b.barrier();
                    let here = sums[*j].chunks((strip / side) as usize).skip(*i).take(1);
                    for (i, sum) in here.flatten().enumerate() {
                        let offset = e.b.u(i as u32 * side / 4);
                        let first = e.b.add(own_first, offset);
                        e.b.matrix_store(*sum, MatrixAt { memory, first, line, row_major: false });
                    }
                    e.b.barrier();
                    let mut found = vec![];
                    for (vector, column) in &mine {
                        let line = e.b.u(line);
                        let at = e.b.mul(*column, line);
                        let at = e.b.add(at, *vector);
                        let at = e.b.add(at, own_first);
                        found.push(e.b.load(memory, at));
                    }
                    let here = next.clone();
                    if let Some(after) = rounds.get(round + 1) {
                        next = places(e, *after);
                        epilogue.ahead(e, &next);
                    }
                    let values = epilogue.sums(e, &here, &found);
                    totals.add(e, &values);
                    if i + 1 < strips {
                        continue;
                    }
                    // The columns are through: their totals pass through the same memory.
                    for (which, (kind, totals)) in totals.0.iter().enumerate() {
                        let (four, line_value) = (e.b.u(4), e.b.u(4 * line));
                        let own_first = e.b.mul(own_first, four);
                        e.b.barrier();
                        for ((vector, column), total) in mine.iter().zip(totals) {
                            let at = e.b.mul(*column, line_value);
                            let at = e.b.add(at, *vector);
                            let at = e.b.add(at, own_first);
                            let value = e.b.get(*total);
                            e.b.store_lane(memory, at, value);
                        }
                        e.b.barrier();
                        let (across, own_m) = (e.b.u(tile.m / tile.own_m), e.b.u(tile.own_m));
                        let part = e.b.div(*first_m, own_m);
                        let part = e.b.rem(part, across);
                        for done in (0..side).step_by(sizes.subgroup as usize) {
                            let (done, before) = (e.b.u(done), e.b.u(*j as u32 * side));
                            let column = e.b.add(lane, done);
                            e.if_below(column, Some(side), |e| {
                                let first = e.b.mul(column, line_value);
                                let first = e.b.add(first, own_first);
                                let value = combined(e, *kind, memory, first, vectors);
                                let n = e.b.add(*first_n, before);
                                let n = e.b.add(n, column);
                                epilogue.total(e, which, Total { n, part, value });
                            });
                        }
                    }
                    totals.clear(e);
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
