//! A device with the programs of an experiment, their inputs, and the count of steps.

use super::optimise::{AVERAGE_OF, Rates, STEP};
use crate::Error;
use crate::config::{Networks, Optim, Settings};
use crate::data::initial_values;
use crate::run::checkpoint::{Checkpoint, Saved};
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Channels, Program, Shape, Step, Target, compile, cost};
use raygrad_runtime::{Device, InputInfo, ProgramId, Session};
use std::collections::{BTreeMap, BTreeSet};

/// How many times as fast networks layer by layer should be, as predicted, before they are chosen untried: on an H100 resident
/// ones were the faster ones in all that was measured, also where they were predicted to take 1.04 times as long.
const CLEARLY: f64 = 1.1;

/// A step's program with its networks in the form asked for. Where both are allowed and differ, `choose` is given layers of their
/// own and resident networks.
pub fn compiled(
    step: &Step,
    target: &Target,
    networks: Networks,
    choose: impl FnOnce([Program; 2]) -> Result<Program, Error>,
) -> Result<Program, Error> {
    let resident = || compile(step, &target.with_resident(step));
    if networks == Networks::Resident {
        return Ok(resident()?);
    }
    let layered = compile(step, target)?;
    if networks == Networks::Layered || *target == target.with_resident(step) {
        return Ok(layered);
    }
    let resident = resident()?;
    // Where no network is narrow there is no choice.
    if resident.to_string() == layered.to_string() { Ok(layered) } else { choose([layered, resident]) }
}

/// Of layers of their own and resident networks what should be faster, given the seconds that each launch should take.
pub fn untried([layered, resident]: [Program; 2], seconds: impl Fn(&Program) -> Vec<f64>) -> Program {
    // A driver in software takes minutes to compile kernels of so many barriers.
    if layered.target.rates == cost::Rates::SOFTWARE.single() {
        return layered;
    }
    let [apart, together] = [&layered, &resident].map(|program| seconds(program).iter().sum::<f64>());
    if together < CLEARLY * apart { resident } else { layered }
}

/// Programs that share parameters, and how far training has got.
pub struct Learner {
    pub session: Session,
    device: Device,
    networks: Networks,
    /// Of forms of networks, the fastest.
    autotune: bool,
    optim: Optim,
    inputs: BTreeMap<String, InputInfo>,
    /// Inputs from the host that were never set.
    unset: BTreeSet<String>,
    step: usize,
    /// Whether a training program's outputs are of the present state: a step was done since it began or was restored.
    stepped: bool,
}

impl Learner {
    /// Compiles a training step for a device; with `run.autotune` for the tiles, and each program for the form of its networks,
    /// that are fastest there.
    pub fn new(device: Device, settings: &Settings, step: &Step) -> Result<(Learner, ProgramId), Error> {
        let device = match settings.run.autotune {
            true => device.clone().tuned(&compile(step, &device.target())?)?,
            false => device,
        };
        let (session, optim) = (Session::new(device.clone())?, settings.optim.clone());
        let (networks, autotune) = (settings.run.networks, settings.run.autotune);
        let (inputs, unset) = (BTreeMap::new(), BTreeSet::new());
        let mut learner =
            Learner { session, device, networks, autotune, optim, inputs, unset, step: 0, stepped: false };
        let program = learner.add(step)?;
        Ok((learner, program))
    }

    /// Compiles one more program.
    pub fn add(&mut self, step: &Step) -> Result<ProgramId, Error> {
        let program = self.session.add(self.compile(step)?)?;
        let from_host = |role| matches!(role, Role::Data | Role::PerStep);
        let new = self.session.inputs().filter(|(name, info)| from_host(info.role) && !self.inputs.contains_key(*name));
        self.unset.extend(new.map(|(name, _)| name.to_string()));
        self.inputs = self.session.inputs().map(|(name, info)| (name.to_string(), info.clone())).collect();
        Ok(program)
    }

    fn compile(&self, step: &Step) -> Result<Program, Error> {
        compiled(step, &self.device.target(), self.networks, |both| match self.autotune {
            true => Ok(self.device.faster(both)?),
            false => Ok(untried(both, |program| self.device.predicted(program))),
        })
    }

    pub fn steps_done(&self) -> usize {
        self.step
    }

    pub fn program(&self, id: ProgramId) -> &Program {
        self.session.program(id)
    }

    /// Whether any program has an input of this name.
    pub fn has(&self, name: &str) -> bool {
        self.inputs.contains_key(name)
    }

    /// Sets an input, if any program has it.
    pub fn set(&mut self, name: &str, values: &[f32]) -> Result<(), Error> {
        if self.has(name) {
            self.session.set(name, values)?;
            self.unset.remove(name);
        }
        Ok(())
    }

    /// Sets an input of whole numbers, if any program has it.
    pub fn set_u32(&mut self, name: &str, values: &[u32]) -> Result<(), Error> {
        if self.has(name) {
            self.session.set_u32(name, values)?;
            self.unset.remove(name);
        }
        Ok(())
    }

    /// Sets some elements of an input of whole numbers and one channel, from element `first` on.
    pub fn set_u32_from(&mut self, name: &str, first: usize, values: &[u32]) -> Result<(), Error> {
        self.session.set_u32_from(name, first, values)?;
        self.unset.remove(name);
        Ok(())
    }

    /// Sets what tells the draws of two seeds apart: spread, so that those of seed s at step t are not those of seed s + 1 at
    /// step t - 1.
    pub fn set_seed(&mut self, name: &str, seed: u32) -> Result<(), Error> {
        self.set_u32(name, &[seed.wrapping_mul(0x9e37_79b9)])
    }

