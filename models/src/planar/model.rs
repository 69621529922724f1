//! The graphs of planar registration: one training step, the evaluation over all pixels, and the picture learned.
//!
//! With patch points x, their colours c, the warp w_b of patch b and the field f:
//!
//! ```text
//! y = w_b(x),   render = mean |f(y) - c|^2,   alignment = mean |y - T_b x|^2,   total = render + lambda alignment
//! ```
//!
//! T_b is the closed-form fit of y to x. The step trains on all pixels, or on some drawn anew in every step.

use crate::config::{Count, Settings};
use crate::fields::NeuralImage;
use crate::geometry::Grid;
use crate::training::optimise::{self, PROGRESS, STEP, Training};
use crate::warps::{self, Points, Registration, Warp};
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::random;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axes, Axis, Channels, Shape, Step, Tensor};
use std::sync::Arc;

/// Coordinates of the patch pixels, `[pixel] x 2`.
pub const GRID: &str = "data.grid";
/// Colours of the distorted patches, `[frame, pixel] x 3`.
pub const TARGET: &str = "data.target";
/// Coordinates at which [`PlanarModel::picture`] looks, `[view] x 2`.
pub fn view(pixels: usize) -> String {
    format!("data.view.{pixels}")
}
/// What tells the pixel draws of two seeds apart.
pub const SEED: &str = "data.seed";

/// Stream of the pixel draws.
const DRAW: u32 = 1;

/// Field, warp and codes, and how they make a step.
#[derive(Clone, Debug)]
pub struct PlanarModel {
    pub settings: Settings,
    pub grid: Grid,
    warp: Arc<dyn Warp>,
    field: NeuralImage,
    frame: Axis,
    pixel: Axis,
    code: Option<Parameter>,
    scales_loss: bool,
}

impl PlanarModel {
    pub fn new(settings: &Settings, grid: Grid, warp: Arc<dyn Warp>) -> PlanarModel {
        let frame = warp.frame().cloned().unwrap_or_else(|| Axis::new("frame", settings.data.patches));
        let pixel = Axis::new("pixel", grid.crop_pixels());
        let code = warps::codes(&*warp, &frame);
        let field = NeuralImage::new(&settings.field);
        let scales_loss = optimise::scales_loss(settings.run.precision, TargetKind::Gpu);
        PlanarModel { settings: settings.clone(), grid, warp, field, frame, pixel, code, scales_loss }
    }

    /// The model whose steps run on devices of this kind.
    pub fn for_target(mut self, target: TargetKind) -> PlanarModel {
        self.scales_loss = optimise::scales_loss(self.settings.run.precision, target);
        self
    }

    /// Everything that a checkpoint holds; not all of it need be trained.
    pub fn parameters(&self) -> Vec<Parameter> {
        self.field.parameters().into_iter().chain(self.warp_parameters()).collect()
    }

    fn warp_parameters(&self) -> impl Iterator<Item = Parameter> {
        self.code.clone().into_iter().chain(self.warp.parameters())
    }

    /// Points of every patch in one training step.
    pub fn points_per_patch(&self) -> usize {
        self.settings.data.points_per_patch.of(self.grid.crop_pixels())
    }

    /// Floating-point operations of one training step in the networks: six a weight and row, for the forward pass and
    /// the two products of the backward pass.
    pub fn flops(&self) -> f64 {
        let rows = self.settings.data.patches * self.points_per_patch();
        6.0 * rows as f64 * (weights(&self.parameters())) as f64
    }

    /// One training step: outputs `render`, `total`, `transform` and, where the warp has
    /// one, `alignment` and `penalty`; and an update of every trained parameter.
    pub fn train_step(&self) -> Step {
        let (at, target) = match self.settings.data.points_per_patch {
            Count::All => (self.all_points(), self.target()),
            Count::Of(_) => self.drawn_points(self.points_per_patch()),
        };
        let (found, render) = self.losses(&at, &target);
        let total = found.loss(&render, self.settings.loss.alignment);
        Step { outputs: losses_and_transform(&found, render, &total), updates: self.updates(&total) }
    }

