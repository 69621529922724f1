//! Volume rendering along rays (Mildenhall et al., NeRF, ECCV 2020, equation 3) and its depth samples.
//!
//! ```text
//! delta_i = depth_(i+1) - depth_i, the last one 1e10     a_i = density_i delta_i |d|
//! alpha_i = 1 - exp(-a_i)    T_i = exp(-sum_(j<i) a_j)    weight_i = T_i alpha_i
//! color = sum weight_i c_i   depth = sum weight_i depth_i  opacity = sum weight_i
//! ```
//!
//! `|d|` is the length of the ray's direction, of which depths are multiples. The exponents stay apart: a product of the last
//! interval with `exp(-a)` is taken only after the exponential, so neither pass meets infinity minus infinity.

use super::expect_width;
use crate::graph::{Axis, Tensor, function};

/// Length of the interval behind the last sample.
pub const LAST_INTERVAL: f64 = 1e10;

/// How the depths of a ray's samples are spread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spread {
    /// Evenly in depth.
    Metric,
    /// Evenly in inverse depth: `near` and `far` are inverse depths.
    Inverse,
}

impl Spread {
    /// The depth at `value`, which goes evenly from near to far: `value` itself, or the inverse of it plus 1e-8.
    #[track_caller]
    pub fn depth(self, value: &Tensor) -> Tensor {
        match self {
            Spread::Metric => value.clone(),
            Spread::Inverse => 1.0 / (value + 1e-8),
        }
    }
}

/// What a ray sees.
#[derive(Clone, Debug)]
pub struct Composite {
    pub color: Tensor,
    /// Expected depth, not divided by the opacity.
    pub depth: Tensor,
    pub opacity: Tensor,
    /// Of every sample, along `sample` too.
    pub weights: Tensor,
}

/// Depths of the samples of a ray: `near + (i + jitter) / S (far - near)`, or the inverse of that plus 1e-8. `jitter` is
/// uniform in 0..1, or 0.5 for the middle of every interval.
#[track_caller]
pub fn depth_samples(sample: &Axis, jitter: &Tensor, near: &Tensor, far: &Tensor, spread: Spread) -> Tensor {
    let _called = function("depth_samples");
    let share = (Tensor::index(sample).to_f32() + jitter) * (1.0 / sample.size() as f64);
    spread.depth(&(near + share * (far - near)))
}

/// Renders samples along the axis `sample`: `color` (any number of channels), `density` and `depth` (one channel each, the
/// depths increasing), and the `length` of the ray's direction.
#[track_caller]
pub fn composite(color: &Tensor, density: &Tensor, depth: &Tensor, length: &Tensor, sample: &Axis) -> Composite {
    composite_above(0.0, color, density, depth, length, sample)
}

/// The same for rays that end at the first sample that less than the share `least` of the light reaches: those behind it weigh
/// nothing, and a GPU that follows a whole ray leaves them out. No channel of a colour between 0 and 1 changes by more than
/// `least`, nor does the opacity.
#[track_caller]
pub fn composite_above(
    least: f64,
    color: &Tensor,
    density: &Tensor,
    depth: &Tensor,
    length: &Tensor,
    sample: &Axis,
) -> Composite {
    let called = function("composite");
    for (what, t) in [("densities", density), ("depths", depth), ("lengths", length)] {
        if let Err(bad) = expect_width(&called, what, t, 1) {
            return Composite { color: bad.clone(), depth: bad.clone(), opacity: bad.clone(), weights: bad };
        }
    }
    let last = Tensor::index(sample).equal(&Tensor::integers(&[sample.size() as u32 - 1]));
    let interval = last.select(&Tensor::scalar(LAST_INTERVAL), &(depth.shift(sample, -1) - depth));
    let absorbed = density * interval * length;
    let alpha = 1.0 - (-&absorbed).exp();
    // What is absorbed in the last interval lies behind every sample.
    let before = last.select(&Tensor::scalar(0.0), &absorbed).cumsum(sample);
    let light = (-before).exp();
    let mut weights = &light * alpha;
    if least > 0.0 {
        // How many samples before this one were already dark.
        let dark = light.less_than(&Tensor::scalar(least)).to_f32().cumsum(sample);
        weights = Tensor::scalar(0.0).less_than(&dark).select(&Tensor::scalar(0.0), &weights);
    }
    let along = |t: &Tensor| (&weights * t).sum(&[sample]);
    Composite { color: along(color), depth: along(depth), opacity: weights.sum(&[sample]), weights }
}
