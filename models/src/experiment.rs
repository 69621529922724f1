//! An experiment from settings to results: the one way to train, for the command and for programs.
//!
//! ```no_run
//! # fn main() -> Result<(), raygrad::Error> {
//! use raygrad::Experiment;
//! let outcome = Experiment::preset("planar-l2g-small")?.set("optim.steps=500")?.out("runs/first").train()?;
//! println!("{}", outcome.metrics.last.map_or(String::new(), |f| f.entry.error_text()));
//! # Ok(())
//! # }
//! ```

use crate::Error;
use crate::config::{ConfigError, DeviceChoice, Layered, Origin, Precision};
use crate::estimate::Estimate;
use crate::evaluation::Lpips;
use crate::planar::{PERTURBATION, PlanarData, Trainer};
use crate::radiance::data::START;
use crate::radiance::{Explorer, SpaceData};
use crate::run::checkpoint::Checkpoint;
use crate::run::metrics::{Entry, Metrics};
use crate::run::{FolderError, RunFolder};
use crate::training::{Training, Watch, due};
use crate::warps::Warp;
use raygrad_runtime::{Device, DeviceError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Settings, and what a program may add to them.
#[derive(Clone)]
pub struct Experiment {
    pub layered: Layered,
    warp: Option<Arc<dyn Warp>>,
    device: Option<Device>,
    lpips: Option<Arc<Lpips>>,
    out: Option<PathBuf>,
    resume: bool,
}

/// What a finished or interrupted run gives back.
#[derive(Clone, Debug)]
pub struct Outcome {
    pub metrics: Metrics,
    pub folder: PathBuf,
    /// Whether it was stopped before its results were written; it can be resumed.
    pub interrupted: bool,
    /// Whether all steps were taken.
    pub trained: bool,
    /// The headline numbers of a finished run, as lines of text.
    pub summary: String,
}

/// Told how a run gets on. Every method does nothing unless it is given.
pub trait Observer {
    /// Hears, from any thread, how many images of how many are loaded.
    fn loading(&self) -> Box<dyn Fn(usize, usize) + Sync> {
        Box::new(|_, _| {})
    }
    /// Something had to be assumed of the scene.
    fn note(&mut self, _note: &str) {}
    /// How long what is left should take on this device, by its name.
    fn expected(&mut self, _estimate: &Estimate, _device: &str) {}
    /// The run begins, or goes on, after `done` of `steps` steps.
    fn begin(&mut self, _folder: &Path, _done: usize, _steps: usize) {}
    /// A step was submitted.
    fn step(&mut self, _done: usize) {}
    /// A step was measured.
    fn measured(&mut self, _entry: &Entry) {}
    /// Training has ended; pictures and report follow.
    fn finishing(&mut self) {}
}

/// An observer that is not interested.
pub struct Quiet;
impl Observer for Quiet {}

impl Experiment {
    /// A built-in preset, or a file if the name ends in `.toml`.
    pub fn preset(name: &str) -> Result<Experiment, Error> {
        Ok(Experiment::of(Layered::load(name)?))
    }

    /// An experiment of these settings.
    pub fn of(layered: Layered) -> Experiment {
        Experiment { layered, warp: None, device: None, lpips: None, out: None, resume: false }
    }

    /// The experiment that a run folder holds; [`Experiment::restored`] is its model.
    pub fn of_run(folder: &Path) -> Result<Experiment, Error> {
        let mut layered = RunFolder::settings_of_run(folder)?;
        // The files that a run starts from may have gone; it keeps copies of them.
        let poses = layered.settings.scene.as_ref().map_or("truth", |s| &s.poses);
        let perturbation = &layered.settings.data.perturbation;
        let copies = [
            ("scene.poses", START, !["truth", "identity", "noisy", "auto"].contains(&poses)),
            ("data.perturbation", PERTURBATION, !["drawn", ""].contains(&perturbation.as_str())),
        ];
        for (key, name, _) in copies.into_iter().filter(|(.., is_file)| *is_file) {
            layered.set_text(key, &folder.join(name).to_string_lossy(), Origin::Option(name.to_string()));
        }
        Ok(Experiment::of(layered).out(folder).resume(true))
    }

    /// Sets one value, as in `optim.steps=500`.
    pub fn set(mut self, assignment: &str) -> Result<Experiment, Error> {
        self.layered.set(assignment)?;
        Ok(self)
    }

    /// Sets one value on behalf of an option of its own, which errors then name.
    pub fn set_option(&mut self, option: &str, key: &str, value: &str) -> Result<(), ConfigError> {
        self.layered.assign(key, value, Origin::Option(format!("{option} {value}")))
    }

    /// Registers by a warp of one's own instead of the settings' one.
    /// The run remembers its type, `warp.own`, and is resumed and measured by a warp of that type only.
    pub fn warp<W: Warp + 'static>(mut self, warp: W) -> Experiment {
        self.layered.set_text("warp.own", std::any::type_name::<W>(), Origin::Option("Experiment::warp".into()));
        self.warp = Some(Arc::new(warp));
        self
    }

    /// The photo to register patches of.
    pub fn image(mut self, path: impl AsRef<Path>) -> Experiment {
        let origin = Origin::Option("Experiment::image".into());
        self.layered.set_text("data.image", &path.as_ref().to_string_lossy(), origin);
        self
    }

    /// Where to compute, instead of the settings' device.
    pub fn device(mut self, device: Device) -> Experiment {
        self.device = Some(device);
        self
    }

    /// Weights of LPIPS, to measure the pictures of an experiment in space with.
    pub fn lpips(mut self, weights: &Path) -> Result<Experiment, Error> {
        self.lpips = Some(Arc::new(Lpips::load(weights)?));
        Ok(self)
    }

    /// The run folder; by default the first free one of `runs/NAME`, `runs/NAME-2`, ...
    pub fn out(mut self, folder: impl Into<PathBuf>) -> Experiment {
        self.out = Some(folder.into());
        self
    }

    /// Continues the run that the folder holds.
    pub fn resume(mut self, resume: bool) -> Experiment {
        self.resume = resume;
        self
    }

    /// Trains to the last step.
    pub fn train(&self) -> Result<Outcome, Error> {
        self.train_observed(&mut Quiet, &AtomicBool::new(false))
    }

    /// Checks everything, compiles, and fills the device: an experiment before its first step.
    pub fn training(&self) -> Result<Box<dyn Training>, Error> {
        self.training_after(&|_, _| {})
    }

    /// The same, telling how many images of how many are loaded.
    fn training_after(&self, loading: &(dyn Fn(usize, usize) + Sync)) -> Result<Box<dyn Training>, Error> {
        if self.layered.settings.scene.is_some() {
            return Ok(Box::new(self.explorer_after(loading)?));
        }
        Ok(Box::new(self.trainer()?))
    }

    /// The same for a planar experiment.
    pub fn trainer(&self) -> Result<Trainer, Error> {
        self.layered.validate()?;
        let settings = &self.layered.settings;
        if self.lpips.is_some() {
            let text = "LPIPS compares test views of an experiment in space; this one is in the plane";
            return Err(self.layered.refuse("--lpips", text).into());
        }
        let data = PlanarData::load(&self.layered)?;
        if self.resume {
            data.check_run(&self.folder(), settings)?;
        }
        let warp = self.warp_of(settings.data.patches)?;
        Trainer::new(settings, data, warp, self.open(settings.run.precision)?)
    }

    /// The same for an experiment in space.
    pub fn explorer(&self) -> Result<Explorer, Error> {
        self.explorer_after(&|_, _| {})
    }

    fn explorer_after(&self, loading: &(dyn Fn(usize, usize) + Sync)) -> Result<Explorer, Error> {
        self.layered.validate()?;
        let settings = &self.layered.settings;
        let data = SpaceData::load(&self.layered, loading)?;
        if self.resume {
            data.check_run(&self.folder())?;
        }
        if self.lpips.is_some() {
            Lpips::check_size(data.size.width, data.size.height)?;
        }
        let warp = self.warp_of(data.scene.train.len())?;
        let mut explorer = Explorer::new(settings, data, warp, self.open(settings.run.precision)?)?;
        explorer.lpips = self.lpips.clone();
        Ok(explorer)
    }

    /// The program's own warp, or the settings' one of so many frames.
    fn warp_of(&self, frames: usize) -> Result<Arc<dyn Warp>, ConfigError> {
        self.warp.clone().map_or_else(|| self.layered.built_in_warp(frames), Ok)
    }

    /// The model of the last checkpoint of the run in the folder that [`Experiment::out`] names.
    pub fn restored(&self) -> Result<Box<dyn Training>, Error> {
        if self.layered.settings.scene.is_some() {
            return Ok(Box::new(self.restored_explorer()?));
        }
        let mut trainer = self.trainer()?;
        self.restore(&mut trainer)?;
        trainer.settle()?;
        Ok(Box::new(trainer))
    }

    /// The same for an experiment in space.
    pub fn restored_explorer(&self) -> Result<Explorer, Error> {
        let mut explorer = self.explorer()?;
        self.restore(&mut explorer)?;
        explorer.settle()?;
        Ok(explorer)
    }

    fn restore(&self, model: &mut dyn Training) -> Result<Checkpoint, Error> {
        let checkpoint = Checkpoint::load(&self.folder(), &model.learner().checkpoint_shapes())?;
        model.restore(&checkpoint)?;
        Ok(checkpoint)
    }

    /// The run folder.
    fn folder(&self) -> PathBuf {
        self.out.clone().unwrap_or_else(|| RunFolder::default_path(&self.layered.name, self.resume))
    }

    fn open(&self, precision: Precision) -> Result<Device, Error> {
        let run = &self.layered.settings.run;
        let device = match &self.device {
            Some(device) => device.clone(),
            None => open_device(run.device, run.threads.limit())?.measured()?,
        };
        Ok(device.with_precision(precision.into())?)
    }

    /// Trains until the last step is done and the results are written, or `stop` is set, which ends the run with a checkpoint.
    pub fn train_observed(&self, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<Outcome, Error> {
        self.layered.validate()?;
        let settings = &self.layered.settings;
        let mut path = self.folder();
        // Refuse a folder before the work of compiling, and again look at it before the first write.
        let mut folder = match self.resume {
            true => RunFolder::reopen(&path, settings)?,
            false => RunFolder::claim(&path, settings)?,
        };
        let mut trainer = self.training_after(&*observer.loading())?;
        trainer.notes().iter().for_each(|note| observer.note(note));
        let mut run = Run { metrics: Metrics::default(), seconds: 0.0, begun: Instant::now(), kept: None };
        if self.resume {
            let checkpoint = self.restore(&mut *trainer)?;
            run.kept = Some(checkpoint.step);
            (run.metrics.steps, run.seconds) = (checkpoint.steps, checkpoint.seconds);
        } else {
            match folder.start(settings) {
                // Nobody asked for this folder, and another run has taken it meanwhile.
                Err(FolderError::Occupied { .. } | FolderError::InUse { .. }) if self.out.is_none() => {
                    path = self.folder();
                    folder = RunFolder::claim(&path, settings)?;
                    folder.start(settings)?;
                }
                other => other?,
            }
            trainer.write_data(&folder)?;
        }
        folder.keep();
        if let Some(estimate) = Estimate::of(&mut *trainer, settings)? {
            observer.expected(&estimate, &trainer.learner().device_name());
        }
        run.begun = Instant::now();
        observer.begin(&path, trainer.steps_done(), settings.optim.taken());
        let trained = !self.run_steps(&mut run, &mut *trainer, &folder, observer, stop)?;
        if trained {
            observer.finishing();
            let Run { metrics, seconds, begun, .. } = &mut run;
            let elapsed = || *seconds + begun.elapsed().as_secs_f64();
            match trainer.finish(&folder, &self.layered, metrics, &elapsed, Watch::new(&|_, _| {}, stop)) {
                Err(Error::Stopped) => metrics.last = None,
                other => other?,
            }
        }
        let interrupted = run.metrics.last.is_none();
        let summary = run.metrics.last.as_ref().map_or(String::new(), |last| trainer.summary(last));
        folder.write("metrics.json", run.metrics.to_json().as_bytes())?;
        Ok(Outcome { metrics: run.metrics, folder: path, interrupted, trained, summary })
    }

    /// The steps that are left; whether they were cut short. A device that is lost takes with it what was learnt since the
    /// last checkpoint, and the error says how to go on from there.
    fn run_steps(
        &self,
        run: &mut Run,
        trainer: &mut dyn Training,
        folder: &RunFolder,
        observer: &mut dyn Observer,
        stop: &AtomicBool,
    ) -> Result<bool, Error> {
        self.steps_left(run, trainer, folder, observer, stop).map_err(|error| match (error, run.kept) {
            (Error::Run(source), Some(step)) => {
                Error::DeviceFailed { source, step, folder: folder.path().display().to_string() }
            }
            (other, _) => other,
        })
    }

    fn steps_left(
        &self,
        run: &mut Run,
        trainer: &mut dyn Training,
        folder: &RunFolder,
        observer: &mut dyn Observer,
        stop: &AtomicBool,
    ) -> Result<bool, Error> {
        let (steps, every) = (self.layered.settings.optim.taken(), &self.layered.settings.run);
        if trainer.steps_done() == 0 && every.picture_every > 0 {
            trainer.write_frame(folder)?;
        }
        while trainer.steps_done() < steps {
            if stop.load(Ordering::Relaxed) {
                run.checkpoint(trainer, folder)?;
                return Ok(true);
            }
            trainer.step()?;
            let done = trainer.steps_done();
            if due(every.log_every, done) || done == steps {
                let entry = trainer.measure()?;
                observer.measured(&entry);
                run.metrics.steps.push(entry);
            }
            if due(every.picture_every, done) || (done == steps && every.picture_every > 0) {
                trainer.write_frame(folder)?;
            }
            if due(every.checkpoint_every, done) || done == steps {
                run.checkpoint(trainer, folder)?;
            }
            observer.step(done);
        }
        Ok(false)
    }
}

/// What accumulates over a run.
struct Run {
    metrics: Metrics,
    /// Time of the parts before this one.
    seconds: f64,
    begun: Instant,
    /// Steps of the last checkpoint.
    kept: Option<usize>,
}

impl Run {
    fn elapsed(&self) -> f64 {
        self.seconds + self.begun.elapsed().as_secs_f64()
    }
    fn checkpoint(&mut self, trainer: &mut dyn Training, folder: &RunFolder) -> Result<(), Error> {
        let (step, seconds, steps) = (trainer.steps_done(), self.elapsed(), self.metrics.steps.clone());
        Checkpoint { step, seconds, steps, tensors: trainer.tensors()? }.save(folder.path())?;
        self.kept = Some(step);
        Ok(())
    }
}

/// The device that settings ask for.
pub fn open_device(choice: DeviceChoice, threads: Option<usize>) -> Result<Device, DeviceError> {
    match choice {
        DeviceChoice::Auto => Device::auto(threads),
        DeviceChoice::Cpu => Device::cpu(threads),
        DeviceChoice::Wgpu(index) => Device::wgpu(index),
        DeviceChoice::Vulkan(index) => Device::vulkan(index),
    }
}

#[cfg(test)]
#[path = "experiment_tests.rs"]
mod tests;
