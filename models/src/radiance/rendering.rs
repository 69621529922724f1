//! What rays see: samples of a field, composited; with hierarchical sampling a second, fine field too, at those samples and at
//! more of them where the first, coarse one found weight (Mildenhall et al., NeRF, ECCV 2020, section 5.2).
//!
//! Both fields are trained at once, each by its own picture. What is shown and measured is the fine one's.

use super::model::{NotInSpace, sections, seeded_step};
use super::rays::Rays;
use super::shear::Shear;
use crate::config::{DepthSettings, Settings, TrainSettings};
use crate::fields::RadianceField;
use crate::planar::model::weights;
use crate::training::optimise::PROGRESS;
use raygrad_compiler::functions::composite::{Composite, Spread, composite_above, depth_samples};
use raygrad_compiler::functions::hierarchical::{fine_depths, merge_depths};
use raygrad_compiler::functions::mlp::Parameter;
use raygrad_compiler::ops::random;
use raygrad_compiler::{Axes, Axis, Shape, Tensor};

/// Streams of the random numbers.
const JITTER: u32 = 3;
const DENSITY: u32 = 4;
const FINE_DENSITY: u32 = 7;
/// Keeps quotients of composited depths finite.
const NO_OPACITY: f64 = 1e-10;

/// What rays are rendered for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Of the fields: samples are jittered, and densities noisy.
    Training,
    /// Of a pose alone, with the fields as they are: samples are jittered.
    Refinement,
    /// Nothing is random.
    View,
}

/// The fields, and how rays go through them.
#[derive(Clone, Debug)]
pub struct Rendering {
    train: TrainSettings,
    /// Share of the light below which a rendered view's rays end.
    stop_below: f64,
    shear: Shear,
    coarse: RadianceField,
    fine: Option<RadianceField>,
}

/// What rays see.
#[derive(Clone, Debug)]
pub struct Seen {
    pub coarse: Composite,
    pub fine: Option<Composite>,
}

impl Seen {
    /// What is shown and measured.
    pub fn best(&self) -> &Composite {
        self.fine.as_ref().unwrap_or(&self.coarse)
    }
}

impl Rendering {
    /// Of fields in a world that is sheared.
    pub fn new(settings: &Settings, shear: &Shear) -> Result<Rendering, NotInSpace> {
        let (_, train, radiance) = sections(settings)?;
        let coarse = RadianceField::new("field", &settings.field, radiance);
        let fine = (train.fine_samples > 0).then(|| RadianceField::new("fine", &settings.field, radiance));
        Ok(Rendering { train: train.clone(), stop_below: radiance.stop_below, shear: shear.clone(), coarse, fine })
    }

    pub fn parameters(&self) -> Vec<Parameter> {
        let fine = self.fine.as_ref().map_or(vec![], RadianceField::parameters);
        self.coarse.parameters().into_iter().chain(fine).collect()
    }

    /// Weights that a ray meets: two floating-point operations each forwards, and twice that backwards.
    pub fn weights_per_ray(&self) -> f64 {
        let TrainSettings { samples, fine_samples, .. } = self.train;
        let fine = self.fine.as_ref().map_or(0, |f| (samples + fine_samples) * weights(&f.parameters()));
        (samples * weights(&self.coarse.parameters()) + fine) as f64
    }

    /// The density of the field that is shown, at points of the learned world.
    pub fn density_at(&self, points: &Tensor) -> Tensor {
        self.fine.as_ref().unwrap_or(&self.coarse).density_at(&self.shear.of_field(points), &progress())
    }

    /// Renders rays along `axes` of a camera with `intrinsics` (fx, fy, cx, cy) between the depths `near` and `far`. Depths
    /// come in the unit of the rays' world, also where the fields live in normalised device coordinates.
    pub fn render(
        &self,
        rays: &Rays,
        intrinsics: &Tensor,
        (near, far): &(Tensor, Tensor),
        axes: &Axes,
        purpose: Purpose,
    ) -> Seen {
        let world = Rays { origin: self.shear.of_field(&rays.origin), direction: self.shear.of_field(&rays.direction) };
        let rays = &if self.train.ndc { world.to_ndc(intrinsics) } else { world.clone() };
        let sample = Axis::new("sample", self.train.samples);
        let jitter = match purpose != Purpose::View && self.train.stratified {
            true => random::uniform(&axes.union(&Axes::new([sample.clone()])), 1, JITTER, &seeded_step()),
            false => Tensor::scalar(0.5),
        };
        let spread = match self.train.depth {
            DepthSettings::Inverse => Spread::Inverse,
            DepthSettings::Metric | DepthSettings::Auto | DepthSettings::Scene => Spread::Metric,
        };
        let depth = depth_samples(&sample, &jitter, near, far, spread);
        let noisy = purpose == Purpose::Training && self.train.density_noise > 0.0;
        let noise = |axis: &Axis, stream: u32| {
            let along = axes.union(&Axes::new([axis.clone()]));
            noisy.then(|| random::normal(&along, 1, stream, &seeded_step()) * self.train.density_noise)
        };
        let least = if purpose == Purpose::View { self.stop_below } else { 0.0 };
        // A fine field's samples need all weights of the coarse one.
        let first = if self.fine.is_none() { least } else { 0.0 };
        let mut coarse = self.through(&self.coarse, rays, &depth, &sample, noise(&sample, DENSITY), first);
        let mut fine = self.fine.as_ref().map(|field| {
            let more = Axis::new("fine", self.train.fine_samples);
            let merged = Axis::new("merged", sample.size() + more.size());
            let drawn = fine_depths(&coarse.weights, &sample, &more, near, far, spread);
            let depth = merge_depths(&depth, &sample, &drawn, &more, &merged);
            self.through(field, rays, &depth, &merged, noise(&merged, FINE_DENSITY), least)
        });
        if self.train.ndc {
            for seen in [Some(&mut coarse), fine.as_mut()].into_iter().flatten() {
                let mean = &seen.depth / seen.opacity.max(&Tensor::scalar(NO_OPACITY));
                seen.depth = &seen.opacity * world.depth_of_ndc(&mean);
            }
        }
        Seen { coarse, fine }
    }
    fn through(
        &self,
        field: &RadianceField,
        rays: &Rays,
        depth: &Tensor,
        sample: &Axis,
        noise: Option<Tensor>,
        least: f64,
    ) -> Composite {
        let length = rays.length();
        let unit = &rays.direction / length.max(&Tensor::scalar(1e-12));
        let found = field.at(&rays.at(depth), &unit, &progress(), noise.as_ref());
        let mut seen = composite_above(least, &found.color, &found.density, depth, &length, sample);
        if self.train.opaque_background {
            // White, as the images were composited on.
            seen.color = seen.color + (1.0 - &seen.opacity);
        }
        seen
    }
}
fn progress() -> Tensor {
    Tensor::per_step(PROGRESS, Shape::new(&[], 1))
}
