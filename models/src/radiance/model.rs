//! The graphs of registration in space: one training step, a rendered view, and one step of a test view's refinement.
//!
//! With rays r of all frames, their colours c, the warp w and the field rendered along a ray:
//!
//! ```text
//! render = mean |Render(w(r)) - c|^2,   alignment = mean |w(x) - T_b x|^2 over pixels and centres,   total = render + lambda alignment
//! ```
//!
//! With hierarchical sampling the fine field's picture gives a second render term, of the same weight.
//!
//! T_b is the rigid motion of frame b fitted to the map (L2G-NeRF's global alignment, the invertible warp's rigidity prior).
//! Every step sees all frames, by default the same pixels in each, or those that a map of errors draws (`error_map.rs`). The
//! fitted poses are kept as a state: near and far follow them in the next step, and evaluation starts from them.

use super::error_map::ErrorMap;
use super::lens::Lens;
use super::rays::{Cameras, ImageSize, Rays, range_of};
use super::rendering::{Purpose, Rendering, Seen};
use super::shear::Shear;
use crate::config::{DepthSettings, Method, RadianceSettings, SceneSettings, Settings, TrainSettings, WarpSettings};
use crate::scene::View;
use crate::training::optimise::{STEP, Training, scales_loss, update_of};
use crate::warps::{self, Registration, Warp};
use raygrad_compiler::functions::adam::StepScalars;
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::matrix::compose_poses;
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::fuse::TargetKind;
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
/// Rough poses that the warp starts from, `[frame] x (3, 4)`: a state, since lost cameras are given others.
pub const POSES: &str = "data.poses";
/// What tells the draws of two seeds apart.
pub const SEED: &str = "data.seed";
/// What the last step found between the rough poses and the true ones, `[frame] x (3, 4)`.
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
/// Pixels at which the poses of the training views are fitted once more.
pub const FIT_PIXELS: &str = "fit.pixels";
/// Points whose density is asked for, `[place] x 3`.
pub const DENSITY_POINTS: &str = "density.points";

/// Stream of the random numbers that choose pixels.
const PIXELS: u32 = 2;

/// Field, warp and codes, and how they make a step.
#[derive(Clone, Debug)]
pub struct RadianceModel {
    pub settings: Settings,
    pub size: ImageSize,
    train: TrainSettings,
    warp: Arc<dyn Warp>,
    rendering: Rendering,
    lens: Lens,
    shear: Shear,
    frame: Axis,
    pixel: Axis,
    code: Option<Parameter>,
    scales_loss: bool,
}

