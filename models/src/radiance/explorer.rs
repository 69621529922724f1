//! A 3D model on a device: its programs, their inputs, and steps.

use super::data::{SpaceData, SpaceDataError};
use super::error_map;
use super::evaluate::{trial, validate};
use super::lens;
use super::model::{self, RadianceModel, nothing_found};
use super::relocalise::relocalise;
use super::results;
use crate::Error;
use crate::config::{DepthSettings, Layered, Method, RefineLens, Settings};
use crate::estimate::Trial;
use crate::evaluation::{Evaluation, FoundLens, Lpips};
use crate::geometry::Pose;
use crate::run::metrics::{Entry, Final, Measured, Metrics, Relocalised};
use crate::run::{Checkpoint, RunFolder};
use crate::scene::{Intrinsics, View};
use crate::training::learner::psnr;
use crate::training::{Learner, Training, Watch, due};
use crate::warps::Warp;
use raygrad_compiler::functions::adam::Adam;
use raygrad_runtime::{Device, ProgramId};
use std::sync::Arc;

/// Pixels that one run of the rendering program covers, at most.
const VIEW_PIXELS: usize = 2048;
/// Points that one run of the density program covers.
const PLACES: usize = 16384;
/// Pixels along a side of the grid on which the poses of averages are fitted, where `train.fit_grid` names none.
const FITTED: usize = 24;

/// A model in training.
pub struct Explorer {
    /// Without the images of the training views, which live on the device (and in `photos`).
    pub data: Arc<SpaceData>,
    pub(super) settings: Settings,
    /// To measure pictures with, where there are weights.
    pub lpips: Option<Arc<Lpips>>,
    model: RadianceModel,
    learner: Learner,
    train: ProgramId,
    view: ProgramId,
    refine: ProgramId,
    /// Compiled when they are first needed.
    density: Option<ProgramId>,
    comparison: Option<ProgramId>,
    fit: Option<ProgramId>,
    /// Pixels of one run of `view`.
    view_pixels: usize,
    rays: usize,
    /// Cameras brought back since the last measurement.
    pub(super) relocalised: Vec<Relocalised>,
    /// Packed pixels of the training views, where lost cameras are looked for.
    photos: Vec<Vec<u32>>,
    /// Once training has ended.
    evaluation: Option<Evaluation>,
}

/// A view as the model sees it, row by row.
#[derive(Clone, Debug)]
pub struct Rendered {
    pub rgb: Vec<f32>,
    /// Expected depth, not divided by the opacity.
    pub depth: Vec<f32>,
    pub opacity: Vec<f32>,
}

impl Explorer {
    /// Compiles the programs and fills their inputs.
    pub fn new(
        settings: &Settings,
        mut data: SpaceData,
        warp: Arc<dyn Warp>,
        device: Device,
    ) -> Result<Explorer, Error> {
        let settings = &data.with_depths(settings);
        let views = data.scene.train.len();
        let model = RadianceModel::new(settings, data.size, views, warp).map_err(SpaceDataError::from)?;
        let model = model.for_target(device.target().kind);
        let view_pixels = VIEW_PIXELS.min(data.size.pixels());
        let (mut learner, train) = Learner::new(device, settings, &model.train_step())?;
        let view = learner.add(&model.view(view_pixels))?;
        let refine = learner.add(&model.refinement())?;
        learner.fill(&model.parameters(), settings.run.seed)?;
        learner.set_seed(model::SEED, settings.run.seed)?;
        learner.set(model::POSES, &flat_rows(&data.start.poses))?;
        learner.set(model::FOUND, &nothing_found(views))?;
        let side = settings.train.as_ref().map_or(0, |t| t.error_map);
        learner.set(error_map::ERROR_MAP, &error_map::untried(views, side))?;
        let intrinsics: Vec<f32> = data.scene.train.iter().flat_map(|v| given_lens(&v.intrinsics)).collect();
        learner.set(model::INTRINSICS, &intrinsics)?;
        let relocalises = relocalise_every(settings) > 0;
        let mut photos = vec![];
        // From here on the images live on the device.
        for (i, view) in data.scene.train.iter_mut().enumerate() {
            let pixels: Vec<u32> = model::packed(view).collect();
            learner.set_u32_from(model::IMAGES, i * pixels.len(), &pixels)?;
            (view.pixels, view.depth, view.mask) = (vec![], None, None);
            photos.extend(relocalises.then_some(pixels));
        }
        let (data, settings, rays) = (Arc::new(data), settings.clone(), model.rays_per_view() * views);
        let (lpips, density, comparison, fit, evaluation) = (None, None, None, None, None);
        Ok(Explorer {
            data,
            settings,
            lpips,
            model,
            learner,
            train,
            view,
            refine,
            density,
            comparison,
            fit,
            view_pixels,
            rays,
            relocalised: vec![],
            photos,
            evaluation,
        })
    }

