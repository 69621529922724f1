//! Parts of an axis, and axes put one after the other: gathers at positions, whose adjoints sum into them in order.

use crate::graph::{Axis, Called, Tensor, function};

/// Elements `start..start + into.size()` along `axis`, which the new axis `into` replaces.
#[track_caller]
pub fn slice_along(x: &Tensor, axis: &Axis, start: usize, into: &Axis) -> Tensor {
    let called = function("slice_along");
    if let Err(bad) = is_new(&called, &[x], into) {
        return bad;
    }
    if start.checked_add(into.size()).is_none_or(|end| end > axis.size()) {
        let problem = format!("{} elements from {start} on along `{axis}`", into.size());
        let hint = format!("`{}` has elements 0 to {}", axis.name(), axis.size().saturating_sub(1));
        return called.misfit(&[x], problem, hint);
    }
    moved(x, axis, into, start as u32)
}

/// The element at `axis` position `i + by`, modulo 2^32, for every position `i` of `into`.
#[track_caller]
fn moved(x: &Tensor, axis: &Axis, into: &Axis, by: u32) -> Tensor {
    x.take(&Tensor::index(into).wrapping_add(&Tensor::integers(&[by])), axis)
}

/// The parts one after the other along the new axis `into`: each a tensor and the axis of it that `into` replaces.
#[track_caller]
pub fn concat_along(parts: &[(&Tensor, &Axis)], into: &Axis) -> Tensor {
    let called = function("concat_along");
    let tensors: Vec<&Tensor> = parts.iter().map(|p| p.0).collect();
    if let Err(bad) = is_new(&called, &tensors, into) {
        return bad;
    }
    let size: usize = parts.iter().map(|p| p.1.size()).sum();
    let Some(((last, axis), others)) = parts.split_last().filter(|_| size == into.size()) else {
        let problem = format!("{} parts of {size} elements together do not fill `{into}`", parts.len());
        return called.misfit(&tensors, problem, "the new axis has the size of all parts together");
    };
    if let Some(other) = tensors.iter().find(|t| t.channels() != last.channels()) {
        let problem = format!("channels {} and {} do not match", other.channels(), last.channels());
        return called.misfit(&tensors, problem, "all parts have the same channels");
    }
    let index = Tensor::index(into);
    // Positions outside of a part read its last slot, which is not chosen.
    let mut start = (size - axis.size()) as u32;
    let mut joined = moved(last, axis, into, start.wrapping_neg());
    for (t, axis) in others.iter().rev() {
        let here = index.less_than(&Tensor::integers(&[start]));
        start -= axis.size() as u32;
        joined = here.select(&moved(t, axis, into, start.wrapping_neg()), &joined);
    }
    joined
}

/// Refuses an axis that a tensor has already.
#[track_caller]
fn is_new(called: &Called, tensors: &[&Tensor], into: &Axis) -> Result<(), Tensor> {
    match tensors.iter().find(|t| t.axes().contains(into)) {
        None => Ok(()),
        Some(t) => {
            let problem = format!("{} has the axis `{into}` already", t.shape());
            Err(called.misfit(tensors, problem, "make a new axis"))
        }
    }
}
