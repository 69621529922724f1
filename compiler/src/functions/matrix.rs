//! Small matrices in channels: product, identity, application to points.

use crate::graph::{Channels, Tensor};

/// Product of small matrices, `(m, k)` times `(k, n)`, element by element of the axes.
///
/// Each of the `m n k` products is one channel of a pointwise multiplication, then groups of `k` are summed.
#[track_caller]
pub fn matmul(a: &Tensor, b: &Tensor) -> Tensor {
    let (Channels::Matrix(m, k), Channels::Matrix(k2, n)) = (a.channels(), b.channels()) else {
        return Tensor::misfit(
            "matmul",
            &[a, b],
            "both operands must be matrices",
            "reshape the channels to (m, k) and (k, n)",
        );
    };
    if k != k2 {
        return Tensor::misfit(
            "matmul",
            &[a, b],
            format!("{} columns do not meet {} rows", k, k2),
            "the inner sizes must agree; transpose() one of them?",
        );
    }
    let left: Vec<usize> = (0..m * n * k).map(|i| i / (n * k) * k + i % k).collect();
    let right: Vec<usize> = (0..m * n * k).map(|i| i % k * n + i / k % n).collect();
    let groups = (0..m * n).map(|o| ((o * k) as u32..((o + 1) * k) as u32).collect()).collect();
    (a.pick(&left) * b.pick(&right)).channel_groups(groups).reshape((m, n))
}
