//! Losses.

use crate::graph::Tensor;

/// Mean of the squared differences over all axes and channels.
#[track_caller]
pub fn mean_squared_error(a: &Tensor, b: &Tensor) -> Tensor {
    let difference = a - b;
    (&difference * &difference).mean_all()
}
