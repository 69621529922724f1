//! Hierarchical sampling (Mildenhall et al., NeRF, ECCV 2020, section 5.2): more samples where a first pass over a ray found
//! weight.
//!
//! The range is cut into S equal bins, one a sample of the first pass, with edges `e_0 .. e_S`. F depths invert the cumulative
//! weights:
//!
//! ```text
//! cdf_0 = 0, cdf_i = sum_(j<i) weight_j    u_j = (j + 1/2) / F    n = number of i > 0 with cdf_i <= u_j
//! depth_j = e_n + (u_j - cdf_n) / (weight_n + 1e-8) (e_(n+1) - e_n), or e_S where n = S
//! ```
//!
//! Weights are not divided by their sum: where a ray is not opaque, the u above it all fall on the far end, as in the code
//! published with BARF and L2G-NeRF. Nothing is differentiated through the depths.
//!
//! There is no op that searches or sorts. A place in a list is a count of comparisons with it, over an axis of its own.

use super::composite::Spread;
use super::expect_width;
use crate::graph::{Axis, Tensor, function};

/// Keeps the quotient finite in bins without weight.
const EMPTY: f64 = 1e-8;

/// Depths along `fine` that follow the `weights` along `sample`, whose bins go from `near` to `far` as `spread` says. They do
/// not decrease.
#[track_caller]
pub fn fine_depths(
    weights: &Tensor,
    sample: &Axis,
    fine: &Axis,
    near: &Tensor,
    far: &Tensor,
    spread: Spread,
) -> Tensor {
    let called = function("fine_depths");
    if let Err(bad) = expect_width(&called, "weights", weights, 1) {
        return bad;
    }
    let bins = sample.size() as f64;
    let below = weights.cumsum(sample);
    let u = (Tensor::index(fine).to_f32() + 0.5) * (1.0 / fine.size() as f64);
    // Counted over the inner axis.
    let bin = Axis::new("bin", sample.size());
    let until = (&below + weights).take(&Tensor::index(&bin), sample);
    let n = until.less_equal(&u).to_f32().sum(&[&bin]);
    // Behind the last bin `take` reads the last one.
    let of_bin = |t: &Tensor| t.take(&n.to_u32(), sample);
    let within = (&u - of_bin(&below)) / (of_bin(weights) + EMPTY);
    let behind = n.greater_equal(&Tensor::scalar(bins));
    let place = behind.select(&Tensor::scalar(bins), &(&n + within)) * (1.0 / bins);
    spread.depth(&(near + place * (far - near))).stop_gradient()
}

/// The depths along `sample` and those along `fine` in one list along `merged`, in ascending order; of equal ones, those
/// along `sample` come first. Nothing is differentiated through it.
#[track_caller]
pub fn merge_depths(depth: &Tensor, sample: &Axis, more: &Tensor, fine: &Axis, merged: &Axis) -> Tensor {
    let called = function("merge_depths");
    let (s, f) = (sample.size(), fine.size());
    if merged.size() != s + f {
        let problem = format!("{s} and {f} depths in a list of {}", merged.size());
        return called.misfit(&[depth, more], problem, format!("a list of {} would fit", s + f));
    }
    let entry = Axis::new("entry", s + f);
    let other = Axis::new("other", s + f);
    let at = Tensor::index(&entry);
    let first = at.less_than(&Tensor::integers(&[s as u32]));
    let rest = first.select(&Tensor::integers(&[0]), &at.wrapping_add(&Tensor::integers(&[(s as u32).wrapping_neg()])));
    let value = first.select(&depth.take(&at, sample), &more.take(&rest, fine)).stop_gradient();
    let (another, another_at) = (value.take(&Tensor::index(&other), &entry), Tensor::index(&other));
    let tie = another.equal(&value).bit_and(&another_at.less_than(&at));
    let rank = another.less_than(&value).bit_or(&tie).to_f32().sum(&[&other]);
    let here = rank.equal(&Tensor::index(merged).to_f32());
    here.select(&value, &Tensor::scalar(0.0)).sum(&[&entry]).stop_gradient()
}
