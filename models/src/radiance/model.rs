//! The graphs of registration in space: one training step, a rendered view, and one step of a test view's refinement.
//!
//! With rays r of all frames, their colours c, the warp w and the field rendered along a ray:
//!
//! ```text
//! render = mean |Render(w(r)) - c|^2,   alignment = mean |w(x) - T_b x|^2 over pixels and centres,   total = render + lambda alignment
//! ```
//!
//! T_b is the rigid motion of frame b fitted to the map (L2G-NeRF's global alignment, the invertible warp's rigidity prior).
//! Every step sees all frames, the same pixels in each. The fitted poses are kept as a state: near and far follow them in the
//! next step, and evaluation starts from them.

use super::rays::{Cameras, ImageSize, Rays, range_of};
use crate::config::{DepthSettings, RadianceSettings, SceneSettings, Settings, TrainSettings};
use crate::fields::RadianceField;
use crate::scene::View;
use crate::training::optimise::{PROGRESS, STEP, hold_first, updates};
use crate::warps::{self, Registration, Warp};
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::functions::composite::{Composite, Spread, composite, depth_samples};
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::matrix::compose_poses;
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::ops::random;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axes, Axis, Shape, Step, Tensor};
use std::sync::Arc;

/// All training images, `[frame, pixel] x 1`, packed as by [`packed`].
pub const IMAGES: &str = "data.images";
/// fx, fy, cx, cy of every frame.
pub const INTRINSICS: &str = "data.intrinsics";
/// Poses that training starts from, `[frame] x (3, 4)`.
pub const POSES: &str = "data.poses";
/// What tells the draws of two seeds apart.
pub const SEED: &str = "data.seed";
/// What the last step found between the poses that training started from and the true ones, `[frame] x (3, 4)`.
pub const FOUND: &str = "camera.found";
/// The camera of a rendered view: its pose, intrinsics, first pixel of the part that is rendered, near and far.
pub const VIEW_POSE: &str = "view.pose";
pub const VIEW_INTRINSICS: &str = "view.intrinsics";
pub const VIEW_FIRST: &str = "view.first";
pub const VIEW_RANGE: &str = "view.range";
/// The image that a view is refined against, `[pixel] x 1`, packed as by [`packed`], and the twist that refines its pose.
pub const VIEW_IMAGE: &str = "view.image";
pub const TWIST: &str = "view.twist";
pub const TWIST_LR: &str = "view.lr";
pub const TWIST_BIAS1: &str = "view.bias1";
pub const TWIST_BIAS2: &str = "view.bias2";
/// Points whose density is asked for, `[place] x 3`.
pub const DENSITY_POINTS: &str = "density.points";

/// Streams of the random numbers.
const PIXELS: u32 = 2;
const JITTER: u32 = 3;
const DENSITY: u32 = 4;

/// Field, warp and codes, and how they make a step.
#[derive(Clone, Debug)]
pub struct RadianceModel {
    pub settings: Settings,
    pub size: ImageSize,
    train: TrainSettings,
    warp: Arc<dyn Warp>,
    field: RadianceField,
    frame: Axis,
    pixel: Axis,
    code: Option<Parameter>,
}

/// A 3D experiment without its sections.
#[derive(Debug, thiserror::Error)]
#[error("these settings are not of a 3D experiment: they have no sections `scene`, `train` and `radiance`")]
pub struct NotInSpace;

/// The sections of a 3D experiment.
pub fn sections(settings: &Settings) -> Result<(&SceneSettings, &TrainSettings, &RadianceSettings), NotInSpace> {
    match (&settings.scene, &settings.train, &settings.radiance) {
        (Some(scene), Some(train), Some(radiance)) => Ok((scene, train, radiance)),
        _ => Err(NotInSpace),
    }
}