    /// The poses of the training views, as the last step found them.
    pub fn poses(&mut self) -> Result<Vec<Pose>, Error> {
        let (rough, found) = (self.learner.session.get(model::POSES)?, self.learner.session.get(model::FOUND)?);
        let one = |(rough, found)| Pose::from_rows::<f32>(rough).after(&Pose::from_rows(found));
        Ok(rough.chunks(12).zip(found.chunks(12)).map(one).collect())
    }

    /// What was found of the lenses, where they are refined.
    pub fn found_lens(&mut self) -> Result<Option<FoundLens>, Error> {
        if self.settings.train.as_ref().is_none_or(|t| t.refine_lens == RefineLens::None) {
            return Ok(None);
        }
        Ok(Some(lens::found(&self.learner.session.get(lens::LENS)?)))
    }

    /// A pose of the true world in the learned one, by the poses that the last step found.
    pub(super) fn learned_pose(&mut self, pose: &Pose) -> Result<Pose, Error> {
        let poses = self.poses()?;
        Ok(self.data.similarity(&poses).map_err(SpaceDataError::from)?.to_learned(pose))
    }

    /// The whole image of a camera in the learned world, unless `watch` stops it before.
    pub fn render(&mut self, pose: &Pose, intrinsics: &Intrinsics, watch: Watch) -> Result<Rendered, Error> {
        self.look(pose, intrinsics)?;
        let mut seen = Rendered { rgb: vec![], depth: vec![], opacity: vec![] };
        for first in self.parts() {
            watch.check()?;
            self.render_part(first, &mut seen)?;
        }
        Ok(seen)
    }

    /// The camera of the parts that are rendered next.
    pub(super) fn look(&mut self, pose: &Pose, intrinsics: &Intrinsics) -> Result<(), Error> {
        self.learner.set(model::VIEW_INTRINSICS, &given_lens(intrinsics))?;
        self.set_pose(pose)
    }

    /// The first pixels of the parts of an image.
    pub(super) fn parts(&self) -> impl ExactSizeIterator<Item = usize> + use<> {
        (0..self.data.size.pixels()).step_by(self.view_pixels)
    }

    /// Renders the part of the image from its first pixel on.
    pub(super) fn render_part(&mut self, first: usize, seen: &mut Rendered) -> Result<(), Error> {
        self.learner.set_u32(model::VIEW_FIRST, &[first as u32])?;
        self.learner.run(self.view)?;
        let left = self.view_pixels.min(self.data.size.pixels() - first);
        let mut read = |name, width: usize| -> Result<Vec<f32>, Error> {
            let mut values = self.learner.read(self.view, name)?;
            values.truncate(width * left);
            Ok(values)
        };
        seen.rgb.extend(read("color", 3)?);
        seen.depth.extend(read("depth", 1)?);
        seen.opacity.extend(read("opacity", 1)?);
        Ok(())
    }

    /// `pose` after so many steps of test-time refinement against a view's image, unless `watch` stops it before.
    pub fn refined(&mut self, pose: &Pose, view: &View, steps: usize, watch: Watch) -> Result<Pose, Error> {
        show(&mut self.learner, &view.intrinsics, &model::packed(view).collect::<Vec<_>>())?;
        self.refine(pose, steps, self.settings.optim.lr_warp, watch)
    }

    /// `pose` refined against the image that is shown: `P Exp(twist)` with Adam on the twist, the field as it is.
    pub(super) fn refine(&mut self, pose: &Pose, steps: usize, rate: f64, watch: Watch) -> Result<Pose, Error> {
        self.set_pose(pose)?;
        for state in [model::TWIST.to_string(), format!("adam.m.{}", model::TWIST), format!("adam.v.{}", model::TWIST)]
        {
            self.learner.set(&state, &[0.0; 6])?;
        }
        self.learner.set(model::TWIST_LR, &[rate as f32])?;
        for step in 1..=steps {
            watch.check()?;
            let (bias1, bias2) = Adam::default().bias_corrections(step as u64);
            self.learner.set(model::TWIST_BIAS1, &[bias1 as f32])?;
            self.learner.set(model::TWIST_BIAS2, &[bias2 as f32])?;
            self.learner.set_rates()?;
            self.learner.set_u32(crate::training::optimise::STEP, &[step as u32])?;
            self.learner.session.run(self.refine)?;
        }
        let twist = self.learner.session.get(model::TWIST)?;
        Ok(pose.after(&Pose::exp(&std::array::from_fn(|i| f64::from(twist[i])))))
    }