/// Settings of the plane where those of space are due.
#[derive(Debug, thiserror::Error)]
#[error(
    "this experiment is one of the plane, without cameras, views and surfaces: its settings have no sections `scene`, `train` and \
     `radiance`"
)]
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
        let (_, train, _) = sections(settings)?;
        let frame = warp.frame().cloned().unwrap_or_else(|| Axis::new("frame", views));
        let pixel = Axis::new("pixel", size.pixels());
        let code = warps::codes(&*warp, &frame);
        let (lens, shear) =
            (Lens::new(train.refine_lens), Shear::new(train.shear && settings.warp.method != Method::None));
        let rendering = Rendering::new(settings, &shear)?;
        let scales_loss = scales_loss(settings.run.precision, TargetKind::Gpu);
        let (settings, train) = (settings.clone(), train.clone());
        Ok(RadianceModel { settings, size, train, warp, rendering, lens, shear, frame, pixel, code, scales_loss })
    }

    /// The model whose steps run on devices of this kind.
    pub fn for_target(mut self, target: TargetKind) -> RadianceModel {
        self.scales_loss = scales_loss(self.settings.run.precision, target);
        self
    }

    /// The axis of the training views.
    pub fn frame(&self) -> &Axis {
        &self.frame
    }

    /// Everything that is trained.
    pub fn parameters(&self) -> Vec<Parameter> {
        self.rendering.parameters().into_iter().chain(self.camera_parameters()).collect()
    }

    /// What is trained at the warp's rate.
    fn camera_parameters(&self) -> Vec<Parameter> {
        let own = self.code.iter().chain(&self.lens.correction).chain(&self.shear.parameter);
        own.cloned().chain(self.warp.parameters()).collect()
    }

    /// Rays of every image in one step.
    pub fn rays_per_view(&self) -> usize {
        (self.train.rays / self.frame.size()).clamp(1, self.size.pixels())
    }

    /// Floating-point operations of one training step in the networks: six a weight and row.
    pub fn flops(&self) -> f64 {
        let rays = (self.frame.size() * self.rays_per_view()) as f64;
        let of_warp = crate::planar::model::weights(&self.warp.parameters()) as f64;
        6.0 * rays * (self.rendering.weights_per_ray() + of_warp)
    }

    /// One training step: outputs `render`, `total`, `found`, with a fine field `render_fine`, and, where the warp has one,
    /// `alignment` and `penalty`; and an update of every trained parameter.
    pub fn train_step(&self) -> Step {
        let ray = Axis::new("ray", self.rays_per_view());
        let step = seeded_step();
        let shape = Shape::new(&[&self.frame, &self.pixel], 1).with_dtype(DType::U32);
        let colors = |index: &Tensor| on_white(&Tensor::data(IMAGES, shape.clone()).take(index, &self.pixel));
        if self.train.error_map > 0 {
            let (map, index) = ErrorMap::draw(&self.frame, &ray, self.train.error_map, self.size, &step);
            return self.step_of(&ray, &index, &colors(&index), Some(map));
        }
        let mut drawn = vec![ray.clone()];
        drawn.extend((!self.train.shared_pixels).then(|| self.frame.clone()));
        let draw = random::uniform(&Axes::new(drawn), 1, PIXELS, &step);
        let pixels = self.size.pixels() as f64;
        let index = (draw * pixels).clamp(0.0, pixels - 1.0).to_u32();
        self.step_of(&ray, &index, &colors(&index), None)
    }

    /// One training step on the pixels `index` along `ray`, and along the frames if theirs differ; `colors` are theirs,
    /// `[frame, ray] x 3`.
    pub fn step_at(&self, ray: &Axis, index: &Tensor, colors: &Tensor) -> Step {
        self.step_of(ray, index, colors, None)
    }

    /// The same where a map of errors has drawn the pixels.
    fn step_of(&self, ray: &Axis, index: &Tensor, colors: &Tensor, map: Option<ErrorMap>) -> Step {
        let (rough, intrinsics) = (self.rough_poses(), self.intrinsics());
        let found = self.registered(ray, index);
        let center = found.centers.as_ref().unwrap_or(&found.local);
        let rays = self.shear.turned(Rays::through(center, &found.local));
        let known = self.known_poses();
        let range = match self.train.depth {
            DepthSettings::Auto => range_of(&compose_poses(&rough, &known), &self.frame),
            _ => self.fixed_range(),
        };
        let axes = Axes::new([self.frame.clone(), ray.clone()]);
        let seen = self.rendering.render(&rays, &intrinsics, &range, &axes, Purpose::Training);
        let Pictures { render, fine, both } = Pictures::new(&seen, colors);
        let total = found.loss(&both, self.settings.loss.alignment);
        let transform = self.found_poses(&found.transform);
        let mut outputs = vec![("render", render), ("total", total.clone()), ("found", transform.clone())];
        outputs.extend(fine.map(|f| ("render_fine", f)));
        outputs.extend(found.residual.map(|r| ("alignment", r)));
        outputs.extend(found.penalty.map(|(p, _)| ("penalty", p)));
        let outputs = outputs.into_iter().map(|(name, t)| (name.to_string(), t)).collect();
        let (field, warp) = (self.rendering.parameters(), self.camera_parameters());
        let held = warps::held(&*self.warp, &self.settings.warp, self.code.as_ref(), &self.frame);
        let (optim, scaled) = (&self.settings.optim, self.scales_loss);
        let mut updates = Training { field: &field, warp: &warp, held, optim, scaled }.updates(&total);
        updates.push((known, transform));
        updates.extend(map.map(|map| map.updated(&seen.best().color, colors)));
        Step { outputs, updates }
    }

    /// Where the warp as it is moves the pixels `index` along `ray` of the training views, and their centres.
    fn registered(&self, ray: &Axis, index: &Tensor) -> Registration {
        let cameras = Cameras::new(&self.frame, ray, index, self.size, &self.intrinsics(), &self.rough_poses());
        let code = warps::code_tensor(self.code.as_ref());
        let WarpSettings { origin, fix_first, .. } = self.settings.warp;
        Registration::about(origin, &*self.warp, &cameras.pixels, Some(&cameras.centers), &code, fix_first)
    }

    /// The poses of the training views fitted once more, at the pixels [`FIT_PIXELS`], so many of them in every view: an update of
    /// [`FOUND`], which is the output `found`.
    pub fn fit(&self, pixels: usize) -> Step {
        let ray = Axis::new("ray", pixels);
        let index = Tensor::data(FIT_PIXELS, Shape::new(&[&ray], 1).with_dtype(DType::U32));
        let transform = self.found_poses(&self.registered(&ray, &index).transform);
        Step { outputs: vec![("found".into(), transform.clone())], updates: vec![(self.known_poses(), transform)] }
    }

    /// Part of a view, `pixels` of them from [`VIEW_FIRST`] on: outputs `color`, `depth` and `opacity`.
    pub fn view(&self, pixels: usize) -> Step {
        let point = Axis::new("view", pixels);
        let first = Tensor::per_step(VIEW_FIRST, Shape::new(&[], 1).with_dtype(DType::U32));
        let rays = self.view_rays(&point, &Tensor::index(&point).wrapping_add(&first), &view_pose());
        let seen = self.see(&rays, &Axes::new([point]), Purpose::View);
        let seen = seen.best();
        let outputs = [("color", &seen.color), ("depth", &seen.depth), ("opacity", &seen.opacity)];
        Step { outputs: outputs.map(|(name, t)| (name.to_string(), t.clone())).into(), updates: vec![] }
    }

    /// One step of the refinement of a view's pose against its image, `P Exp(twist)` with the field as it is: Adam on the
    /// twist alone. Output `render`, with a fine field the sum of both pictures' terms.
    pub fn refinement(&self) -> Step {
        let twist = Tensor::input(TWIST, Role::State, Shape::new(&[], 6));
        let render = self.photo_error(&compose_poses(&view_pose(), &se3_exp(&twist)));
        let scalar = |name| Tensor::per_step(name, Shape::new(&[], 1));
        let scalars = StepScalars { lr: scalar(TWIST_LR), bias1: scalar(TWIST_BIAS1), bias2: scalar(TWIST_BIAS2) };
        let updates = update_of(&render, &twist, &scalars, self.scales_loss);
        Step { outputs: vec![("render".to_string(), render)], updates }
    }

    /// How far the model's picture of a view is from its image, at random pixels: output `render` as of [`Self::refinement`].
    pub fn comparison(&self) -> Step {
        Step { outputs: vec![("render".to_string(), self.photo_error(&view_pose()))], updates: vec![] }
    }

    /// Mean squared error against [`VIEW_IMAGE`] of random pixels seen from `pose`.
    fn photo_error(&self, pose: &Tensor) -> Tensor {
        let point = Axis::new("view", self.train.rays.min(self.size.pixels()));
        let draw = random::uniform(&Axes::new([point.clone()]), 1, PIXELS, &seeded_step());
        let pixels = self.size.pixels() as f64;
        let index = (draw * pixels).clamp(0.0, pixels - 1.0).to_u32();
        let rays = self.view_rays(&point, &index, pose);
        let seen = self.see(&rays, &Axes::new([point]), Purpose::Refinement);
        let image = Tensor::data(VIEW_IMAGE, Shape::new(&[&self.pixel], 1).with_dtype(DType::U32));
        Pictures::new(&seen, &on_white(&image.take(&index, &self.pixel))).both
    }

    /// The field at `count` points of the learned world, [`DENSITY_POINTS`]: output `density`.
    pub fn density(&self, count: usize) -> Step {
        let points = Tensor::data(DENSITY_POINTS, Shape::new(&[&Axis::new("place", count)], 3));
        Step { outputs: vec![("density".to_string(), self.rendering.density_at(&points))], updates: vec![] }
    }

    /// What is found between the rough poses and the true ones where the warp does `transform`.
    fn found_poses(&self, transform: &Tensor) -> Tensor {
        self.shear.turned_pose(transform, &self.rough_poses()).broadcast_to(&Axes::new([self.frame.clone()]))
    }
    fn rough_poses(&self) -> Tensor {
        Tensor::input(POSES, Role::State, Shape::new(&[&self.frame], (3, 4)))
    }
    fn known_poses(&self) -> Tensor {
        Tensor::input(FOUND, Role::State, Shape::new(&[&self.frame], (3, 4)))
    }

    /// The lenses of the training views.
    fn intrinsics(&self) -> Tensor {
        self.lens.corrected(&Tensor::data(INTRINSICS, Shape::new(&[&self.frame], 4)))
    }

    /// The lens of a rendered view.
    fn view_intrinsics(&self) -> Tensor {
        self.lens.corrected(&Tensor::per_step(VIEW_INTRINSICS, Shape::new(&[], 4)))
    }
    fn view_rays(&self, point: &Axis, index: &Tensor, pose: &Tensor) -> Rays {
        let cameras = Cameras::new(&self.frame, point, index, self.size, &self.view_intrinsics(), pose);
        Rays::through(&cameras.centers.position, &cameras.pixels.position)
    }
    fn view_range(&self) -> (Tensor, Tensor) {
        match self.train.depth {
            DepthSettings::Auto => {
                let range = Tensor::per_step(VIEW_RANGE, Shape::new(&[], 2));
                (range.ch(0), range.ch(1))
            }
            _ => self.fixed_range(),
        }
    }
    fn fixed_range(&self) -> (Tensor, Tensor) {
        let [near, far] = self.train.range;
        (Tensor::scalar(near), Tensor::scalar(far))
    }

    /// What the rays of a rendered view see.
    fn see(&self, rays: &Rays, axes: &Axes, purpose: Purpose) -> Seen {
        self.rendering.render(rays, &self.view_intrinsics(), &self.view_range(), axes, purpose)
    }
}