impl RadianceModel {
    /// A model of `views` images of one size.
    pub fn new(
        settings: &Settings,
        size: ImageSize,
        views: usize,
        warp: Arc<dyn Warp>,
    ) -> Result<RadianceModel, NotInSpace> {
        let (_, train, radiance) = sections(settings)?;
        let frame = warp.frame().cloned().unwrap_or_else(|| Axis::new("frame", views));
        let pixel = Axis::new("pixel", size.pixels());
        let code = warps::codes(&*warp, &frame);
        let field = RadianceField::new(&settings.field, radiance);
        let (settings, train) = (settings.clone(), train.clone());
        Ok(RadianceModel { settings, size, train, warp, field, frame, pixel, code })
    }

    /// The axis of the training views.
    pub fn frame(&self) -> &Axis {
        &self.frame
    }

    /// Everything that is trained.
    pub fn parameters(&self) -> Vec<Parameter> {
        self.field.parameters().into_iter().chain(self.warp_parameters()).collect()
    }

    fn warp_parameters(&self) -> Vec<Parameter> {
        self.code.clone().into_iter().chain(self.warp.parameters()).collect()
    }

    /// Rays of every image in one step.
    pub fn rays_per_view(&self) -> usize {
        (self.train.rays / self.frame.size()).clamp(1, self.size.pixels())
    }

    /// Floating-point operations of one training step in the networks: six a weight and row.
    pub fn flops(&self) -> f64 {
        let rays = (self.frame.size() * self.rays_per_view()) as f64;
        let of = |parameters: &[Parameter]| crate::planar::model::weights(parameters) as f64;
        6.0 * rays * (self.train.samples as f64 * of(&self.field.parameters()) + of(&self.warp.parameters()))
    }

    /// One training step: outputs `render`, `total`, `found` and, where the warp has one, `alignment` and `penalty`; and an
    /// update of every trained parameter.
    #[track_caller]
    pub fn train_step(&self) -> Step {
        let ray = Axis::new("ray", self.rays_per_view());
        let step = seeded_step();
        let mut drawn = vec![ray.clone()];
        drawn.extend((!self.train.shared_pixels).then(|| self.frame.clone()));
        let draw = random::uniform(&Axes::new(drawn), 1, PIXELS, &step);
        let pixels = self.size.pixels() as f64;
        let index = (draw * pixels).clamp(0.0, pixels - 1.0).to_u32();
        let shape = Shape::new(&[&self.frame, &self.pixel], 1).with_dtype(DType::U32);
        self.step_at(&ray, &index, &on_white(&Tensor::data(IMAGES, shape).take(&index, &self.pixel)))
    }

    /// One training step on the pixels `index` along `ray`, and along the frames if theirs differ, whose colours are `[frame, ray] x 3`.
    #[track_caller]
    pub fn step_at(&self, ray: &Axis, index: &Tensor, colors: &Tensor) -> Step {
        let intrinsics = Tensor::data(INTRINSICS, Shape::new(&[&self.frame], 4));
        let rough = Tensor::data(POSES, Shape::new(&[&self.frame], (3, 4)));
        let cameras = Cameras::new(&self.frame, ray, index, self.size, &intrinsics, &rough);
        let none = Tensor::scalar(0.0);
        let code = self.code.as_ref().map_or(&none, |c| &c.tensor);
        let pinned = self.settings.warp.fix_first;
        let found = Registration::new(&*self.warp, &cameras.pixels, Some(&cameras.centers), code, pinned);
        let center = found.centers.as_ref().unwrap_or(&found.local);
        let rays = Rays::through(center, &found.local);
        let known = Tensor::input(FOUND, Role::State, Shape::new(&[&self.frame], (3, 4)));
        let range = match self.train.depth {
            DepthSettings::Auto => range_of(&compose_poses(&rough, &known), &self.frame),
            _ => self.fixed_range(),
        };
        let seen = self.render(&rays, &range, &Axes::new([self.frame.clone(), ray.clone()]), true);
        let render = mean_squared_error(&seen, colors);
        let weight = self.settings.loss.alignment;
        let aligned = match &found.residual {
            Some(residual) if weight > 0.0 => &render + residual * weight,
            _ => render.clone(),
        };
        let total = match &found.penalty {
            Some((penalty, weight)) if *weight > 0.0 => aligned + penalty * *weight,
            _ => aligned,
        };
        let transform = found.transform.broadcast_to(&Axes::new([self.frame.clone()]));
        let mut outputs = vec![("render", render), ("total", total.clone()), ("found", transform.clone())];
        outputs.extend(found.residual.map(|r| ("alignment", r)));
        outputs.extend(found.penalty.map(|(p, _)| ("penalty", p)));
        let outputs = outputs.into_iter().map(|(name, t)| (name.to_string(), t)).collect();
        let mut updates = updates(&total, &self.field.parameters(), &self.warp_parameters());
        if let (true, Some(code)) = (pinned && self.warp.zero_code_is_identity(), &self.code) {
            hold_first(&mut updates, &code.tensor, &self.frame);
        }
        updates.push((known, transform));
        Step { outputs, updates }
    }

