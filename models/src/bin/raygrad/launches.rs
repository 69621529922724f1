//! The launches of a training step by the device's clock: what `bench` and `explain` measure.

use raygrad::Experiment;
use raygrad::config::Count;
use raygrad::report::median;
use raygrad::training::Training;

/// Steps that are done before any is timed.
const WARM_UP: usize = 3;
/// Steps whose launches are timed.
const PROFILED: usize = 7;

/// The training of an experiment, for its steps alone.
pub fn training(experiment: &mut Experiment) -> Result<Box<dyn Training>, raygrad::Error> {
    if let Some(scene) = &mut experiment.layered.settings.scene {
        // A step needs the training views alone.
        (scene.val_views, scene.test_views) = (Count::Of(0), Count::Of(0));
    }
    experiment.training()
}

/// Does the steps before those that are timed.
pub fn warm_up(trainer: &mut dyn Training) -> Result<(), raygrad::Error> {
    for _ in 0..WARM_UP {
        trainer.step()?;
        trainer.wait()?;
    }
    Ok(())
}

/// Seconds of every launch of some steps.
pub fn profile(trainer: &mut dyn Training) -> anyhow::Result<Vec<Vec<f64>>> {
    let program = trainer.training_program();
    let learner = trainer.learner_mut();
    let mut steps = vec![];
    // The first one may have to make what reads the clock.
    for _ in 0..=PROFILED {
        match learner.profile(program)? {
            Some(seconds) => steps.push(seconds),
            None => anyhow::bail!("{} has no clock for launches", learner.device_name()),
        }
    }
    steps.remove(0);
    Ok(steps)
}

/// Of every launch the median over steps.
pub fn medians(profiled: &[Vec<f64>]) -> Vec<f64> {
    let launches = profiled.first().map_or(0, Vec::len);
    (0..launches).map(|i| median(&profiled.iter().map(|step| step[i]).collect::<Vec<_>>())).collect()
}