    /// Shows a training view to [`Self::refine`] and [`Self::photo_error`].
    pub(super) fn show_training_view(&mut self, view: usize) -> Result<(), Error> {
        show(&mut self.learner, &self.data.scene.train[view].intrinsics, &self.photos[view])
    }

    /// Mean squared error of the image that is shown against what the model shows at `pose`; over the same pixels for all poses.
    pub(super) fn photo_error(&mut self, pose: &Pose) -> Result<f64, Error> {
        let program = match self.comparison {
            Some(program) => program,
            None => self.learner.add(&self.model.comparison())?,
        };
        self.comparison = Some(program);
        self.set_pose(pose)?;
        self.learner.run(program)?;
        Ok(f64::from(self.learner.read(program, "render")?[0]))
    }

    /// Gives a training view the pose, by another rough one.
    pub(super) fn place(&mut self, view: usize, pose: &Pose) -> Result<(), Error> {
        let (mut rough, found) = (self.learner.session.get(model::POSES)?, self.learner.session.get(model::FOUND)?);
        let row = 12 * view..12 * (view + 1);
        let moved = pose.after(&Pose::from_rows(&found[row.clone()]).inverse());
        rough[row].copy_from_slice(&moved.to_rows().map(|x| x as f32));
        self.learner.set(model::POSES, &rough)
    }

    /// Densities at points of the learned world, in inverse lengths of it.
    pub fn density(&mut self, points: &[[f32; 3]]) -> Result<Vec<f32>, Error> {
        let program = match self.density {
            Some(program) => program,
            None => self.learner.add(&self.model.density(PLACES))?,
        };
        self.density = Some(program);
        let mut found = Vec::with_capacity(points.len());
        for chunk in points.chunks(PLACES) {
            let mut at = chunk.concat();
            at.resize(3 * PLACES, 0.0);
            self.learner.set(model::DENSITY_POINTS, &at)?;
            self.learner.run(program)?;
            found.extend(&self.learner.read(program, "density")?[..chunk.len()]);
        }
        Ok(found)
    }

    fn set_pose(&mut self, pose: &Pose) -> Result<(), Error> {
        self.learner.set(model::VIEW_POSE, &flat_rows(&[*pose]))?;
        if self.settings.train.as_ref().is_some_and(|t| t.depth == DepthSettings::Auto) {
            let centers: Vec<_> = self.poses()?.iter().map(Pose::center).collect();
            let largest = centers.iter().flat_map(|a| centers.iter().map(move |b| (a - b).norm())).fold(0.0, f64::max);
            let range = [super::rays::NEAR_PART * largest, super::rays::FAR_PART * largest];
            self.learner.set(model::VIEW_RANGE, &range.map(|x| x as f32))?;
        }
        Ok(())
    }
}

/// Steps between two searches for lost cameras; known poses are not lost.
pub(super) fn relocalise_every(settings: &Settings) -> usize {
    let every = settings.train.as_ref().map_or(0, |t| t.relocalise_every);
    if settings.warp.method == Method::None { 0 } else { every }
}

/// Steps between two looks at a validation view.
pub(super) fn validate_every(settings: &Settings) -> usize {
    settings.train.as_ref().map_or(0, |t| t.validate_every)
}

/// Sets the lens and the photo of a view.
fn show(learner: &mut Learner, camera: &Intrinsics, photo: &[u32]) -> Result<(), Error> {
    learner.set(model::VIEW_INTRINSICS, &given_lens(camera))?;
    learner.set_u32(model::VIEW_IMAGE, photo)
}

/// `[R | t]` of poses, row by row.
fn flat_rows(poses: &[Pose]) -> Vec<f32> {
    poses.iter().flat_map(|p| p.to_rows()).map(|x| x as f32).collect()
}

/// fx, fy, cx, cy.
fn given_lens(camera: &Intrinsics) -> [f32; 4] {
    [camera.fx, camera.fy, camera.cx, camera.cy].map(|x| x as f32)
}

