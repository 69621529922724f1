//! A planar model on a device: its programs, their inputs, and steps.

use super::data::PlanarData;
use super::model::{self, PlanarModel};
use crate::Error;
use crate::config::{Count, Layered, Method, Settings};
use crate::estimate::{Trial, timed};
use crate::evaluation;
use crate::geometry::Transform;
use crate::pictures::View;
use crate::run::metrics::{Entry, Final, Measured, Metrics, OfPatches};
use crate::run::{RunFolder, results};
use crate::training::learner::psnr;
use crate::training::{Learner, Training, Watch};
use crate::warps::{KNOWN_TRUTH, Warp};
use raygrad_runtime::{Device, ProgramId};
use std::sync::Arc;

/// Longer side of the pictures of the animation.
const FRAME_SIDE: usize = 320;

/// A model in training.
pub struct Trainer {
    pub data: PlanarData,
    settings: Settings,
    learner: Learner,
    train: ProgramId,
    evaluate: ProgramId,
    frame: (View, ProgramId),
    full: (View, ProgramId),
    flops: f64,
    notes: Vec<String>,
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
        let model = PlanarModel::new(settings, data.grid, warp).for_target(device.target().kind);
        let (mut learner, train) = Learner::new(device, settings, &model.train_step())?;
        let (frame_view, full_view) = (View::within(data.grid, FRAME_SIDE), View::full(data.grid));
        let evaluate = learner.add(&model.evaluation())?;
        let frame = learner.add(&model.picture(frame_view.width * frame_view.height))?;
        let full = learner.add(&model.picture(full_view.width * full_view.height))?;
        learner.fill(&model.parameters(), settings.run.seed)?;
        learner.set_seed(model::SEED, settings.run.seed)?;
        let (frame, full, flops) = ((frame_view, frame), (full_view, full), model.flops());
        let (settings, notes) = (settings.clone(), notes(settings));
        let mut trainer = Trainer { data, settings, learner, train, evaluate, frame, full, flops, notes };
        trainer.fill_data()?;
        Ok(trainer)
    }

    /// The estimated warps, as the last step saw them, or those that training starts from.
    pub fn warps(&mut self) -> Result<Vec<Transform>, Error> {
        let stepped = self.learner.has_stepped();
        let program = if stepped { self.train } else { self.evaluate };
        if !stepped {
            self.learner.run(self.evaluate)?;
        }
        Ok(self.learner.read(program, "transform")?.chunks(9).map(Transform::from_rows).collect())
    }

    /// Runs the model over all pixels.
    pub fn evaluate(&mut self) -> Result<Evaluation, Error> {
        self.learner.run(self.evaluate)?;
        let (entry, warps) = self.read_entry(self.evaluate)?;
        let mut read = |name| self.learner.read(self.evaluate, name);
        Ok(Evaluation { entry, warps, local: read("local")?, global: read("global")?, color: read("color")? })
    }

    /// The learned picture, small for the animation or with all its pixels.
    pub fn picture(&mut self, full: bool) -> Result<(View, Vec<f32>), Error> {
        let (view, program) = if full { self.full } else { self.frame };
        self.learner.run(program)?;
        Ok((view, self.learner.read(program, "color")?))
    }

    fn read_entry(&mut self, program: ProgramId) -> Result<(Entry, Vec<Transform>), Error> {
        let loss = self.learner.losses(program)?;
        let rows = self.learner.read(program, "transform")?;
        let warps: Vec<Transform> = rows.chunks(9).map(Transform::from_rows).collect();
        let per_patch: Vec<f64> =
            warps.iter().zip(&self.data.truth).map(|(w, t)| self.data.grid.corner_error(w, t)).collect();
        self.learner.check_finite("corner error", &per_patch)?;
        let patch_psnr_db = psnr(loss.get("render").copied().unwrap_or(1.0));
        let distances = warps.iter().zip(&self.data.truth).map(|(w, t)| w.sl3_distance(t));
        let warp_error = distances.collect::<Option<Vec<f64>>>().map(OfPatches::new);
        let corner_error_px = OfPatches::new(per_patch);
        let measured = Measured::Planar { patch_psnr_db, corner_error_px, warp_error };
        let relocalised = vec![];
        Ok((Entry { step: self.learner.steps_done(), loss, measured, relocalised }, warps))
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
        data.iter().try_for_each(|(name, values)| self.learner.set(name, values))
    }
}

