//! Positional encoding (Mildenhall et al., NeRF, ECCV 2020) with coarse-to-fine weights (Lin et al., BARF, ICCV 2021).
//!
//! ```text
//! gamma(x) = [x_1 .. x_n; for each i: w_k sin(2^k pi x_i) for k = 0 .. L-1, then w_k cos(2^k pi x_i)]
//! w_k = (1 - cos(pi clamp(alpha - k, 0, 1))) / 2,   alpha = L (progress - start) / (end - start)
//! ```
//!
//! The angle is reduced to `-pi..pi` before the sine is taken, in turns, where that is exact: `h = 2^(k-1) x` (a power of
//! two), plus a quarter turn for the cosine, `t = h - floor(h + 1/2)`, `sin(2 pi t)`.

use crate::graph::{Called, Tensor, function};
use crate::ops::pick::concat;
use std::f64::consts::{PI, TAU};

/// Channels of the encoding of `n` channels with `bands` frequencies.
pub fn encoded_width(n: usize, bands: usize) -> usize {
    n + 2 * n * bands
}

/// Encodes every channel of `x`; `weights` are [`coarse_to_fine_weights`], one channel a band. All `2 n L` waves are one
/// run of channels, not a node each.
#[track_caller]
pub fn positional_encoding(x: &Tensor, bands: usize, weights: Option<&Tensor>) -> Tensor {
    let called = function("positional_encoding");
    // Channel 2 L i + j is wave j of dimension i: a sine for j < L, a cosine after that.
    let place = |c: usize| Wave { source: c / (2 * bands), band: c % bands, cosine: c / bands % 2 == 1 };
    encode(&called, x, bands, weights, place)
}

/// The same waves in another order: for each frequency the sines of all channels of `x`, then their cosines.
#[track_caller]
pub fn frequency_encoding(x: &Tensor, bands: usize, weights: Option<&Tensor>) -> Tensor {
    let called = function("frequency_encoding");
    let n = x.width();
    let place = |c: usize| Wave { source: c % n, band: c / (2 * n), cosine: c / n % 2 == 1 };
    encode(&called, x, bands, weights, place)
}

/// What one channel of an encoding holds.
struct Wave {
    /// Channel of the operand.
    source: usize,
    band: usize,
    cosine: bool,
}

#[track_caller]
fn encode(
    called: &Called,
    x: &Tensor,
    bands: usize,
    weights: Option<&Tensor>,
    place: impl Fn(usize) -> Wave,
) -> Tensor {
    if bands == 0 {
        return x.clone();
    }
    let waves: Vec<Wave> = (0..x.width() * 2 * bands).map(place).collect();
    let source: Vec<usize> = waves.iter().map(|w| w.source).collect();
    let band: Vec<usize> = waves.iter().map(|w| w.band).collect();
    let scale: Vec<f64> = band.iter().map(|k| 2f64.powi(*k as i32 - 1)).collect();
    let quarter: Vec<f64> = waves.iter().map(|w| if w.cosine { 0.25 } else { 0.0 }).collect();
    let h = x.pick(&source) * Tensor::constant(&scale) + Tensor::constant(&quarter);
    let t = &h - (&h + 0.5).floor();
    let mut wave = (t * TAU).sin();
    if let Some(w) = weights {
        if let Err(bad) = super::expect_width(called, "band weights", w, bands) {
            return bad;
        }
        wave = wave * w.pick(&band);
    }
    concat([x, &wave])
}

/// Weights of the bands while training progresses from 0 to 1; they open one after the other from `start` to `end`.
#[track_caller]
pub fn coarse_to_fine_weights(progress: &Tensor, bands: usize, start: f64, end: f64) -> Tensor {
    let called = function("coarse_to_fine_weights");
    if end <= start || bands == 0 {
        let problem = format!("{bands} bands opening from {start} to {end}");
        return called.misfit(&[progress], problem, "the window must not be empty");
    }
    let alpha = (progress - start) * (bands as f64 / (end - start));
    let band: Vec<f64> = (0..bands).map(|k| k as f64).collect();
    let open = (alpha - Tensor::constant(&band)).clamp(0.0, 1.0);
    ((1.0 - (open * PI).cos()) * 0.5).stop_gradient()
}