    /// Part of a view, `pixels` of them from [`VIEW_FIRST`] on: outputs `color`, `depth` and `opacity`.
    #[track_caller]
    pub fn view(&self, pixels: usize) -> Step {
        let point = Axis::new("view", pixels);
        let first = Tensor::per_step(VIEW_FIRST, Shape::new(&[], 1).with_dtype(DType::U32));
        let rays = self.view_rays(&point, &Tensor::index(&point).wrapping_add(&first), &view_pose());
        let seen = self.see(&rays, &self.view_range(), &Axes::new([point]), false);
        let outputs = [("color", seen.color), ("depth", seen.depth), ("opacity", seen.opacity)];
        Step { outputs: outputs.map(|(name, t)| (name.to_string(), t)).into(), updates: vec![] }
    }

    /// One step of the refinement of a test view's pose against its image, `P Exp(twist)` with the field as it is: Adam on
    /// the twist alone. Output `render`.
    #[track_caller]
    pub fn refinement(&self) -> Step {
        let point = Axis::new("view", self.train.rays.min(self.size.pixels()));
        let draw = random::uniform(&Axes::new([point.clone()]), 1, PIXELS, &seeded_step());
        let pixels = self.size.pixels() as f64;
        let index = (draw * pixels).clamp(0.0, pixels - 1.0).to_u32();
        let twist = Tensor::input(TWIST, Role::State, Shape::new(&[], 6));
        let rays = self.view_rays(&point, &index, &compose_poses(&view_pose(), &se3_exp(&twist)));
        let seen = self.render(&rays, &self.view_range(), &Axes::new([point]), true);
        let image = Tensor::data(VIEW_IMAGE, Shape::new(&[&self.pixel], 1).with_dtype(DType::U32));
        let render = mean_squared_error(&seen, &on_white(&image.take(&index, &self.pixel)));
        let gradient = grad(&render, &[&twist]).remove(0);
        let scalar = |name| Tensor::per_step(name, Shape::new(&[], 1));
        let scalars = StepScalars { lr: scalar(TWIST_LR), bias1: scalar(TWIST_BIAS1), bias2: scalar(TWIST_BIAS2) };
        let old = Moments::of(&twist);
        let (value, new) = Adam::default().update(&twist, &gradient, &old, &scalars);
        Step {
            outputs: vec![("render".to_string(), render)],
            updates: vec![(twist, value), (old.m, new.m), (old.v, new.v)],
        }
    }

    /// The field at `count` points of the learned world, [`DENSITY_POINTS`]: output `density`.
    #[track_caller]
    pub fn density(&self, count: usize) -> Step {
        let points = Tensor::data(DENSITY_POINTS, Shape::new(&[&Axis::new("place", count)], 3));
        Step { outputs: vec![("density".to_string(), self.field.density_at(&points, &progress()))], updates: vec![] }
    }

