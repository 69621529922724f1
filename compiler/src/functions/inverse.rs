//! Determinants, inverses and solutions of square systems of up to four unknowns.
//!
//! By minors: no pivots, so no choices, and every element of the axes takes the same steps. For symmetric positive matrices and
//! more unknowns see [`solve_symmetric`](super::matrix::solve_symmetric).

use super::matrix::{apply, matmul};
use crate::graph::{Called, Channels, Tensor, function};
use crate::ops::custom::custom_adjoint;

/// Most rows: the number of minors grows like `4^n`.
const MOST: usize = 4;

/// Determinant of a matrix `(n, n)`, n at most 4; 1 channel.
#[track_caller]
pub fn determinant(a: &Tensor) -> Tensor {
    let called = function("determinant");
    match square(a, &called) {
        Ok(n) => minors(a, n, &[((0..n).collect(), (0..n).collect())]),
        Err(bad) => bad,
    }
}

/// Inverse of a matrix `(n, n)`, n at most 4: infinite or NaN where it is singular. The gradient is that of the inverse B
/// itself, `-B^T g B^T`.
#[track_caller]
pub fn inverse(a: &Tensor) -> Tensor {
    let called = function("inverse");
    let n = match square(a, &called) {
        Ok(n) => n,
        Err(bad) => return bad,
    };
    // Divided by its largest entry, a matrix has minors in the range of single precision.
    let scale = a.abs().max_channels();
    let unit = a / &scale;
    let without = |at: usize| (0..n).filter(|i| *i != at).collect::<Vec<_>>();
    // Entry (i, j) of the adjugate is the minor without row j and column i, with the sign of its place.
    let blocks: Vec<Block> = (0..n * n).map(|e| (without(e % n), without(e / n))).collect();
    let signs: Vec<f64> = (0..n * n).map(|e| if (e / n + e % n).is_multiple_of(2) { 1.0 } else { -1.0 }).collect();
    let adjugate = if n == 1 { Tensor::scalar(1.0) } else { minors(&unit, n, &blocks) * Tensor::constant(&signs) };
    let first_row: Vec<usize> = (0..n).collect();
    let first_column: Vec<usize> = (0..n).map(|i| i * n).collect();
    let determinant = (unit.pick(&first_row) * adjugate.pick(&first_column)).sum_channels();
    let value = (adjugate / determinant / scale).reshape((n, n));
    custom_adjoint(&value, &[a], |inputs, grad| {
        let back = inverse(&inputs[0]).transpose();
        vec![Some(-matmul(&matmul(&back, grad), &back))]
    })
}

/// `A^-1 b` of a matrix `(n, n)`, n at most 4, and n channels.
#[track_caller]
pub fn solve(a: &Tensor, b: &Tensor) -> Tensor {
    let called = function("solve");
    match square(a, &called) {
        Ok(n) if b.width() == n => apply(&inverse(a), b),
        Ok(n) => {
            let problem = format!("a matrix {} and a right side of {} channels", a.channels(), b.channels());
            called.misfit(&[a, b], problem, format!("the right side has {n} channels"))
        }
        Err(bad) => bad,
    }
}

/// Rows of a square matrix that is small enough.
#[track_caller]
fn square(a: &Tensor, called: &Called) -> Result<usize, Tensor> {
    match a.channels() {
        Channels::Matrix(r, c) if r == c && r <= MOST => Ok(r),
        other => {
            let problem = format!("channels {other} are no square matrix of at most {MOST} rows");
            let hint = match other {
                Channels::Matrix(r, c) if r == c => "solve_symmetric takes symmetric ones of up to 9 rows",
                Channels::Matrix(..) => "a matrix (n, n) would fit",
                Channels::Vector(_) => "reshape the channels to (n, n)",
            };
            Err(called.misfit(&[a], problem, hint))
        }
    }
}

/// Rows and columns of a matrix, equally many.
type Block = (Vec<usize>, Vec<usize>);

/// Determinants of blocks of one size of a matrix `(n, n)`, a channel each, expanded along their first rows.
#[track_caller]
fn minors(a: &Tensor, n: usize, blocks: &[Block]) -> Tensor {
    let size = blocks[0].0.len();
    let entries = |term: usize| blocks.iter().map(|(r, c)| r[0] * n + c[term]).collect::<Vec<_>>();
    if size == 1 {
        return a.pick(&entries(0));
    }
    let mut smaller: Vec<Block> = vec![];
    let mut rest = |(rows, columns): &Block, term: usize| {
        let mut columns = columns.clone();
        columns.remove(term);
        let block = (rows[1..].to_vec(), columns);
        smaller.iter().position(|b| *b == block).unwrap_or_else(|| {
            smaller.push(block);
            smaller.len() - 1
        })
    };
    let places: Vec<Vec<usize>> = (0..size).map(|term| blocks.iter().map(|b| rest(b, term)).collect()).collect();
    let below = minors(a, n, &smaller);
    let mut sum = a.pick(&entries(0)) * below.pick(&places[0]);
    for (term, place) in places.iter().enumerate().skip(1) {
        let product = a.pick(&entries(term)) * below.pick(place);
        sum = if term.is_multiple_of(2) { sum + product } else { sum - product };
    }
    sum
}
