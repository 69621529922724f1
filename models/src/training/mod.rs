//! What every experiment's training has in common: the optimiser as a graph, a device with programs and their inputs, and
//! what a run asks of it.

pub mod learner;
pub(crate) mod loss_scale;
pub mod optimise;
mod watch;

pub use learner::Learner;
pub use optimise::Rates;
pub use watch::Watch;

use crate::Error;
use crate::config::Layered;
use crate::estimate::Trial;
use crate::evaluation::Evaluation;
use crate::run::checkpoint::Checkpoint;
use crate::run::metrics::{Entry, Final, Metrics};
use crate::run::{RunFolder, checkpoint::Saved};
use raygrad_runtime::ProgramId;
use std::collections::BTreeMap;

/// Whether something that happens every `period` steps does so after `done`; never at 0.
pub fn due(period: usize, done: usize) -> bool {
    period > 0 && done.is_multiple_of(period)
}

/// An experiment in training, as a run sees it.
pub trait Training {
    fn learner(&self) -> &Learner;
    fn learner_mut(&mut self) -> &mut Learner;

    /// The program of a training step.
    fn training_program(&self) -> ProgramId;

    /// One training step. On a GPU this only submits it.
    fn step(&mut self) -> Result<(), Error> {
        let program = self.training_program();
        self.learner_mut().train(program)
    }

    /// Takes the averages where `optim.average` has kept some. To be called when nothing is trained any more.
    fn settle(&mut self) -> Result<(), Error> {
        self.learner_mut().take_averages().map(drop)
    }

    /// Losses and errors of the last step, as its forward pass saw them.
    fn measure(&mut self) -> Result<Entry, Error>;

    /// Floating-point operations of a step: six a weight and row of every network.
    fn flops(&self) -> f64;

    /// Launches of a step.
    fn launches(&self) -> usize {
        self.learner().program(self.training_program()).launches.len()
    }

    /// Points of a patch, or rays, in one step.
    fn rows(&self) -> usize;

    /// The same for people: "448 points a patch".
    fn work(&self) -> String;

    /// Writes what the run learns from, before it begins.
    fn write_data(&self, folder: &RunFolder) -> Result<(), Error>;

    /// Writes one frame of the animation.
    fn write_frame(&mut self, folder: &RunFolder) -> Result<(), Error>;

    /// Measures the model as it is and writes what it finds, `evaluation.json` first of all. `watch` hears how many of how
    /// many views are done, and may stop it.
    fn write_evaluation(&mut self, folder: &RunFolder, watch: Watch) -> Result<Evaluation, Error>;

    /// Measures everything at the end of the last step into `metrics`, with the `seconds` that training took, and writes the
    /// results, unless `watch` stops it before.
    fn finish(
        &mut self,
        folder: &RunFolder,
        layered: &Layered,
        metrics: &mut Metrics,
        seconds: &dyn Fn() -> f64,
        watch: Watch,
    ) -> Result<(), Error>;

    /// Times parts of an evaluation. Parameters and states may change.
    fn trial(&mut self) -> Result<Trial, Error>;

    /// What had to be assumed of the data, a sentence each.
    fn notes(&self) -> &[String] {
        &[]
    }

    /// The headline numbers as lines of text.
    fn summary(&self, last: &Final) -> String;

    /// Waits until the last step is done.
    fn wait(&mut self) -> Result<(), Error> {
        let program = self.training_program();
        self.learner_mut().read(program, "total")?;
        Ok(())
    }

    fn steps_done(&self) -> usize {
        self.learner().steps_done()
    }

    /// Everything that carries over to the next step.
    fn tensors(&mut self) -> Result<BTreeMap<String, Saved>, Error> {
        self.learner_mut().tensors()
    }

    /// Continues from a checkpoint, whose shapes have been checked.
    fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), Error> {
        self.learner_mut().restore(checkpoint)
    }
}