/// What should be known of the numbers that an experiment ends with.
fn notes(settings: &Settings) -> Vec<String> {
    let (pinned, one) = (settings.warp.fix_first, settings.data.patches == 1);
    let note = match settings.warp.method {
        Method::None => return vec![],
        _ if !pinned => {
            "no patch is pinned (`warp.fix_first`), so that corner errors hold what all patches moved together"
        }
        _ if one => "there is one patch, and it is pinned (`warp.fix_first`): nothing is aligned",
        _ => return vec![],
    };
    vec![note.to_string()]
}

impl Training for Trainer {
    fn learner(&self) -> &Learner {
        &self.learner
    }
    fn learner_mut(&mut self) -> &mut Learner {
        &mut self.learner
    }
    fn training_program(&self) -> ProgramId {
        self.train
    }
    fn measure(&mut self) -> Result<Entry, Error> {
        let (entry, _) = self.read_entry(self.train)?;
        Ok(entry)
    }
    fn notes(&self) -> &[String] {
        &self.notes
    }
    fn flops(&self) -> f64 {
        self.flops
    }
    fn rows(&self) -> usize {
        self.settings.data.points_per_patch.of(self.data.grid.crop_pixels())
    }
    fn work(&self) -> String {
        format!("{} points a patch", self.rows())
    }
    fn write_data(&self, folder: &RunFolder) -> Result<(), Error> {
        results::write_data(folder, &self.settings, &self.data)
    }
    fn write_frame(&mut self, folder: &RunFolder) -> Result<(), Error> {
        results::write_frame(folder, self)
    }
    fn write_evaluation(&mut self, folder: &RunFolder, watch: Watch) -> Result<evaluation::Evaluation, Error> {
        watch.check()?;
        let found = self.evaluate()?;
        results::write_evaluation(folder, &self.settings, &self.data.grid, &found)
    }
    fn finish(
        &mut self,
        folder: &RunFolder,
        layered: &Layered,
        metrics: &mut Metrics,
        seconds: &dyn Fn() -> f64,
        watch: Watch,
    ) -> Result<(), Error> {
        watch.check()?;
        self.settle()?;
        let found = self.evaluate()?;
        let warps = found.warps.iter().map(|w| std::array::from_fn(|i| w.0[(i / 3, i % 3)])).collect();
        metrics.last = Some(Final { entry: found.entry.clone(), seconds: seconds(), warps });
        let measured = results::write_evaluation(folder, &self.settings, &self.data.grid, &found)?;
        results::write_results(folder, layered, self, &found, &measured, metrics)
    }
    fn trial(&mut self) -> Result<Trial, Error> {
        let frame = timed(|| self.picture(false).map(drop))?;
        let evaluation = timed(|| {
            self.evaluate()?;
            self.picture(true).map(drop)
        })?;
        Ok(Trial { recurring: vec![(self.settings.run.picture_every, frame)], evaluation })
    }
    fn summary(&self, last: &Final) -> String {
        let Measured::Planar { patch_psnr_db, corner_error_px, .. } = &last.entry.measured else {
            return String::new();
        };
        let errors: Vec<String> = corner_error_px.per_patch.iter().map(|e| format!("{e:.2}")).collect();
        let drawn = if self.settings.data.points_per_patch == Count::All { "" } else { ", measured on all pixels" };
        let (mean, steps, time) = (corner_error_px.mean, last.entry.step, crate::report::duration(last.seconds));
        format!(
            "corner error  {mean:.3} px  (patches: {})\npatch PSNR    {patch_psnr_db:.2} dB\nsteps         {steps} in {time}{drawn}\n",
            errors.join(", ")
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_numbers_mean_little_is_noted() {
        let noted = |all: &[&str]| {
            let mut layered = Layered::load("planar-l2g-small").unwrap();
            all.iter().for_each(|set| layered.set(set).unwrap());
            notes(&layered.settings).concat()
        };
        assert_eq!(noted(&[]), "");
        assert!(noted(&["warp.fix_first=false"]).starts_with("no patch is pinned"));
        assert!(noted(&["data.patches=1"]).ends_with("nothing is aligned"));
        assert_eq!(noted(&["data.patches=1", "warp.method=none"]), "");
    }
}
