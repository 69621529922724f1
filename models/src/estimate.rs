//! How long a run should take, told before it begins: a few steps and parts of its evaluation are tried on the device, and
//! everything goes back to where it was.

use crate::Error;
use crate::config::Settings;
use crate::report::median;
use crate::run::checkpoint::Checkpoint;
use crate::training::Training;
use std::time::Instant;

/// Runs of fewer steps are not timed before they begin.
const TRIED: usize = 50;
/// Steps that are timed, or fewer if they take longer than so many seconds.
const TIMED: usize = 5;
const TRIAL: f64 = 1.0;

/// What a run should take, in seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The steps that are left, with the frames of the animation and whatever else is done between steps.
    pub training: f64,
    /// Measuring the model after the last step.
    pub evaluation: f64,
}

/// What the parts of a run beside its steps take, in seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// What is done every so many steps (never where that is 0), and what it takes once.
    pub recurring: Vec<(usize, f64)>,
    /// All of the evaluation.
    pub evaluation: f64,
}

impl Estimate {
    /// What is left of a run; nothing where that are a few steps only.
    pub fn of(trainer: &mut dyn Training, settings: &Settings) -> Result<Option<Estimate>, Error> {
        let (step, steps) = (trainer.steps_done(), settings.optim.taken());
        let left = steps.saturating_sub(step);
        if left < TRIED {
            return Ok(None);
        }
        let begun = Checkpoint { step, seconds: 0.0, steps: vec![], tensors: trainer.tensors()? };
        let one = seconds_per_step(trainer)?;
        let trial = trainer.trial()?;
        trainer.restore(&begun)?;
        let recurring = trial.recurring.iter().filter(|(every, _)| *every > 0);
        let recurring = recurring.map(|(every, once)| (steps / every - step / every) as f64 * once);
        let training = one * left as f64 + recurring.sum::<f64>();
        Ok(Some(Estimate { training, evaluation: trial.evaluation }))
    }

    pub fn total(&self) -> f64 {
        self.training + self.evaluation
    }
}

fn seconds_per_step(trainer: &mut dyn Training) -> Result<f64, Error> {
    let mut one = || {
        timed(|| {
            trainer.step()?;
            trainer.wait()
        })
    };
    // The first one warms up.
    one()?;
    let mut times = vec![];
    while times.len() < TIMED && times.iter().sum::<f64>() < TRIAL {
        times.push(one()?);
    }
    Ok(median(&times))
}

/// Seconds of some work.
pub(crate) fn timed(work: impl FnOnce() -> Result<(), Error>) -> Result<f64, Error> {
    let start = Instant::now();
    work()?;
    Ok(start.elapsed().as_secs_f64())
}
