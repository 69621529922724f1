//! Small matrices in channels, row by row: products, application to points, rigid poses, linear solve.
//!
//! A product of small matrices is one pointwise multiplication of picked channels and a sum over groups of them, so it
//! stays in registers and differentiates by the rules of those.

use crate::graph::{Channels, Tensor, function};
use crate::ops::custom::custom_adjoint;
use crate::ops::pick::concat;

/// The identity, `(n, n)`.
#[track_caller]
pub fn identity(n: usize) -> Tensor {
    Tensor::constant_matrix(n, n, &eye(n))
}

fn eye(n: usize) -> Vec<f64> {
    (0..n * n).map(|i| if i / n == i % n { 1.0 } else { 0.0 }).collect()
}

/// Product of small matrices, `(m, k)` times `(k, n)`, element by element of the axes.
#[track_caller]
pub fn matmul(a: &Tensor, b: &Tensor) -> Tensor {
    let called = function("matmul");
    let (Channels::Matrix(m, k), Channels::Matrix(k2, n)) = (a.channels(), b.channels()) else {
        let hint = "reshape the channels to (m, k) and (k, n)";
        return called.misfit(&[a, b], "both operands must be matrices", hint);
    };
    if k != k2 {
        let problem = format!("{k} columns do not meet {k2} rows");
        return called.misfit(&[a, b], problem, "the inner sizes must agree; transpose() one of them?");
    }
    let left: Vec<usize> = (0..m * n * k).map(|i| i / (n * k) * k + i % k).collect();
    let right: Vec<usize> = (0..m * n * k).map(|i| i % k * n + i / k % n).collect();
    (a.pick(&left) * b.pick(&right)).channel_groups(runs(m * n, k)).reshape((m, n))
}

/// `count` groups of `length` neighbouring channels.
fn runs(count: usize, length: usize) -> Vec<Vec<u32>> {
    (0..count).map(|o| ((o * length) as u32..((o + 1) * length) as u32).collect()).collect()
}

/// `A x`: a matrix `(m, k)` applied to a vector of `k` channels.
#[track_caller]
pub fn apply(a: &Tensor, x: &Tensor) -> Tensor {
    let called = function("apply");
    match a.channels() {
        Channels::Matrix(m, k) if x.width() == k => {
            let cycled: Vec<usize> = (0..m * k).map(|i| i % k).collect();
            (a.reshape(m * k) * x.pick(&cycled)).channel_groups(runs(m, k))
        }
        other => {
            let problem = format!("channels {other} do not apply to {} channels", x.channels());
            called.misfit(&[a, x], problem, format!("a matrix (m, {}) would fit", x.width()))
        }
    }
}

/// `R x + t` for an affine map `[R | t]`, `(m, k + 1)`, and `k` channels.
#[track_caller]
pub fn apply_affine(map: &Tensor, x: &Tensor) -> Tensor {
    let called = function("apply_affine");
    match map.channels() {
        Channels::Matrix(m, k1) if k1 == x.width() + 1 => {
            let (linear, offset) = split_affine(map, m, k1 - 1);
            apply(&linear, x) + offset
        }
        other => {
            let problem = format!("channels {other} are no affine map of {} channels", x.channels());
            called.misfit(&[map, x], problem, format!("a map (m, {}) would fit", x.width() + 1))
        }
    }
}

/// R `(m, k)` and t (m channels) of `[R | t]`.
#[track_caller]
fn split_affine(map: &Tensor, m: usize, k: usize) -> (Tensor, Tensor) {
    let linear: Vec<usize> = (0..m * k).map(|i| i / k * (k + 1) + i % k).collect();
    let offset: Vec<usize> = (0..m).map(|i| i * (k + 1) + k).collect();
    (map.pick_as(&linear, (m, k)), map.pick(&offset))
}

/// `[R | t]` of a matrix `(m, k)` and `m` channels.
#[track_caller]
pub fn join_affine(linear: &Tensor, offset: &Tensor) -> Tensor {
    let called = function("join_affine");
    match linear.channels() {
        Channels::Matrix(m, k) if offset.width() == m => {
            let place = |i: usize| if i % (k + 1) < k { i / (k + 1) * k + i % (k + 1) } else { m * k + i / (k + 1) };
            let order: Vec<usize> = (0..m * (k + 1)).map(place).collect();
            concat([linear, offset]).pick_as(&order, (m, k + 1))
        }
        other => {
            let problem = format!("a matrix {other} and an offset of {} channels", offset.channels());
            called.misfit(&[linear, offset], problem, "the offset has one channel a row")
        }
    }
}

