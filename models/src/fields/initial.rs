//! Initial values of the fields' networks, where they are not those of PyTorch's affine layers.

use raygrad_compiler::Channels;
use raygrad_compiler::functions::mlp::{Init, Mlp};
use std::f64::consts::SQRT_2;

/// Glorot's initial weights, of gain sqrt(2) in hidden layers and of `last` in the last one; biases of zero.
pub fn glorot(mut network: Mlp, last: f64) -> Mlp {
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

/// SIREN's weights (Sitzmann, Martel, Bergman, Lindell, Wetzstein, NeurIPS 2020): uniform in `+-1 / in` in a layer that sees
/// coordinates and `+-sqrt(6 / in) / omega` in one that sees sines, so that the arguments of all sines have one distribution.
/// `raw`: whether the first layer sees coordinates.
pub fn siren(mut network: Mlp, omega: f64, raw: bool) -> Mlp {
    for (layer, weight) in network.parameters.iter_mut().step_by(2).enumerate() {
        let Channels::Matrix(inputs, _) = weight.tensor.channels() else { continue };
        let inputs = inputs as f64;
        weight.init = Init::Uniform(if raw && layer == 0 { 1.0 / inputs } else { (6.0 / inputs).sqrt() / omega });
    }
    network
}
