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
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Axis, Shape, Tensor};

pub const STEP: &str = "step";
pub const PROGRESS: &str = "progress";
pub const LR_FIELD: &str = "lr.field";
pub const LR_WARP: &str = "lr.warp";
pub const BIAS1: &str = "adam.bias1";
pub const BIAS2: &str = "adam.bias2";
/// How fast the averages follow what is trained.
pub const AVERAGE: &str = "average";
/// How the average of a parameter is called: this and its name.
pub const AVERAGE_OF: &str = "average.";

/// Values of step `it`, counted from 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    pub progress: f64,
    pub lr_field: f64,
    pub lr_warp: f64,
    pub bias1: f64,
    pub bias2: f64,
    pub average: f64,
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
            // A mean of all steps so far, until they are as many as it is to remember; of a short run, not of its beginning.
            average: 1.0 / (it + 1).min(optim.average.min(optim.steps / 3).max(1)) as f64,
        }
    }

    /// Names and values of the inputs they are.
    pub fn inputs(&self) -> [(&'static str, f64); 6] {
        [
            (PROGRESS, self.progress),
            (LR_FIELD, self.lr_field),
            (LR_WARP, self.lr_warp),
            (BIAS1, self.bias1),
            (BIAS2, self.bias2),
            (AVERAGE, self.average),
        ]
    }
}

/// Inputs with what they become.
pub type Updates = Vec<(Tensor, Tensor)>;

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

/// What a step trains, and how.
pub struct Training<'a> {
    pub field: &'a [Parameter],
    /// What has the learning rate of warps.
    pub warp: &'a [Parameter],
    /// A parameter whose element 0 along an axis is zero after every step: it fixes the gauge. Its moments go on.
    pub held: Option<(&'a Tensor, &'a Axis)>,
    pub optim: &'a Optim,
    /// Whether the loss is scaled.
    pub scaled: bool,
}

impl Training<'_> {
    /// What an Adam step on the loss `total` makes of every trained parameter, its moments and its average.
    pub fn updates(&self, total: &Tensor) -> Updates {
        let scalar = |name| Tensor::per_step(name, Shape::new(&[], 1));
        let scalars = |lr| StepScalars { lr: scalar(lr), bias1: scalar(BIAS1), bias2: scalar(BIAS2) };
        let (of_field, of_warp) = (scalars(LR_FIELD), scalars(LR_WARP));
        let all: Vec<(&Tensor, &StepScalars)> = (self.field.iter().map(|p| (p, &of_field)))
            .chain(self.warp.iter().map(|p| (p, &of_warp)))
            .filter_map(|(p, scalars)| p.trained.then_some((&p.tensor, scalars)))
            .collect();
        let (mut updates, scale) = adam(total, &all, self.scaled);
        updates.extend(scale.into_iter().flat_map(|(scale, finite)| scale.updates(&finite)));
        if let Some((parameter, axis)) = self.held {
            let first = Tensor::index(axis).equal(&Tensor::integers(&[0]));
            for (_, value) in updates.iter_mut().filter(|(input, _)| input.id() == parameter.id()) {
                *value = first.select(&Tensor::scalar(0.0), value);
            }
        }
        updates.extend(self.averages(&updates));
        updates
    }

    /// Averages of all that is trained, where `optim.average` asks for them: states [`AVERAGE_OF`] the parameters' names, which
    /// follow the values that `updates` gives these (Polyak and Juditsky 1992; here exponential).
    fn averages(&self, updates: &Updates) -> Updates {
        if self.optim.average == 0 {
            return vec![];
        }
        let rate = Tensor::per_step(AVERAGE, Shape::new(&[], 1));
        let of = |(input, value): &(Tensor, Tensor)| {
            let parameter = self.field.iter().chain(self.warp).find(|p| p.tensor.id() == input.id())?;
            let name = format!("{AVERAGE_OF}{}", parameter.tensor.input_name()?);
            let average = Tensor::input(name, Role::State, input.shape().clone());
            let follows = &average + (value - &average) * &rate;
            Some((average, follows))
        };
        updates.iter().filter_map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Layered;
    use raygrad_compiler::{Step, compile};
    use raygrad_runtime::{Device, Session};

    /// The mean of all steps while they are few, then one that forgets; of a parameter that is held, of what is held.
    #[test]
    fn averages_follow_what_is_trained() {
        let frame = Axis::new("frame", 2);
        let parameter = |name: &str, trained| Parameter {
            tensor: Tensor::parameter(name, Shape::new(&[&frame], 1)),
            init: raygrad_compiler::functions::mlp::Init::Zero,
            trained,
        };
        let all = [parameter("p", true), parameter("still", false)];
        let slope = Tensor::per_step("slope", Shape::new(&[], 1));
        let loss = ((&all[0].tensor + &all[1].tensor) * slope).sum(&[&frame]);
        let optim = Optim { average: 3, ..Layered::load("planar-l2g").unwrap().settings.optim };
        let held = Some((&all[0].tensor, &frame));
        let updates = Training { field: &all, warp: &[], held, optim: &optim, scaled: false }.updates(&loss);
        let device = Device::cpu(Some(1)).unwrap();
        let mut session = Session::new(device.clone()).unwrap();
        let program = session.add(compile(&Step { outputs: vec![], updates }, &device.target()).unwrap()).unwrap();
        assert!(session.inputs().all(|(name, _)| name != "average.still"));
        let mut expected = 0.0;
        for it in 0..8 {
            session.set("slope", &[(it as f32 - 3.5).sin()]).unwrap();
            for (name, value) in Rates::at(&optim, it).inputs() {
                if session.inputs().any(|(n, _)| n == name) {
                    session.set(name, &[value as f32]).unwrap();
                }
            }
            session.run(program).unwrap();
            let (p, average) = (session.get("p").unwrap(), session.get("average.p").unwrap());
            expected += (p[1] - expected) / (it + 1).min(3) as f32;
            assert!(p[1] != 0.0 && (average[1] - expected).abs() < 1e-7, "{it}: {average:?}, {expected}");
            assert_eq!((p[0], average[0]), (0.0, 0.0));
        }
    }
}