    #[track_caller]
    fn view_rays(&self, point: &Axis, index: &Tensor, pose: &Tensor) -> Rays {
        let intrinsics = Tensor::per_step(VIEW_INTRINSICS, Shape::new(&[], 4));
        let cameras = Cameras::new(&self.frame, point, index, self.size, &intrinsics, pose);
        Rays::through(&cameras.centers.position, &cameras.pixels.position)
    }

    #[track_caller]
    fn view_range(&self) -> (Tensor, Tensor) {
        match self.train.depth {
            DepthSettings::Auto => {
                let range = Tensor::per_step(VIEW_RANGE, Shape::new(&[], 2));
                (range.ch(0), range.ch(1))
            }
            _ => self.fixed_range(),
        }
    }

    #[track_caller]
    fn fixed_range(&self) -> (Tensor, Tensor) {
        let [near, far] = self.train.range;
        (Tensor::scalar(near), Tensor::scalar(far))
    }

    /// Colours of rays along `axes`, on the background where that is opaque.
    #[track_caller]
    fn render(&self, rays: &Rays, range: &(Tensor, Tensor), axes: &Axes, training: bool) -> Tensor {
        self.see(rays, range, axes, training).color
    }

    #[track_caller]
    fn see(&self, rays: &Rays, (near, far): &(Tensor, Tensor), axes: &Axes, training: bool) -> Composite {
        let sample = Axis::new("sample", self.train.samples);
        let along = axes.union(&Axes::new([sample.clone()]));
        let jitter = match training && self.train.stratified {
            true => random::uniform(&along, 1, JITTER, &seeded_step()),
            false => Tensor::scalar(0.5),
        };
        let spread = match self.train.depth {
            DepthSettings::Inverse => Spread::Inverse,
            DepthSettings::Metric | DepthSettings::Auto | DepthSettings::Scene => Spread::Metric,
        };
        let depth = depth_samples(&sample, &jitter, near, far, spread);
        let length = rays.length();
        let unit = &rays.direction / length.max(&Tensor::scalar(1e-12));
        let noise = (training && self.train.density_noise > 0.0)
            .then(|| random::normal(&along, 1, DENSITY, &seeded_step()) * self.train.density_noise);
        let field = self.field.at(&rays.at(&depth), &unit, &progress(), noise.as_ref());
        let mut seen = composite(&field.color, &field.density, &depth, &length, &sample);
        if self.train.opaque_background {
            // White, as the images were composited on.
            seen.color = seen.color + (1.0 - &seen.opacity);
        }
        seen
    }
}

/// Pixels as the graph takes them: red, green, blue and opacity from the lowest byte up.
pub fn packed(view: &View) -> impl Iterator<Item = u32> + '_ {
    view.pixels.iter().map(|p| u32::from_le_bytes(*p))
}

/// Colours of packed pixels on white, as [`View::rgb`].
#[track_caller]
fn on_white(pixels: &Tensor) -> Tensor {
    let byte =
        |i: u32| pixels.shift_right(&Tensor::integers(&[8 * i])).bit_and(&Tensor::integers(&[255])).to_f32() / 255.0;
    let opacity = byte(3);
    concat([&byte(0), &byte(1), &byte(2)]) * &opacity + (1.0 - &opacity)
}

/// Initial values of the state [`FOUND`]: nothing found yet.
pub fn nothing_found(views: usize) -> Vec<f32> {
    let one = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0.];
    (0..views).flat_map(|_| one).collect()
}

#[track_caller]
fn view_pose() -> Tensor {
    Tensor::per_step(VIEW_POSE, Shape::new(&[], (3, 4)))
}

#[track_caller]
fn progress() -> Tensor {
    Tensor::per_step(PROGRESS, Shape::new(&[], 1))
}

/// The number of the step, and which run it belongs to.
#[track_caller]
fn seeded_step() -> Tensor {
    let seed = Tensor::data(SEED, Shape::new(&[], 1).with_dtype(DType::U32));
    Tensor::per_step(STEP, Shape::new(&[], 1).with_dtype(DType::U32)).wrapping_add(&seed)
}
