//! A device that fails while a run goes on.

use super::*;
use crate::config::Layered;
use crate::estimate::Trial;
use crate::evaluation::Evaluation;
use crate::run::Final;
use crate::training::{Learner, Watch};
use raygrad_runtime::{ProgramId, RunError};

/// A training whose device is lost at some step.
struct Losing {
    inner: Box<dyn Training>,
    at: usize,
}

impl Training for Losing {
    fn learner(&self) -> &Learner {
        self.inner.learner()
    }
    fn learner_mut(&mut self) -> &mut Learner {
        self.inner.learner_mut()
    }
    fn training_program(&self) -> ProgramId {
        self.inner.training_program()
    }
    fn step(&mut self) -> Result<(), Error> {
        if self.steps_done() + 1 == self.at {
            let (device, problem) = ("a GPU".into(), "the device was lost".into());
            return Err(RunError::Device { device, problem }.into());
        }
        self.inner.step()
    }
    fn measure(&mut self) -> Result<Entry, Error> {
        self.inner.measure()
    }
    fn flops(&self) -> f64 {
        self.inner.flops()
    }
    fn rows(&self) -> usize {
        self.inner.rows()
    }
    fn work(&self) -> String {
        self.inner.work()
    }
    fn write_data(&self, folder: &RunFolder) -> Result<(), Error> {
        self.inner.write_data(folder)
    }
    fn write_frame(&mut self, folder: &RunFolder) -> Result<(), Error> {
        self.inner.write_frame(folder)
    }
    fn write_evaluation(&mut self, folder: &RunFolder, watch: Watch) -> Result<Evaluation, Error> {
        self.inner.write_evaluation(folder, watch)
    }
    fn finish(
        &mut self,
        folder: &RunFolder,
        layered: &Layered,
        metrics: &mut Metrics,
        seconds: &dyn Fn() -> f64,
        watch: Watch,
    ) -> Result<(), Error> {
        self.inner.finish(folder, layered, metrics, seconds, watch)
    }
    fn trial(&mut self) -> Result<Trial, Error> {
        Ok(Trial { recurring: vec![(20, 1e4), (0, 1e9)], evaluation: 7.0 })
    }
    fn summary(&self, last: &Final) -> String {
        self.inner.summary(last)
    }
}

#[test]
fn what_a_run_should_take_has_what_recurs_and_its_evaluation() {
    let mut experiment = Experiment::preset("planar-barf-small").unwrap();
    for set in ["data.image_size=[24,32]", "data.patch_crop=[12,16]", "data.points_per_patch=8", "run.device=cpu"] {
        experiment = experiment.set(set).unwrap();
    }
    let mut of = |steps: usize| {
        experiment.layered.set(&format!("optim.steps={steps}")).unwrap();
        let mut training = Losing { inner: experiment.training().unwrap(), at: usize::MAX };
        Estimate::of(&mut training, &experiment.layered.settings).unwrap()
    };
    // What recurs every twenty steps takes hours.
    let estimate = of(60).unwrap();
    assert_eq!(estimate.evaluation, 7.0);
    assert!(estimate.training > 3e4 && estimate.total() == estimate.training + 7.0, "{estimate:?}");
    let training = of(59).unwrap().training;
    assert!(training > 2e4 && training < 3e4, "{training}");
    assert_eq!(of(20), None);
}

struct Silent;

impl Observer for Silent {}

#[test]
fn a_lost_device_leaves_the_last_checkpoint_and_says_so() {
    let work = tempfile::tempdir().unwrap();
    let out = work.path().join("run");
    let mut experiment = Experiment::preset("planar-barf-small").unwrap();
    for set in ["data.image_size=[24,32]", "data.patch_crop=[12,16]", "data.points_per_patch=8", "field.layers=[8]"] {
        experiment = experiment.set(set).unwrap();
    }
    for set in ["optim.steps=9", "run.log_every=1", "run.checkpoint_every=2", "run.picture_every=0", "run.device=cpu"] {
        experiment = experiment.set(set).unwrap();
    }
    let experiment = experiment.out(&out);
    let settings = &experiment.layered.settings;
    let steps = |at: usize| {
        let mut folder = RunFolder::claim(&out, settings).unwrap();
        folder.start(settings).unwrap();
        folder.keep();
        let mut training = Losing { inner: experiment.training().unwrap(), at };
        let mut run = Run { metrics: Metrics::default(), seconds: 0.0, begun: Instant::now(), kept: None };
        let error = experiment.run_steps(&mut run, &mut training, &folder, &mut Silent, &AtomicBool::new(false));
        error.unwrap_err().to_string()
    };
    // Before the first checkpoint there is nothing to go on from.
    assert_eq!(steps(2), "a GPU: the device was lost");
    std::fs::remove_dir_all(&out).unwrap();
    let text = steps(6);
    assert!(text.starts_with("a GPU: the device was lost\nthe run is kept as it was after step 4;"), "{text}");
    assert!(text.contains(&format!("--out {} --resume", out.display())), "{text}");
    let outcome = experiment.resume(true).train().unwrap();
    assert_eq!(outcome.metrics.steps.last().unwrap().step, 9);
}