/// Rotation `(n, n)` and translation of a pose `[R | t]`, `(n, n + 1)`.
#[track_caller]
pub fn split_pose(pose: &Tensor) -> (Tensor, Tensor) {
    let called = function("split_pose");
    match pose.channels() {
        Channels::Matrix(n, n1) if n1 == n + 1 => split_affine(pose, n, n),
        other => {
            let problem = format!("channels {other} are no pose");
            let bad = called.misfit(&[pose], problem, "a pose is (n, n + 1): rotation and translation");
            (bad.clone(), bad)
        }
    }
}

/// `outer` after `inner`: `[R2 R1 | R2 t1 + t2]` for poses `outer = [R2 | t2]`, `inner = [R1 | t1]`.
#[track_caller]
pub fn compose_poses(outer: &Tensor, inner: &Tensor) -> Tensor {
    let _called = function("compose_poses");
    let ((r2, t2), (r1, t1)) = (split_pose(outer), split_pose(inner));
    join_affine(&matmul(&r2, &r1), &(apply(&r2, &t1) + t2))
}

/// Inverse of a rigid pose, `[R^T | -R^T t]`.
#[track_caller]
pub fn invert_pose(pose: &Tensor) -> Tensor {
    let _called = function("invert_pose");
    let (rotation, translation) = split_pose(pose);
    let back = rotation.transpose();
    join_affine(&back, &-apply(&back, &translation))
}

/// Added to the denominator of a projection, as the planar reference implementations do.
pub const PROJECTION_EPSILON: f64 = 1e-8;

/// `(q_x, q_y) / (q_z + 1e-8)` with `q = H (x, y, 1)`: a homography `(3, 3)` applied to two channels.
#[track_caller]
pub fn apply_homography(h: &Tensor, x: &Tensor) -> Tensor {
    let called = function("apply_homography");
    if h.channels() != Channels::Matrix(3, 3) {
        let problem = format!("channels {} are no homography", h.channels());
        return called.misfit(&[h, x], problem, "a homography is (3, 3)");
    }
    // The homography is an affine map to three channels.
    let q = apply_affine(h, x);
    q.slice(0..2) / (q.slice(2..3) + PROJECTION_EPSILON)
}

/// Eigenvalues below this part of the largest one are raised to it before dividing by them. A matrix in single precision says
/// nothing of smaller ones, and dividing by what rounding left of them loses the digits of everything else.
const SINGULAR: f64 = 1e-9;
/// Eigenvalues are negative only if they are larger than this part of the largest one: rounding makes smaller ones of matrices that
/// have none.
const NEGATIVE: f64 = 1e-5;

/// `G^-1 b` for a symmetric `G`, `(n, n)` with n <= 9, and n channels, by the eigen-decomposition of (the symmetric part of) G.
///
/// The gradient is that of the solution itself, `dG = -(G^-1 g) h^T` symmetrised and `db = G^-1 g`, not the one composed
/// from eigenvectors: that loses all digits where eigenvalues meet, while the solution does not notice.
#[track_caller]
pub fn solve_symmetric(g: &Tensor, b: &Tensor) -> Tensor {
    let called = function("solve_symmetric");
    if !matches!(g.channels(), Channels::Matrix(r, c) if r == c && b.width() == r) {
        let problem = format!("channels {} are no system for {} channels", g.channels(), b.channels());
        let hint = "the matrix is (n, n), the right side has n channels";
        return called.misfit(&[g, b], problem, hint);
    }
    let (values, vectors) = g.stop_gradient().sym_eig();
    let largest = values.abs().max_channels();
    let least = &largest * SINGULAR;
    let divisors = values.less_than(&(largest * -NEGATIVE)).select(&values, &values.max(&least));
    let along = apply(&vectors.transpose(), b) / divisors;
    let solution = apply(&vectors, &along);
    custom_adjoint(&solution, &[g, b], |inputs, grad| {
        let (g, b) = (&inputs[0], &inputs[1]);
        let back = solve_symmetric(g, grad);
        let solution = solve_symmetric(g, b);
        let n = solution.width();
        let rows: Vec<usize> = (0..n * n).map(|i| i / n).collect();
        let columns: Vec<usize> = (0..n * n).map(|i| i % n).collect();
        let product = back.pick_as(&rows, (n, n)) * solution.pick_as(&columns, (n, n));
        vec![Some((&product + product.transpose()) * -0.5), Some(back)]
    })
}
