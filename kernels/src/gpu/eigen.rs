//! Eigen-decomposition of a small symmetric matrix in one invocation: cyclic Jacobi rotations on private arrays.
//!
//! The loops are rolled and the number of sweeps is fixed: convergence is quadratic, and f32 is exact to its last digits
//! after 6 sweeps at n = 4 and after 8 at n = 9.

use super::builder::{Builder, Kind, Memory, Value};
use naga::{BinaryOperator as Op, MathFunction as Math, UnaryOperator};

/// The eigenvalues of `matrix` (row by row) in ascending order, then the matrix of eigenvectors in columns, row by row,
/// each with its largest component positive.
pub(super) fn sym_eig(b: &mut Builder, n: u32, matrix: &[Value]) -> Memory {
    b.topic("eigen");
    let a = b.private("matrix", Kind::F32, false, n * n);
    let v = b.private("vectors", Kind::F32, false, n * n);
    for i in 0..n * n {
        let (at, half) = (b.u(i), b.f(0.5));
        let twice = b.add(matrix[i as usize], matrix[(i % n * n + i / n) as usize]);
        let symmetric = b.mul(half, twice);
        b.store(a, at, symmetric);
        let unit = b.f(if i / n == i % n { 1.0 } else { 0.0 });
        b.store(v, at, unit);
    }
    let size = b.u(n);
    let (zero, sweeps) = (b.u(0), b.u(if n <= 4 { 8 } else { 10 }));
    b.open_loop("sweep", zero, sweeps, 1);
    let p = b.open_loop("p", zero, size, 1);
    let one = b.u(1);
    let after = b.add(p, one);
    let q = b.open_loop("q", after, size, 1);
    rotate(b, a, v, p, q, size);
    b.close_loop();
    b.close_loop();
    b.close_loop();
    sorted(b, a, v, n)
}

/// `row * n + column`
fn at(b: &mut Builder, n: Value, row: Value, column: Value) -> Value {
    let row = b.mul(row, n);
    b.add(row, column)
}

/// Rotates rows and columns p and q so that the entry between them vanishes.
fn rotate(b: &mut Builder, a: Memory, v: Memory, p: Value, q: Value, n: Value) {
    let (pp, qq, pq, qp) = (at(b, n, p, p), at(b, n, q, q), at(b, n, p, q), at(b, n, q, p));
    let (app, aqq, apq) = (b.load(a, pp), b.load(a, qq), b.load(a, pq));
    let zero = b.f(0.0);
    // Below half a unit in the last place of both diagonal entries: nothing left to do.
    let counts = |b: &mut Builder, diagonal: Value| {
        let (size, off) = (b.math(Math::Abs, &[diagonal]), b.math(Math::Abs, &[apq]));
        let sum = b.add(size, off);
        b.binary(Op::NotEqual, sum, size)
    };
    let (left, right) = (counts(b, app), counts(b, aqq));
    let matters = b.binary(Op::InclusiveOr, left, right);
    b.open_if(matters);
    let (one, two, minus) = (b.f(1.0), b.f(2.0), b.f(-1.0));
    let gap = b.sub(aqq, app);
    let twice = b.mul(two, apq);
    let theta = b.div(gap, twice);
    let square = b.fma(theta, theta, one);
    let root = b.math(Math::Sqrt, &[square]);
    let size = b.math(Math::Abs, &[theta]);
    let below = b.add(size, root);
    let negative = b.less(theta, zero);
    let sign = b.select(negative, minus, one);
    let t = b.div(sign, below);
    let square = b.fma(t, t, one);
    let root = b.math(Math::Sqrt, &[square]);
    let c = b.div(one, root);
    let s = b.mul(t, c);
    b.name(c, "cosine");
    b.name(s, "sine");
    let turn = |b: &mut Builder, m: Memory, i: Value, j: Value| {
        let (x, y) = (b.load(m, i), b.load(m, j));
        let (cx, sy, sx, cy) = (b.mul(c, x), b.mul(s, y), b.mul(s, x), b.mul(c, y));
        let (first, second) = (b.sub(cx, sy), b.add(sx, cy));
        b.store(m, i, first);
        b.store(m, j, second);
    };
    let none = b.u(0);
    let k = b.open_loop("k", none, n, 1);
    let (kp, kq) = (at(b, n, k, p), at(b, n, k, q));
    turn(b, a, kp, kq);
    turn(b, v, kp, kq);
    b.close_loop();
    let k = b.open_loop("k", none, n, 1);
    let (pk, qk) = (at(b, n, p, k), at(b, n, q, k));
    turn(b, a, pk, qk);
    b.close_loop();
    b.close_if();
    b.store(a, pq, zero);
    b.store(a, qp, zero);
}

/// Each eigenvalue goes to the place that its rank names, its eigenvector to the column.
fn sorted(b: &mut Builder, a: Memory, v: Memory, n: u32) -> Memory {
    let result = b.private("eigen", Kind::F32, false, n + n * n);
    let (none, size, one) = (b.u(0), b.u(n), b.u(1));
    let j = b.open_loop("j", none, size, 1);
    let jj = at(b, size, j, j);
    let own = b.load(a, jj);
    let rank = b.var("rank", none);
    let i = b.open_loop("i", none, size, 1);
    let ii = at(b, size, i, i);
    let other = b.load(a, ii);
    let (less, equal, earlier) = (b.less(other, own), b.binary(Op::Equal, other, own), b.less(i, j));
    let tie = b.binary(Op::And, equal, earlier);
    let before = b.binary(Op::InclusiveOr, less, tie);
    let step = b.select(before, one, none);
    let so_far = b.get(rank);
    let next = b.add(so_far, step);
    b.set(rank, next);
    b.close_loop();
    let rank = b.get(rank);
    b.store(result, rank, own);

    let nothing = b.f(0.0);
    let largest = b.var("largest", nothing);
    let k = b.open_loop("k", none, size, 1);
    let kj = at(b, size, k, j);
    let (x, most) = (b.load(v, kj), b.get(largest));
    let (size_x, size_most) = (b.math(Math::Abs, &[x]), b.math(Math::Abs, &[most]));
    let more = b.less(size_most, size_x);
    let most = b.select(more, x, most);
    b.set(largest, most);
    b.close_loop();
    let most = b.get(largest);
    let flipped = b.less(most, nothing);

    let k = b.open_loop("k", none, size, 1);
    let kj = at(b, size, k, j);
    let x = b.load(v, kj);
    let minus = b.unary(UnaryOperator::Negate, x);
    let x = b.select(flipped, minus, x);
    let to = at(b, size, k, rank);
    let to = b.add(size, to);
    b.store(result, to, x);
    b.close_loop();
    b.close_loop();
    result
}