    /// Draws the initial values of all parameters.
    ///
    /// # Errors
    /// If a program has a parameter that is not among them, which would stay 0 and untrained.
    pub fn fill(&mut self, parameters: &[Parameter], seed: u32) -> Result<(), Error> {
        let listed = |name: &str| parameters.iter().any(|p| p.tensor.input_name() == Some(name));
        let mut all = self.inputs.iter().filter(|(_, i)| i.role == Role::Parameter);
        if let Some((name, _)) = all.find(|(name, _)| !listed(name)) {
            return Err(Error::UnlistedParameter { name: name.clone() });
        }
        for p in parameters {
            let Some(name) = p.tensor.input_name().filter(|n| self.has(n)) else { continue };
            self.session.set(name, &initial_values(p, seed))?;
        }
        Ok(())
    }

    /// Sets the learning rates and the like of the step that comes next.
    pub fn set_rates(&mut self) -> Result<(), Error> {
        for (name, value) in Rates::at(&self.optim, self.step).inputs() {
            self.set(name, &[value as f32])?;
        }
        self.set_u32(STEP, &[self.step as u32])
    }

    /// One step of the training program.
    ///
    /// # Errors
    /// If it fails, or the program has an input that was never set.
    pub fn train(&mut self, program: ProgramId) -> Result<(), Error> {
        self.set_rates()?;
        if !self.stepped {
            let mut all = self.session.program(program).inputs();
            if let Some((name, ..)) = all.find(|(name, ..)| self.unset.contains(*name)) {
                return Err(Error::UnsetInput { name: name.to_string() });
            }
        }
        self.session.run(program)?;
        self.step += 1;
        self.stepped = true;
        Ok(())
    }

    /// The same by the device's clock: seconds of every launch. `None` where it has no clock; then nothing was done.
    pub fn profile(&mut self, program: ProgramId) -> Result<Option<Vec<f64>>, Error> {
        self.set_rates()?;
        let seconds = self.session.profile(program)?;
        if seconds.is_some() {
            self.step += 1;
            self.stepped = true;
        }
        Ok(seconds)
    }

    /// Whether the outputs of the training program are those of the step that led to the present state.
    pub fn has_stepped(&self) -> bool {
        self.stepped
    }

    /// Gives everything trained the average that was kept of it; whether there were any.
    pub fn take_averages(&mut self) -> Result<bool, Error> {
        let kept = |(name, info): (&String, &InputInfo)| {
            (info.role == Role::State).then(|| name.strip_prefix(AVERAGE_OF).map(str::to_string)).flatten()
        };
        let kept: Vec<String> = self.inputs.iter().filter_map(kept).collect();
        if self.step == 0 || kept.is_empty() {
            return Ok(false);
        }
        for name in kept {
            let average = self.session.get(&format!("{AVERAGE_OF}{name}"))?;
            self.session.set(&name, &average)?;
        }
        Ok(true)
    }

    /// Runs a program that trains nothing, at the current progress.
    pub fn run(&mut self, program: ProgramId) -> Result<(), Error> {
        self.set_rates()?;
        Ok(self.session.run(program)?)
    }

    pub fn read(&mut self, program: ProgramId, output: &str) -> Result<Vec<f32>, Error> {
        Ok(self.session.read(program, output)?)
    }

    /// The loss terms that a program has put out.
    pub fn losses(&mut self, program: ProgramId) -> Result<BTreeMap<String, f64>, Error> {
        let mut loss = BTreeMap::new();
        for name in ["render", "render_fine", "alignment", "penalty", "total"] {
            if self.program(program).outputs.iter().any(|(n, _)| n == name) {
                let value = f64::from(self.read(program, name)?[0]);
                self.check_finite(name, &[value])?;
                loss.insert(name.to_string(), value);
            }
        }
        Ok(loss)
    }

    pub fn check_finite(&self, what: &str, values: &[f64]) -> Result<(), Error> {
        match values.iter().all(|v| v.is_finite()) {
            true => Ok(()),
            false => Err(Error::NotFinite { what: what.to_string(), step: self.step }),
        }
    }

    /// Everything that carries over to the next step.
    pub fn tensors(&mut self) -> Result<BTreeMap<String, Saved>, Error> {
        let mut tensors = BTreeMap::new();
        for (name, shape) in self.checkpoint_shapes() {
            let values = self.session.get(&name)?;
            tensors.insert(name, Saved { shape, values });
        }
        Ok(tensors)
    }

    /// Names and shapes of what a checkpoint holds.
    pub fn checkpoint_shapes(&self) -> BTreeMap<String, Vec<usize>> {
        let carried = self.inputs.iter().filter(|(_, i)| matches!(i.role, Role::Parameter | Role::State));
        carried.map(|(name, i)| (name.clone(), dimensions(&i.shape))).collect()
    }

    /// Continues from a checkpoint, whose shapes have been checked.
    pub fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), Error> {
        for (name, saved) in &checkpoint.tensors {
            self.session.set(name, &saved.values)?;
        }
        (self.step, self.stepped) = (checkpoint.step, false);
        Ok(())
    }

    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The device, for people.
    pub fn device_name(&self) -> String {
        self.device.name()
    }
}

/// -10 log10 of a mean squared error; a perfect picture has no finite PSNR, and JSON no infinity.
pub fn psnr(mean_squared_error: f64) -> f64 {
    -10.0 * mean_squared_error.max(1e-20).log10()
}

/// Sizes of the axes, then of the channels.
fn dimensions(shape: &Shape) -> Vec<usize> {
    let mut sizes: Vec<usize> = shape.axes.iter().map(|a| a.size()).collect();
    match shape.channels {
        Channels::Vector(n) => sizes.push(n),
        Channels::Matrix(rows, columns) => sizes.extend([rows, columns]),
    }
    sizes
}
