//! Adam on field and warp, and the values of one step that the host sets: learning rates, Adam's bias corrections, progress,
//! step number.
//!
//! lr(it) = lr (lr_end / lr)^(it / T); progress is it / T, the state the step before left. The warp's rate is multiplied by
//! min(1, it / `warmup_pose`): a field that knows nothing yet would only push the poses apart. (The published L2G code warms
//! up the codes alone; here it is the whole warp.)

use super::loss_scale::LossScale;
use crate::config::{Optim, Precision};
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::{Axis, Shape, Tensor};

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
        let warm = if it < optim.warmup_pose { it as f64 / optim.warmup_pose as f64 } else { 1.0 };
        let (bias1, bias2) = Adam::default().bias_corrections(it as u64 + 1);
        Rates {
            progress,
            lr_field: decayed(optim.lr, optim.lr_end),
            lr_warp: decayed(optim.lr_warp, optim.lr_warp_end) * warm,
            bias1,
            bias2,
        }
    }

    /// Names and values of the inputs they are.
    pub fn inputs(&self) -> [(&'static str, f64); 5] {
        [
            (PROGRESS, self.progress),
            (LR_FIELD, self.lr_field),
            (LR_WARP, self.lr_warp),
            (BIAS1, self.bias1),
            (BIAS2, self.bias2),
        ]
    }
}

/// Inputs with what they become.
type Updates = Vec<(Tensor, Tensor)>;

/// Whether a step of this precision scales its loss: the halves of a GPU (f16) end at 65504, those of the CPU (bfloat16) have
/// the exponents of single precision.
pub fn scales_loss(precision: Precision, target: TargetKind) -> bool {
    precision == Precision::Mixed && target == TargetKind::Gpu
}

/// What an Adam step makes of some parameters and their moments. From a scaled loss also the scale, and a mask that says
/// whether all gradients were finite; where they were not, nothing changes.
fn adam(loss: &Tensor, all: &[(&Tensor, &StepScalars)], scaled: bool) -> (Updates, Option<(LossScale, Tensor)>) {
    let wanted: Vec<&Tensor> = all.iter().map(|(p, _)| *p).collect();
    let scale = scaled.then(LossScale::new);
    let gradients = grad(&scale.as_ref().map_or(loss.clone(), |s| s.scaled(loss)), &wanted);
    let scale = scale.map(|s| (s, LossScale::finite(&gradients)));
    let mut updates = vec![];
    for ((parameter, scalars), gradient) in all.iter().zip(&gradients) {
        let gradient = scale.as_ref().map_or(gradient.clone(), |(s, _)| s.unscaled(gradient));
        let old = Moments::of(parameter);
        let (value, new) = Adam::default().update(parameter, &gradient, &old, scalars);
        updates.extend([((*parameter).clone(), value), (old.m, new.m), (old.v, new.v)]);
    }
    if let Some((_, finite)) = &scale {
        updates.iter_mut().for_each(|(old, new)| *new = finite.select(new, old));
    }
    (updates, scale)
}

/// What an Adam step makes of one parameter and its moments, from a loss that is `scaled` as the last training step would
/// have it.
pub fn update_of(loss: &Tensor, parameter: &Tensor, scalars: &StepScalars, scaled: bool) -> Updates {
    adam(loss, &[(parameter, scalars)], scaled).0
}

/// What an Adam step makes of every trained parameter and its moments; field and warp have learning rates of their own. The
/// loss may be `scaled`.
pub fn updates(total: &Tensor, field: &[Parameter], warp: &[Parameter], scaled: bool) -> Updates {
    let scalar = |name| Tensor::per_step(name, Shape::new(&[], 1));
    let scalars = |lr| StepScalars { lr: scalar(lr), bias1: scalar(BIAS1), bias2: scalar(BIAS2) };
    let (of_field, of_warp) = (scalars(LR_FIELD), scalars(LR_WARP));
    let all: Vec<(&Tensor, &StepScalars)> = (field.iter().map(|p| (p, &of_field)))
        .chain(warp.iter().map(|p| (p, &of_warp)))
        .filter_map(|(p, scalars)| p.trained.then_some((&p.tensor, scalars)))
        .collect();
    let (mut updates, scale) = adam(total, &all, scaled);
    updates.extend(scale.into_iter().flat_map(|(scale, finite)| scale.updates(&finite)));
    updates
}

/// Makes the first frame's row of `parameter` zero after the step: it fixes the gauge. Its moments go on.
pub fn hold_first(updates: &mut [(Tensor, Tensor)], parameter: &Tensor, frame: &Axis) {
    let first = Tensor::index(frame).equal(&Tensor::integers(&[0]));
    for (_, value) in updates.iter_mut().filter(|(input, _)| input.id() == parameter.id()) {
        *value = first.select(&Tensor::scalar(0.0), value);
    }
}
