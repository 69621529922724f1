//! A scene as a network (Mildenhall et al., NeRF, ECCV 2020; the layers of BARF, ICCV 2021): density and colour at a point
//! seen from a direction.
//!
//! ```text
//! h = trunk(enter(x));  density = softplus(w h);  feature = act(W h);  colour = sigmoid(head([feature, enter(d)]))
//! ```
//!
//! | `field.kind` | hidden layers | `enter` | feature |
//! |---|---|---|---|
//! | `relu` | rectified | positional encoding, opening band by band with the progress of training | rectified |
//! | `gaussian` | `exp(-z^2 / (2 sigma^2))` | a layer, `exp(-(z - mean z)^2 / (2 sigma^2))`, the mean over its channels | affine |
//! | `siren` | `sin(omega z)` | a layer, `sin(omega z)` | affine |
//!
//! The last two are the Gaussian field (GARF) as published with the invertible warp, and SIREN in the same place; the trunk's
//! skips see what `enter` gives. They may have an encoding too, in front of the layer.
//!
//! Weights start as Glorot and Bengio's with gain sqrt(2) before a rectifier and biases at zero (`tf_init`), or as PyTorch's
//! affine layers do; SIREN has a rule of its own. The density's row and the feature's share a layer in the original: here they
//! are two, with the same initial bounds.

use super::initial::{glorot, siren};
use crate::config::{Density, Encoding, FieldInit, FieldKind, FieldSettings, RadianceSettings};
use raygrad_compiler::Tensor;
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec, Parameter};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, encoded_width, positional_encoding};
use raygrad_compiler::ops::pick::concat;
use std::f64::consts::SQRT_2;

/// The networks and their encodings.
#[derive(Clone, Debug)]
pub struct RadianceField {
    points: Entrance,
    directions: Option<Entrance>,
    trunk: Mlp,
    density: Mlp,
    feature: Mlp,
    head: Mlp,
    settings: FieldSettings,
    activation: Density,
}

/// How points or directions enter: encoded, and in fields that are not rectified through a layer of their own.
#[derive(Clone, Debug)]
struct Entrance {
    bands: usize,
    layer: Option<Mlp>,
    width: usize,
}

/// What the field says of points.
#[derive(Clone, Debug)]
pub struct Radiance {
    /// One channel, 0 or more, in inverse lengths.
    pub density: Tensor,
    /// Three channels in 0..1.
    pub color: Tensor,
}

impl RadianceField {
    /// A field whose parameters are called `{name}.trunk.0.weight` and so on.
    pub fn new(name: &str, field: &FieldSettings, radiance: &RadianceSettings) -> RadianceField {
        let width = field.layers.last().copied().unwrap_or(0);
        let spec =
            |part: &str, widths: &[usize]| MlpSpec::new(format!("{name}.{part}"), widths).hidden(field.activation());
        let started = |network: Mlp, gain: f64, raw: bool| match (field.kind, radiance.init) {
            (FieldKind::Siren, _) => siren(network, field.omega, raw),
            (_, FieldInit::Glorot) => glorot(network, gain),
            (_, FieldInit::FanIn) => network,
        };
        let entrance = |part: &str, bands: usize| {
            let bands = if field.encoding == Encoding::None { 0 } else { bands };
            let inputs = encoded_width(3, bands);
            let first = field.layers.first().copied().unwrap_or(0);
            match field.kind {
                FieldKind::Relu => Entrance { bands, layer: None, width: inputs },
                FieldKind::Gaussian | FieldKind::Siren => {
                    let layer = started(Mlp::new(spec(part, &[inputs, first])), 1.0, true);
                    Entrance { bands, layer: Some(layer), width: first }
                }
            }
        };
        let points = entrance("points", field.bands);
        let directions = radiance.view_dependent.then(|| entrance("directions", radiance.view_bands));
        let mut trunk = vec![points.width];
        trunk.extend(&field.layers);
        let mut head = vec![width + directions.as_ref().map_or(0, |d| d.width)];
        head.extend(&radiance.color_layers);
        head.push(3);
        let (feature, gain) = match field.kind {
            FieldKind::Relu => (Activation::Relu, SQRT_2),
            FieldKind::Gaussian | FieldKind::Siren => (Activation::None, 1.0),
        };
        let trunk = spec("trunk", &trunk).skip(&radiance.skip).output(field.activation());
        RadianceField {
            trunk: started(Mlp::new(trunk), SQRT_2, false),
            density: started(Mlp::new(spec("density", &[width, 1])), 1.0, false),
            feature: started(Mlp::new(spec("feature", &[width, width]).output(feature)), gain, false),
            head: started(Mlp::new(spec("color", &head).output(Activation::Sigmoid)), 1.0, false),
            points,
            directions,
            settings: field.clone(),
            activation: radiance.density,
        }
    }

    /// Density and colour at `points` (three channels) seen along unit `directions` (three channels, constant along a ray),
    /// given the progress of training from 0 to 1. `noise`, if any, is added to the density before its activation.
    #[track_caller]
    pub fn at(&self, points: &Tensor, directions: &Tensor, progress: &Tensor, noise: Option<&Tensor>) -> Radiance {
        let hidden = self.hidden(points, progress);
        let mut raw = self.density.apply(&hidden);
        if let Some(noise) = noise {
            raw = raw + noise;
        }
        let density = self.activate(&raw);
        let mut feature = self.feature.apply(&hidden);
        if let Some(entrance) = &self.directions {
            feature = concat([&feature, &self.enter(entrance, directions, progress)]);
        }
        Radiance { density, color: self.head.apply(&feature) }
    }

    /// The density alone.
    #[track_caller]
    pub fn density_at(&self, points: &Tensor, progress: &Tensor) -> Tensor {
        self.activate(&self.density.apply(&self.hidden(points, progress)))
    }

    #[track_caller]
    fn hidden(&self, points: &Tensor, progress: &Tensor) -> Tensor {
        self.trunk.apply(&self.enter(&self.points, points, progress))
    }

    #[track_caller]
    fn activate(&self, raw: &Tensor) -> Tensor {
        match self.activation {
            Density::Softplus => raw.softplus(1.0),
            Density::Relu => raw.relu(),
        }
    }

    pub fn parameters(&self) -> Vec<Parameter> {
        let entrances = [Some(&self.points), self.directions.as_ref()].into_iter().flatten();
        let entrances = entrances.filter_map(|e| e.layer.as_ref());
        let networks = entrances.chain([&self.trunk, &self.density, &self.feature, &self.head]);
        networks.flat_map(|m| m.parameters.clone()).collect()
    }

    #[track_caller]
    fn enter(&self, entrance: &Entrance, x: &Tensor, progress: &Tensor) -> Tensor {
        let [start, end] = self.settings.window;
        let windowed = self.settings.encoding == Encoding::Windowed && entrance.bands > 0;
        let weights = windowed.then(|| coarse_to_fine_weights(progress, entrance.bands, start, end));
        let encoded = positional_encoding(x, entrance.bands, weights.as_ref());
        let Some(layer) = &entrance.layer else { return encoded };
        let z = layer.apply(&encoded);
        match self.settings.kind {
            FieldKind::Gaussian => (&z - z.mean_channels()).gaussian(self.settings.sigma),
            FieldKind::Relu | FieldKind::Siren => self.settings.activation().apply(&z),
        }
    }
}