impl Training for Explorer {
    fn learner(&self) -> &Learner {
        &self.learner
    }
    fn learner_mut(&mut self) -> &mut Learner {
        &mut self.learner
    }
    fn training_program(&self) -> ProgramId {
        self.train
    }
    fn step(&mut self) -> Result<(), Error> {
        self.learner.train(self.train)?;
        if due(relocalise_every(&self.settings), self.steps_done()) {
            let back = relocalise(self)?;
            self.relocalised.extend(back);
        }
        Ok(())
    }
    fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), Error> {
        self.relocalised.clear();
        self.learner.restore(checkpoint)
    }
    fn measure(&mut self) -> Result<Entry, Error> {
        let loss = self.learner.losses(self.train)?;
        let found = self.poses()?;
        let numbers: Vec<f64> = found.iter().flat_map(|p| p.to_rows()).collect();
        self.learner.check_finite("a pose", &numbers)?;
        let validates = due(validate_every(&self.settings), self.steps_done());
        let validation_psnr_db = if validates { validate(self)? } else { None };
        let errors = self.data.pose_scores(&found).map_err(SpaceDataError::from)?.mean;
        let measured = Measured::Space {
            psnr_db: psnr(loss.get("render_fine").or(loss.get("render")).copied().unwrap_or(1.0)),
            rotation_error_deg: errors.rotation_error_deg,
            translation_error_x100: errors.translation_error_x100,
            validation_psnr_db,
        };
        let relocalised = std::mem::take(&mut self.relocalised);
        Ok(Entry { step: self.learner.steps_done(), loss, measured, relocalised })
    }
    fn flops(&self) -> f64 {
        self.model.flops()
    }
    fn rows(&self) -> usize {
        self.rays
    }
    fn work(&self) -> String {
        let (samples, fine) = self.settings.train.as_ref().map_or((0, 0), |t| (t.samples, t.fine_samples));
        let more = if fine > 0 { format!(" + {fine}") } else { String::new() };
        format!("{} rays of {samples}{more} samples", self.rays)
    }
    /// Takes the averages where `optim.average` has kept some, and fits the poses of the training views once more, at pixels of
    /// a grid, where `train.fit_grid` asks for that: the last step's hang on the pixels that it drew. Averages have poses of
    /// their own, which are fitted in any case. To be called when nothing is trained any more.
    fn settle(&mut self) -> Result<(), Error> {
        let averaged = self.learner.take_averages()?;
        let side = match self.settings.train.as_ref().map_or(0, |t| t.fit_grid) {
            0 if averaged => FITTED,
            side => side,
        };
        if side == 0 {
            return Ok(());
        }
        let pixels = self.data.size.grid(side);
        let program = match self.fit {
            Some(program) => program,
            None => self.learner.add(&self.model.fit(pixels.len()))?,
        };
        self.fit = Some(program);
        self.learner.set_u32(model::FIT_PIXELS, &pixels)?;
        self.learner.run(program)
    }
    fn write_data(&self, folder: &RunFolder) -> Result<(), Error> {
        results::write_data(folder, &self.data)
    }
    fn write_frame(&mut self, folder: &RunFolder) -> Result<(), Error> {
        results::write_frame(folder, self)
    }
    fn write_evaluation(&mut self, folder: &RunFolder, watch: Watch) -> Result<Evaluation, Error> {
        Ok(results::write_evaluation(folder, self, watch)?.evaluation)
    }
    fn finish(
        &mut self,
        folder: &RunFolder,
        layered: &Layered,
        metrics: &mut Metrics,
        seconds: &dyn Fn() -> f64,
        watch: Watch,
    ) -> Result<(), Error> {
        // Of a finished run that is resumed no step was taken that could be measured.
        let entry = metrics.steps.last().cloned().map_or_else(|| self.measure(), Ok)?;
        metrics.last = Some(Final { entry, seconds: seconds(), warps: vec![] });
        self.settle()?;
        let written = results::write_evaluation(folder, self, watch)?;
        results::write_report(folder, layered, self, metrics, &written)?;
        self.evaluation = Some(written.evaluation);
        Ok(())
    }
    fn trial(&mut self) -> Result<Trial, Error> {
        trial(self)
    }
    fn notes(&self) -> &[String] {
        &self.data.scene.notes
    }
    fn summary(&self, last: &Final) -> String {
        results::summary(self.data.start.poses.len(), last, self.evaluation.as_ref())
    }
}