/// How far the pictures of the fields are from colours.
struct Pictures {
    render: Tensor,
    fine: Option<Tensor>,
    /// Their sum.
    both: Tensor,
}

impl Pictures {
    fn new(seen: &Seen, colors: &Tensor) -> Pictures {
        let render = mean_squared_error(&seen.coarse.color, colors);
        let fine = seen.fine.as_ref().map(|f| mean_squared_error(&f.color, colors));
        let both = fine.as_ref().map_or(render.clone(), |f| &render + f);
        Pictures { render, fine, both }
    }
}

/// Pixels as the graph takes them: red, green, blue and opacity from the lowest byte up.
pub fn packed(view: &View) -> impl Iterator<Item = u32> + '_ {
    view.pixels.iter().map(|p| u32::from_le_bytes(*p))
}

/// Colours of packed pixels on white, as [`View::rgb`].
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
fn view_pose() -> Tensor {
    Tensor::per_step(VIEW_POSE, Shape::new(&[], (3, 4)))
}

/// The number of the step, and which run it belongs to.
pub(super) fn seeded_step() -> Tensor {
    let seed = Tensor::data(SEED, Shape::new(&[], 1).with_dtype(DType::U32));
    Tensor::per_step(STEP, Shape::new(&[], 1).with_dtype(DType::U32)).wrapping_add(&seed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;
    use raygrad_compiler::reference::{Array, Bindings, Data, evaluate};

    #[test]
    fn packed_pixels_have_the_colors_of_the_view() {
        let pixels = vec![[255, 128, 0, 255], [10, 200, 90, 51], [1, 2, 3, 0], [0, 0, 255, 254]];
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0, height: 2, width: 2, distortion: None };
        let view = View {
            name: "v".into(),
            file: "v.png".into(),
            file_size: [1, 1],
            pixels,
            transparent: true,
            intrinsics,
            removed_distortion: None,
            pose: None,
            mask: None,
            depth: None,
        };
        let all = Tensor::data("pixels", Shape::new(&[&Axis::new("pixel", 4)], 1).with_dtype(DType::U32));
        let bindings: Bindings =
            [("pixels".to_string(), Array::integers(all.shape(), packed(&view).collect()))].into_iter().collect();
        let found = evaluate(&[on_white(&all)], &bindings).unwrap().remove(0);
        let Data::F(found) = found.data else { panic!("colours are floats") };
        assert_eq!(found.len(), 12);
        for (a, b) in found.iter().zip(view.rgb()) {
            assert!((a - f64::from(b)).abs() < 1e-6, "{found:?}");
        }
    }
}
