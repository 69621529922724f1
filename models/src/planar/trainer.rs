//! A planar model on a device: its programs, their inputs, and steps.

use super::data::PlanarData;
use super::model::{self, PlanarModel};
use super::rates::{Rates, STEP};
use crate::Error;
use crate::config::Settings;
use crate::data::initial_values;
use crate::geometry::Transform;
use crate::pictures::View;
use crate::run::checkpoint::{Checkpoint, Saved};
use crate::run::metrics::{CornerError, Entry};
use crate::warps::{KNOWN_TRUTH, Warp};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Channels, Program, Shape, compile};
use raygrad_runtime::{Device, InputInfo, ProgramId, Session};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Longer side of the pictures of the animation.
const FRAME_SIDE: usize = 320;

/// A model in training.
pub struct Trainer {
    pub data: PlanarData,
    settings: Settings,
    session: Session,
    inputs: BTreeMap<String, InputInfo>,
    train: ProgramId,
    evaluate: ProgramId,
    frame: (View, ProgramId),
    full: (View, ProgramId),
    device: String,
    flops: f64,
    /// Steps done.
    step: usize,
    /// Whether any of them was done here, so that the training program has outputs.
    stepped: bool,
}

/// The model over all pixels of all patches.
#[derive(Clone, Debug)]
pub struct Evaluation {
    pub entry: Entry,
    /// Estimated warps.
    pub warps: Vec<Transform>,
    /// Field points of the local and the global map, patch by patch, two numbers a pixel.
    pub local: Vec<f32>,
    pub global: Vec<f32>,
    /// Rendered patches, three numbers a pixel.
    pub color: Vec<f32>,
}

