//! Homography between point sets by the direct linear transform (Hartley and Zisserman, Multiple View Geometry, alg. 4.2).
//!
//! Both sets are normalised: centroid to the origin, mean distance to `sqrt(2)`. A correspondence (x1, y1) -> (x2, y2)
//! gives two rows of A; with `p = (x1, y1, 1)` they are `[0, -p, y2 p]` and `[p, 0, -x2 p]`, so
//!
//! ```text
//!           | S(1)    0      -S(x2)      |
//! A^T A  =  | 0       S(1)   -S(y2)      |      S(c) = sum over the points of c p p^T, symmetric (3, 3)
//!           | -S(x2)  -S(y2)  S(x2^2+y2^2) |
//! ```
//!
//! and 24 sums make the 9 x 9 matrix. With few or exact correspondences it is nearly singular: solve it in f64.

use super::expect_width;
use super::matrix::{identity, matmul, solve_symmetric};
use crate::graph::{Axes, Tensor, function};
use crate::ops::pick::concat;

/// How the homography follows from `G = A^T A`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Solver {
    /// The eigenvector of the smallest eigenvalue ("svd"): the least squares solution of unit norm.
    Eigen,
    /// `G h = (1, .., 1)` ("lu"): one step of inverse iteration, what the released L2G-NeRF uses.
    InverseIteration,
}

/// Keeps the scale finite, and how small `H_33` may be to divide by it.
const EPSILON: f64 = 1e-8;

/// The homography `(3, 3)` with `H_33 = 1` that takes points `x` to `y`, both of two channels, along `over`.
///
/// `degenerate` (`u32`, one channel, without the axes `over`) marks fits to leave out: where it is 1 the result is the
/// identity, and neither value nor gradient sees the points. Two identical point sets are such a case.
#[track_caller]
pub fn fit_homography(x: &Tensor, y: &Tensor, over: &Axes, solver: Solver, degenerate: Option<&Tensor>) -> Tensor {
    let called = function("fit_homography");
    for t in [x, y] {
        if let Err(bad) = expect_width(&called, "points", t, 2) {
            return bad;
        }
    }
    let (x, y) = (x.broadcast_to(over), y.broadcast_to(over));
    let (x1, to1) = normalise(&x, over);
    let (x2, to2) = normalise(&y, over);
    let mut g = normal_matrix(&x1, &x2, over);
    if let Some(mask) = degenerate {
        // A system with distinct eigenvalues whose solution has H_33 = 1.
        let dummy: Vec<f64> = (0..81).map(|i| if i / 9 == i % 9 { 9.0 - (i / 9) as f64 } else { 0.0 }).collect();
        g = mask.select(&Tensor::constant_matrix(9, 9, &dummy), &g);
    }
    let h = match solver {
        Solver::Eigen => g.sym_eig().1.pick(&[0, 9, 18, 27, 36, 45, 54, 63, 72]),
        Solver::InverseIteration => solve_symmetric(&g, &Tensor::constant(&[1.0; 9])),
    };
    let full = matmul(&matmul(&to2.back, &h.reshape((3, 3))), &to1.forth);
    let corner = full.pick(&[8]);
    let divides = corner.abs().greater_than(&Tensor::scalar(EPSILON));
    let h = &full / divides.select(&corner, &Tensor::scalar(1.0));
    match degenerate {
        Some(mask) => mask.select(&identity(3), &h),
        None => h,
    }
}

/// The map to normalised coordinates and its inverse, `(3, 3)` each.
struct Similarity {
    forth: Tensor,
    back: Tensor,
}

/// Normalised points, and the map that normalises them: `[[s, 0, -s mu_x], [0, s, -s mu_y], [0, 0, 1]]`.
#[track_caller]
fn normalise(points: &Tensor, over: &Axes) -> (Tensor, Similarity) {
    let share = 1.0 / over.elements() as f64;
    let mean = points.sum_over(over) * share;
    let centred = points - &mean;
    let distance = (&centred * &centred).sum_channels().sqrt().sum_over(over) * share;
    let scale = std::f64::consts::SQRT_2 / (&distance + EPSILON);
    let inverse = (distance + EPSILON) * std::f64::consts::FRAC_1_SQRT_2;
    let constants = Tensor::constant(&[0.0, 1.0]);
    let offset = -(&scale * &mean);
    const LAYOUT: [usize; 9] = [0, 3, 1, 3, 0, 2, 3, 3, 4];
    let forth = concat([&scale, &offset, &constants]).pick_as(&LAYOUT, (3, 3));
    let back = concat([&inverse, &mean, &constants]).pick_as(&LAYOUT, (3, 3));
    (centred * scale, Similarity { forth, back })
}

/// `A^T A`, `(9, 9)`.
#[track_caller]
fn normal_matrix(x1: &Tensor, x2: &Tensor, over: &Axes) -> Tensor {
    let one = Tensor::scalar(1.0);
    let p = concat([x1, &one]);
    // Upper triangle of p p^T: xx xy x yy y 1.
    let moments = p.pick(&[0, 0, 0, 1, 1, 2]) * p.pick(&[0, 1, 2, 1, 2, 2]);
    let weights = concat([&one, x2, &(x2 * x2).sum_channels()]);
    let entries: Vec<usize> = (0..24).map(|i| i % 6).collect();
    let factors: Vec<usize> = (0..24).map(|i| i / 6).collect();
    let sums = (moments.pick(&entries) * weights.pick(&factors)).sum_over(over);
    let zero = Tensor::scalar(0.0);
    let all = concat([&sums, &zero]);
    // Which of the four sums a block is (none: zero), and its sign.
    const BLOCKS: [[(usize, f64); 3]; 3] = {
        const NONE: (usize, f64) = (4, 0.0);
        [[(0, 1.0), NONE, (1, -1.0)], [NONE, (0, 1.0), (2, -1.0)], [(1, -1.0), (2, -1.0), (3, 1.0)]]
    };
    const TRIANGLE: [[usize; 3]; 3] = [[0, 1, 2], [1, 3, 4], [2, 4, 5]];
    let place = |i: usize| {
        let ((row, column), block) = ((i / 9, i % 9), BLOCKS[i / 27][i % 9 / 3]);
        if block.0 == 4 { (24, 1.0) } else { (6 * block.0 + TRIANGLE[row % 3][column % 3], block.1) }
    };
    let order: Vec<usize> = (0..81).map(|i| place(i).0).collect();
    let signs: Vec<f64> = (0..81).map(|i| place(i).1).collect();
    all.pick_as(&order, (9, 9)) * Tensor::constant_matrix(9, 9, &signs)
}
