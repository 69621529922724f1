//! A scene as a network (Mildenhall et al., NeRF, ECCV 2020; the layers of BARF, ICCV 2021): density and colour at a point
//! seen from a direction.
//!
//! ```text
//! h = trunk(gamma(x));  density = softplus(w h);  feature = relu(W h);  colour = sigmoid(head([feature, gamma(d)]))
//! ```
//!
//! Both encodings open band by band with the progress of training. Biases start at zero and weights as Glorot and Bengio's,
//! with gain sqrt(2) before a rectifier. The density's row and the feature's share a layer in the original: here they are
//! two, with the same initial bounds.

use crate::config::{Density, Encoding, FieldSettings, RadianceSettings};
use raygrad_compiler::functions::mlp::{Activation, Init, Mlp, MlpSpec, Parameter};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, encoded_width, positional_encoding};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Channels, Tensor};
use std::f64::consts::SQRT_2;

/// The networks and their encodings.
#[derive(Clone, Debug)]
pub struct RadianceField {
    trunk: Mlp,
    density: Mlp,
    feature: Mlp,
    head: Mlp,
    encoding: Encoding,
    bands: usize,
    view_bands: usize,
    window: [f64; 2],
    activation: Density,
    view_dependent: bool,
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
    pub fn new(field: &FieldSettings, radiance: &RadianceSettings) -> RadianceField {
        let open = |bands: usize| if field.encoding == Encoding::None { 0 } else { bands };
        let (bands, view_bands) = (open(field.bands), open(radiance.view_bands));
        let width = field.layers.last().copied().unwrap_or(0);
        let mut trunk = vec![encoded_width(3, bands)];
        trunk.extend(&field.layers);
        let seen = if radiance.view_dependent { encoded_width(3, view_bands) } else { 0 };
        let mut head = vec![width + seen];
        head.extend(&radiance.color_layers);
        head.push(3);
        let rectified = |spec: MlpSpec| spec.output(Activation::Relu);
        let spec = |name: &str, widths: &[usize]| MlpSpec::new(format!("field.{name}"), widths);
        RadianceField {
            trunk: glorot(Mlp::new(rectified(spec("trunk", &trunk).skip(&radiance.skip))), SQRT_2),
            density: glorot(Mlp::new(spec("density", &[width, 1])), 1.0),
            feature: glorot(Mlp::new(rectified(spec("feature", &[width, width]))), SQRT_2),
            head: glorot(Mlp::new(spec("color", &head).output(Activation::Sigmoid)), 1.0),
            encoding: field.encoding,
            bands,
            view_bands,
            window: field.window,
            activation: radiance.density,
            view_dependent: radiance.view_dependent,
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
        if self.view_dependent {
            feature = concat([&feature, &self.encode(directions, self.view_bands, progress)]);
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
        self.trunk.apply(&self.encode(points, self.bands, progress))
    }

    #[track_caller]
    fn activate(&self, raw: &Tensor) -> Tensor {
        match self.activation {
            Density::Softplus => raw.softplus(1.0),
            Density::Relu => raw.relu(),
        }
    }

    pub fn parameters(&self) -> Vec<Parameter> {
        [&self.trunk, &self.density, &self.feature, &self.head].iter().flat_map(|m| m.parameters.clone()).collect()
    }

    #[track_caller]
    fn encode(&self, x: &Tensor, bands: usize, progress: &Tensor) -> Tensor {
        let [start, end] = self.window;
        let windowed = self.encoding == Encoding::Windowed && bands > 0;
        let weights = windowed.then(|| coarse_to_fine_weights(progress, bands, start, end));
        positional_encoding(x, bands, weights.as_ref())
    }
}

/// Glorot's initial weights, of gain sqrt(2) in hidden layers and of `last` in the last one; biases of zero.
fn glorot(mut network: Mlp, last: f64) -> Mlp {
    let layers = network.layers();
    for (i, p) in network.parameters.iter_mut().enumerate() {
        let gain = if i / 2 + 1 == layers { last } else { SQRT_2 };
        p.init = match p.tensor.channels() {
            Channels::Matrix(inputs, outputs) => Init::glorot(gain, inputs, outputs),
            Channels::Vector(_) => Init::Zero,
        };
    }
    network
}
