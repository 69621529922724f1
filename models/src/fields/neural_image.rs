//! A picture as a network: colour = sigmoid(MLP(gamma(x, y))).
//!
//! gamma is the positional encoding, its bands opened one after the other while training progresses (BARF's
//! coarse-to-fine weights), all open, or absent. With the window, only the two raw coordinates are open at first: the
//! first layer starts larger by sqrt(inputs / 2).
//!
//! Instead of rectifiers the hidden layers may have Gaussians (GARF: Chng, Ramasinghe, Sherrah, Lucey, ECCV 2022) or
//! sines (SIREN: Sitzmann, Martel, Bergman, Lindell, Wetzstein, NeurIPS 2020); these need no encoding.

use super::initial::siren;
use crate::config::{Encoding, FieldKind, FieldSettings};
use raygrad_compiler::Tensor;
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec, Parameter};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, encoded_width, positional_encoding};

/// The network and its encoding.
#[derive(Clone, Debug)]
pub struct NeuralImage {
    network: Mlp,
    encoding: Encoding,
    bands: usize,
    window: [f64; 2],
}

impl NeuralImage {
    pub fn new(settings: &FieldSettings) -> NeuralImage {
        let bands = if settings.encoding == Encoding::None { 0 } else { settings.bands };
        let inputs = encoded_width(2, bands);
        let mut widths = vec![inputs];
        widths.extend(&settings.layers);
        widths.push(3);
        let hidden = settings.activation();
        let network = Mlp::new(MlpSpec::new("field", &widths).hidden(hidden).output(Activation::Sigmoid));
        let network = match settings.kind {
            FieldKind::Relu | FieldKind::Gaussian => network,
            FieldKind::Siren => siren(network, settings.omega, true),
        };
        let network = match settings.encoding {
            Encoding::Windowed => network.scale_first_layer((inputs as f64 / 2.0).sqrt()),
            Encoding::Full | Encoding::None => network,
        };
        NeuralImage { network, encoding: settings.encoding, bands, window: settings.window }
    }

    /// Three channels of colour at the points `at`, given the progress of training from 0 to 1.
    #[track_caller]
    pub fn color(&self, at: &Tensor, progress: &Tensor) -> Tensor {
        let [start, end] = self.window;
        let weights =
            (self.encoding == Encoding::Windowed).then(|| coarse_to_fine_weights(progress, self.bands, start, end));
        self.network.apply(&positional_encoding(at, self.bands, weights.as_ref()))
    }

    pub fn parameters(&self) -> Vec<Parameter> {
        self.network.parameters.clone()
    }
}
