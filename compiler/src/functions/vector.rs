//! Vectors in channels: products, lengths, directions.
//!
//! Lengths and directions are those of `x / s` with s the largest `|x_i|`: squares of tiny and of huge numbers are out of range.

use crate::graph::{Tensor, function};

/// Inner product over the channels, 1 channel.
#[track_caller]
pub fn dot(a: &Tensor, b: &Tensor) -> Tensor {
    let _called = function("dot");
    (a * b).sum_channels()
}

/// Euclidean length over the channels, 1 channel; its gradient is the direction, and 0 at 0.
#[track_caller]
pub fn norm(x: &Tensor) -> Tensor {
    let _called = function("norm");
    let (scale, x) = scaled(x);
    dot(&x, &x).sqrt() * scale
}

/// The direction `x / |x|`, as many channels; 0 with gradient 0 where `x` is 0.
#[track_caller]
pub fn normalize(x: &Tensor) -> Tensor {
    let _called = function("normalize");
    let (_, x) = scaled(x);
    let length = dot(&x, &x).sqrt();
    let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
    let none = length.equal(&zero);
    none.select(&zero, &(x / none.select(&one, &length)))
}

/// The largest `|x_i|`, or 1 if that is 0, and x divided by it. The scale is no variable: results do not depend on it.
#[track_caller]
fn scaled(x: &Tensor) -> (Tensor, Tensor) {
    let largest = x.abs().max_channels().stop_gradient();
    let scale = largest.equal(&Tensor::scalar(0.0)).select(&Tensor::scalar(1.0), &largest);
    let x = x / &scale;
    (scale, x)
}