    /// The same losses over all pixels of the patches, with the fields of both maps: `local` and `global` points and
    /// `color`, `[frame, pixel]` each.
    pub fn evaluation(&self) -> Step {
        let at = self.all_points();
        let found = self.register(&at);
        let color = self.field.color(&found.local, &progress());
        let render = mean_squared_error(&color, &self.target());
        let total = found.loss(&render, self.settings.loss.alignment);
        let fields = [("local", &found.local), ("global", &found.global), ("color", &color)];
        let all = Axes::new([self.frame.clone(), self.pixel.clone()]);
        let fields = fields.map(|(name, t)| (name.to_string(), t.broadcast_to(&all)));
        let outputs = losses_and_transform(&found, render, &total).into_iter().chain(fields).collect();
        Step { outputs, updates: vec![] }
    }

    /// The learned picture at `pixels` points: output `color`.
    pub fn picture(&self, pixels: usize) -> Step {
        let view = Tensor::data(view(pixels), Shape::new(&[&Axis::new("view", pixels)], 2));
        let color = self.field.color(&view, &progress());
        Step { outputs: vec![("color".to_string(), color)], updates: vec![] }
    }
    fn losses(&self, at: &Points, target: &Tensor) -> (Registration, Tensor) {
        let found = self.register(at);
        let color = self.field.color(&found.local, &progress());
        let render = mean_squared_error(&color, target);
        (found, render)
    }

    fn register(&self, at: &Points) -> Registration {
        let code = warps::code_tensor(self.code.as_ref());
        Registration::new(&*self.warp, at, None, &code, self.settings.warp.fix_first)
    }
    fn all_points(&self) -> Points {
        let xy = Tensor::data(GRID, Shape::new(&[&self.pixel], 2));
        Points::planar(self.frame.clone(), self.pixel.clone(), xy)
    }
    fn target(&self) -> Tensor {
        Tensor::data(TARGET, Shape::new(&[&self.frame, &self.pixel], 3))
    }

    /// `points` pixels a patch: the patch is cut into that many runs of pixels, and one is drawn from each.
    fn drawn_points(&self, points: usize) -> (Points, Tensor) {
        let point = Axis::new("point", points);
        let seed = Tensor::data(SEED, Shape::new(&[], 1).with_dtype(DType::U32));
        let step = Tensor::per_step(STEP, Shape::new(&[], 1).with_dtype(DType::U32));
        let jitter =
            random::uniform(&Axes::new([self.frame.clone(), point.clone()]), 1, DRAW, &step.wrapping_add(&seed));
        let pixels = self.pixel.size() as f64;
        let position = (Tensor::index(&point).to_f32() + jitter) * (pixels / points as f64);
        let index = position.clamp(0.0, pixels - 1.0).to_u32();
        let all = self.all_points();
        let xy = all.xy.take(&index, &self.pixel);
        (Points::planar(all.frame, point, xy), self.target().take(&index, &self.pixel))
    }

    fn updates(&self, total: &Tensor) -> Vec<(Tensor, Tensor)> {
        let (field, warp): (Vec<Parameter>, Vec<Parameter>) =
            (self.field.parameters(), self.warp_parameters().collect());
        let held = warps::held(&*self.warp, &self.settings.warp, self.code.as_ref(), &self.frame);
        let (optim, scaled) = (&self.settings.optim, self.scales_loss);
        Training { field: &field, warp: &warp, held, optim, scaled }.updates(total)
    }
}

fn progress() -> Tensor {
    Tensor::input(PROGRESS, Role::PerStep, Shape::new(&[], 1))
}

fn losses_and_transform(found: &Registration, render: Tensor, total: &Tensor) -> Vec<(String, Tensor)> {
    let mut outputs = vec![("render", render), ("total", total.clone()), ("transform", found.transform.clone())];
    outputs.extend(found.residual.clone().map(|r| ("alignment", r)));
    outputs.extend(found.penalty.clone().map(|(p, _)| ("penalty", p)));
    outputs.into_iter().map(|(name, t)| (name.to_string(), t)).collect()
}

/// Entries of all weight matrices among the parameters, biases and codes left out.
pub fn weights(parameters: &[Parameter]) -> usize {
    let matrix = |p: &Parameter| match p.tensor.channels() {
        Channels::Matrix(rows, columns) => rows * columns,
        Channels::Vector(_) => 0,
    };
    parameters.iter().map(matrix).sum()
}
