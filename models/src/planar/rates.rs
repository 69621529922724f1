//! The values of one step that the host sets: learning rates, Adam's bias corrections, progress, step number.
//!
//! lr(it) = lr (lr_end / lr)^(it / T); progress is it / T, the state the step before left.

use crate::config::Optim;
use raygrad_compiler::functions::adam::Adam;

pub const STEP: &str = "step";
pub const PROGRESS: &str = "progress";
pub const LR_FIELD: &str = "lr.field";
pub const LR_WARP: &str = "lr.warp";
pub const BIAS1: &str = "adam.bias1";
pub const BIAS2: &str = "adam.bias2";

/// Values of step `it`, counted from 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    pub progress: f64,
    pub lr_field: f64,
    pub lr_warp: f64,
    pub bias1: f64,
    pub bias2: f64,
}

impl Rates {
    pub fn at(optim: &Optim, it: usize) -> Rates {
        let progress = it as f64 / optim.steps as f64;
        let decayed = |start: f64, end: f64| start * (end / start).powf(progress);
        let (bias1, bias2) = Adam::default().bias_corrections(it as u64 + 1);
        Rates {
            progress,
            lr_field: decayed(optim.lr, optim.lr_end),
            lr_warp: decayed(optim.lr_warp, optim.lr_warp_end),
            bias1,
            bias2,
        }
    }

    /// Names and values of the inputs they are.
    pub fn inputs(&self) -> [(&'static str, f32); 5] {
        [
            (PROGRESS, self.progress as f32),
            (LR_FIELD, self.lr_field as f32),
            (LR_WARP, self.lr_warp as f32),
            (BIAS1, self.bias1 as f32),
            (BIAS2, self.bias2 as f32),
        ]
    }
}
