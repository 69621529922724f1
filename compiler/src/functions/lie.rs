//! Exponentials of the Lie algebras of rotations, rigid motions and homographies.
//!
//! As in the reference implementations of BARF (Lin, Ma, Torralba, Lucey, ICCV 2021), the coefficients are power series
//! in `theta^2` of eleven terms, without a branch at small angles: smooth everywhere, good for `|theta| < 5`.
//!
//! ```text
//! A = sin(theta) / theta,  B = (1 - cos(theta)) / theta^2,  C = (theta - sin(theta)) / theta^3
//! R = I + A W + B W^2,     V = I + B W + C W^2,             exp(w, u) = [R | V u],   W = the cross product with w
//! ```

use super::expect_width;
use super::matrix::{apply, identity, join_affine, matmul};
use crate::graph::{Tensor, function};
use crate::ops::pick::concat;

const TERMS: usize = 11;

/// One channel an entry of `offsets`: `sum_i (-1)^i theta^(2 i) / (2 i + offset)!`.
#[track_caller]
fn series(theta2: &Tensor, offsets: &[usize]) -> Tensor {
    let term = |i: usize| -> Vec<f64> {
        let sign = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        offsets.iter().map(|o| sign / factorial(2 * i + o)).collect()
    };
    let mut sum = Tensor::constant(&term(TERMS - 1));
    for i in (0..TERMS - 1).rev() {
        sum = sum * theta2 + Tensor::constant(&term(i));
    }
    sum
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|i| i as f64).product()
}

/// `a x b` of three channels each.
#[track_caller]
pub fn cross(a: &Tensor, b: &Tensor) -> Tensor {
    let called = function("cross");
    for t in [a, b] {
        if let Err(bad) = expect_width(&called, "vectors", t, 3) {
            return bad;
        }
    }
    a.pick(&[1, 2, 0]) * b.pick(&[2, 0, 1]) - a.pick(&[2, 0, 1]) * b.pick(&[1, 2, 0])
}

/// Rotation `(3, 3)` of a rotation vector, of at most 5 radians: of 12 what the series gives is no rotation.
#[track_caller]
pub fn so3_exp(w: &Tensor) -> Tensor {
    let called = function("so3_exp");
    match expect_width(&called, "rotation vectors", w, 3) {
        Ok(()) => rotation(w, &series(&(w * w).sum_channels(), &[1, 2])),
        Err(bad) => bad,
    }
}

/// `I + A W + B W^2`, with A and B the first two channels of `coefficients`.
#[track_caller]
fn rotation(w: &Tensor, coefficients: &Tensor) -> Tensor {
    let hat = w.pick(&[0, 2, 1, 2, 0, 0, 1, 0, 0]) * Tensor::constant(&[0., -1., 1., 1., 0., -1., -1., 1., 0.]);
    // W^2 = w w^T - theta^2 I: the diagonal is minus the squares of the other two components.
    let square = w * w;
    let diagonal = (square.pick(&[1, 0, 0]) + square.pick(&[2, 2, 1])) * -1.0;
    let product = w * w.pick(&[1, 2, 0]);
    let hat2 = concat([&diagonal, &product]).pick(&[0, 3, 5, 3, 1, 4, 5, 4, 2]);
    let turned = coefficients.slice(0..1) * hat + coefficients.slice(1..2) * hat2;
    turned.reshape((3, 3)) + identity(3)
}

/// Pose `[R | V u]`, `(3, 4)`, of a twist `(w, u)`: three rotation channels, of at most 5 radians
/// ([`so3_exp`]), then three of translation.
#[track_caller]
pub fn se3_exp(twist: &Tensor) -> Tensor {
    let called = function("se3_exp");
    if let Err(bad) = expect_width(&called, "twists", twist, 6) {
        return bad;
    }
    let (w, u) = (twist.slice(0..3), twist.slice(3..6));
    let coefficients = series(&(&w * &w).sum_channels(), &[1, 2, 3]);
    let once = cross(&w, &u);
    let twice = cross(&w, &once);
    let offset = u + coefficients.slice(1..2) * once + coefficients.slice(2..3) * twice;
    join_affine(&rotation(&w, &coefficients), &offset)
}

/// Rotation `(2, 2)` by an angle: `[[cos, -sin], [sin, cos]]`.
#[track_caller]
pub fn so2_exp(angle: &Tensor) -> Tensor {
    let called = function("so2_exp");
    match expect_width(&called, "angles", angle, 1) {
        Ok(()) => turn(&angle.cos(), &angle.sin()),
        Err(bad) => bad,
    }
}

/// `[[c, -s], [s, c]]`.
#[track_caller]
fn turn(c: &Tensor, s: &Tensor) -> Tensor {
    concat([c, s, &-s]).pick_as(&[0, 2, 1, 0], (2, 2))
}

/// Rigid motion `[R | V u]`, `(2, 3)`, of `(u_x, u_y, theta)`, with `V = [[A, -B], [B, A]]`, `A = sin(theta) / theta`
/// and `B = (1 - cos(theta)) / theta`, good for `|theta| < 5`.
#[track_caller]
pub fn se2_exp(motion: &Tensor) -> Tensor {
    let called = function("se2_exp");
    if let Err(bad) = expect_width(&called, "rigid motions", motion, 3) {
        return bad;
    }
    let (u, theta) = (motion.slice(0..2), motion.slice(2..3));
    let coefficients = series(&(&theta * &theta), &[1, 2]);
    let v = turn(&coefficients.slice(0..1), &(coefficients.slice(1..2) * &theta));
    join_affine(&turn(&theta.cos(), &theta.sin()), &apply(&v, &u))
}

/// Homography `(3, 3)` of eight channels: `expm [[h5, h3, h1], [h4, -h5 - h6, h2], [h7, h8, h6]]`, of determinant 1.
#[track_caller]
pub fn sl3_exp(h: &Tensor) -> Tensor {
    let called = function("sl3_exp");
    if let Err(bad) = expect_width(&called, "homography vectors", h, 8) {
        return bad;
    }
    let middle = -(h.slice(4..5) + h.slice(5..6));
    expm(&concat([h, &middle]).pick_as(&[4, 2, 0, 3, 8, 1, 6, 7, 5], (3, 3)))
}

/// Halvings before the polynomial, undone by as many squarings.
const HALVINGS: i32 = 2;

/// Matrix exponential of a small matrix: the Taylor polynomial of degree 12 of a quarter of it, squared twice. The
/// truncation error is below 1e-13 for matrices of norm 2.
///
/// The polynomial is evaluated in powers of `A^3` (Paterson and Stockmeyer, On the number of nonscalar multiplications
/// necessary to evaluate polynomials, 1973): seven products in all.
#[track_caller]
pub fn expm(a: &Tensor) -> Tensor {
    let called = function("expm");
    let crate::graph::Channels::Matrix(n, _) = a.channels() else {
        return called.misfit(&[a], format!("channels {} are no matrix", a.channels()), "reshape them to (n, n)");
    };
    let one = identity(n);
    let a1 = a * 0.5f64.powi(HALVINGS);
    let a2 = matmul(&a1, &a1);
    let a3 = matmul(&a2, &a1);
    let mut sum = &a3 * (1.0 / factorial(12));
    for block in (0..4).rev() {
        if block < 3 {
            sum = matmul(&sum, &a3);
        }
        let c = |i: usize| 1.0 / factorial(3 * block + i);
        sum = sum + &one * c(0) + &a1 * c(1) + &a2 * c(2);
    }
    for _ in 0..HALVINGS {
        sum = matmul(&sum, &sum);
    }
    sum
}
