//! Losses between what was computed and what was seen; each is a mean over all axes and channels.

use crate::graph::{Tensor, function};

/// Mean of the squared differences.
#[track_caller]
pub fn mean_squared_error(a: &Tensor, b: &Tensor) -> Tensor {
    let _called = function("mean_squared_error");
    let difference = a - b;
    (&difference * &difference).mean_all()
}

/// Mean of the absolute differences.
#[track_caller]
pub fn mean_absolute_error(a: &Tensor, b: &Tensor) -> Tensor {
    let _called = function("mean_absolute_error");
    (a - b).abs().mean_all()
}

/// Mean of `sqrt((a - b)^2 + epsilon^2)`: absolute differences, smooth where they are below `epsilon` (Charbonnier,
/// Blanc-Feraud, Aubert, Barlaud, Two deterministic half-quadratic regularization algorithms for computed imaging, ICIP 1994).
#[track_caller]
pub fn charbonnier(a: &Tensor, b: &Tensor, epsilon: f64) -> Tensor {
    let called = function("charbonnier");
    // Beyond, the square is no normal number of single precision; NaN is in no range.
    if !(1e-18..=1e18).contains(&epsilon) {
        let hint = "epsilon is a small positive difference, such as 1e-3";
        return called.misfit(&[a, b], format!("epsilon is {epsilon}"), hint);
    }
    let difference = a - b;
    (&difference * &difference + epsilon * epsilon).sqrt().mean_all()
}