impl Trainer {
    /// Compiles the programs and fills their inputs.
    pub fn new(settings: &Settings, data: PlanarData, warp: Arc<dyn Warp>, device: Device) -> Result<Trainer, Error> {
        let model = PlanarModel::new(settings, data.grid, warp);
        let (target, name) = (device.target(), device_name(&device));
        let mut session = Session::new(device)?;
        let mut add = |program: Program| session.add(program);
        let (frame_view, full_view) = (View::within(data.grid, FRAME_SIDE), View::full(data.grid));
        let train = add(compile(&model.train_step(), &target)?)?;
        let evaluate = add(compile(&model.evaluation(), &target)?)?;
        let frame = add(compile(&model.picture(frame_view.width * frame_view.height), &target)?)?;
        let full = add(compile(&model.picture(full_view.width * full_view.height), &target)?)?;
        let inputs = session.inputs().map(|(name, info)| (name.to_string(), info.clone())).collect();
        let (frame, full) = ((frame_view, frame), (full_view, full));
        let settings = settings.clone();
        let mut trainer = Trainer {
            data,
            settings,
            session,
            inputs,
            train,
            evaluate,
            frame,
            full,
            device: name,
            flops: model.flops(),
            step: 0,
            stepped: false,
        };
        trainer.fill_data()?;
        trainer.fill_parameters(&model)?;
        Ok(trainer)
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// The program of a training step.
    pub fn program(&self) -> &Program {
        self.session.program(self.train)
    }

    /// What it trains on, for people.
    pub fn device_name(&self) -> String {
        self.device.clone()
    }

    /// One training step. On a GPU this only submits it.
    pub fn step(&mut self) -> Result<(), Error> {
        self.set_rates()?;
        self.session.run(self.train)?;
        (self.step, self.stepped) = (self.step + 1, true);
        Ok(())
    }

    /// Floating-point operations of a step, see [`PlanarModel::flops`].
    pub fn flops(&self) -> f64 {
        self.flops
    }

    /// Waits until the last step is done.
    pub fn wait(&mut self) -> Result<(), Error> {
        self.session.read(self.train, "total")?;
        Ok(())
    }

    /// Losses and corner errors of the last step, as its forward pass saw them.
    pub fn measure(&mut self) -> Result<Entry, Error> {
        let (entry, _) = self.read_entry(self.train)?;
        Ok(entry)
    }

    /// The estimated warps, as the last step saw them, or those that training starts from.
    pub fn warps(&mut self) -> Result<Vec<Transform>, Error> {
        let program = if self.stepped { self.train } else { self.evaluate };
        if !self.stepped {
            self.set_rates()?;
            self.session.run(self.evaluate)?;
        }
        Ok(self.session.read(program, "transform")?.chunks(9).map(Transform::from_rows).collect())
    }

    /// Runs the model over all pixels.
    pub fn evaluate(&mut self) -> Result<Evaluation, Error> {
        self.set_rates()?;
        self.session.run(self.evaluate)?;
        let (entry, warps) = self.read_entry(self.evaluate)?;
        let mut read = |name| self.session.read(self.evaluate, name);
        Ok(Evaluation { entry, warps, local: read("local")?, global: read("global")?, color: read("color")? })
    }

    /// The learned picture, small for the animation or with all its pixels.
    pub fn picture(&mut self, full: bool) -> Result<(View, Vec<f32>), Error> {
        let (view, program) = if full { self.full } else { self.frame };
        self.set_rates()?;
        self.session.run(program)?;
        Ok((view, self.session.read(program, "color")?))
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
        self.step = checkpoint.step;
        Ok(())
    }

    fn read_entry(&mut self, program: ProgramId) -> Result<(Entry, Vec<Transform>), Error> {
        let mut loss = BTreeMap::new();
        for name in ["render", "alignment", "penalty", "total"] {
            if self.session.program(program).outputs.iter().any(|(n, _)| n == name) {
                let value = f64::from(self.session.read(program, name)?[0]);
                self.check_finite(name, &[value])?;
                loss.insert(name.to_string(), value);
            }
        }
        let rows = self.session.read(program, "transform")?;
        let warps: Vec<Transform> = rows.chunks(9).map(Transform::from_rows).collect();
        let per_patch: Vec<f64> =
            warps.iter().zip(&self.data.truth).map(|(w, t)| self.data.grid.corner_error(w, t)).collect();
        self.check_finite("corner error", &per_patch)?;
        let render = loss.get("render").copied().unwrap_or(1.0);
        // A perfect picture has no finite PSNR; JSON no infinity.
        let patch_psnr_db = -10.0 * render.max(1e-20).log10();
        let entry = Entry { step: self.step, loss, patch_psnr_db, corner_error_px: CornerError::new(per_patch) };
        Ok((entry, warps))
    }

    fn check_finite(&self, what: &str, values: &[f64]) -> Result<(), Error> {
        match values.iter().all(|v| v.is_finite()) {
            true => Ok(()),
            false => Err(Error::NotFinite { what: what.to_string(), step: self.step }),
        }
    }

    fn set_rates(&mut self) -> Result<(), Error> {
        for (name, value) in Rates::at(&self.settings.optim, self.step).inputs() {
            if self.inputs.contains_key(name) {
                self.session.set(name, &[value])?;
            }
        }
        if self.inputs.contains_key(STEP) {
            self.session.set_u32(STEP, &[self.step as u32])?;
        }
        Ok(())
    }

    fn fill_data(&mut self) -> Result<(), Error> {
        let flat = |points: Vec<[f64; 2]>| points.concat().iter().map(|x| *x as f32).collect::<Vec<_>>();
        let rows = self.data.truth.iter().flat_map(|t| t.to_rows()).collect();
        let mut data = vec![
            (model::GRID.to_string(), flat(self.data.grid.crop_points())),
            (model::TARGET.to_string(), self.data.targets().concat().iter().map(|c| *c as f32).collect()),
            (KNOWN_TRUTH.to_string(), rows),
        ];
        for view in [self.frame.0, self.full.0] {
            data.push((model::view(view.width * view.height), view.points()));
        }
        for (name, values) in data {
            if self.inputs.contains_key(&name) {
                self.session.set(&name, &values)?;
            }
        }
        if self.inputs.contains_key(model::SEED) {
            // Spread, so that the draws of seed s at step t are not those of seed s + 1 at step t - 1.
            self.session.set_u32(model::SEED, &[self.settings.run.seed.wrapping_mul(0x9e37_79b9)])?;
        }
        Ok(())
    }

    fn fill_parameters(&mut self, model: &PlanarModel) -> Result<(), Error> {
        for p in model.parameters() {
            let Some(name) = p.tensor.input_name().filter(|n| self.inputs.contains_key(*n)) else { continue };
            self.session.set(name, &initial_values(&p, self.settings.run.seed))?;
        }
        Ok(())
    }
}

fn device_name(device: &Device) -> String {
    match device {
        Device::Cpu { pool } => format!("CPU, {} threads", pool.current_num_threads()),
        #[cfg(feature = "wgpu")]
        Device::Wgpu { gpu } => gpu.adapter().name.clone(),
    }
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
