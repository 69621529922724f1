//! An affine layer whose weights are lengths and directions (Salimans and Kingma, Weight normalization: a simple
//! reparameterization to accelerate training of deep neural networks, NeurIPS 2016):
//!
//! ```text
//! y_o = g_o (v_o . x) / |v_o| + b_o
//! ```
//!
//! v_o is column o of the directions `(in, out)`. The factor `g / |v|` multiplies the outputs, not the weights: no second
//! matrix of weights is computed, and the products of inputs with fewer axes still split off.

use super::mlp::{Init, Parameter};
use crate::graph::{Axes, Channels, Shape, Tensor};

/// The parameters of one layer.
#[derive(Clone, Debug)]
pub struct NormalisedLayer {
    /// Directions v, `(in, out)`: `{prefix}.direction`.
    pub direction: Parameter,
    /// Lengths g, one channel an output: `{prefix}.length`; at first those of the directions.
    pub length: Parameter,
    /// Zero at first: `{prefix}.bias`.
    pub bias: Parameter,
}

impl NormalisedLayer {
    /// Records the parameters, one layer for every element of `axes`. No column may start at zero: it has no direction.
    #[track_caller]
    pub fn new(prefix: &str, inputs: usize, outputs: usize, direction: Init, axes: &Axes) -> NormalisedLayer {
        let shape = |channels: Channels| Shape::new(&[], 1).with_channels(channels).with_axes(axes.clone());
        let name = |what: &str| format!("{prefix}.{what}");
        let length = Init::ColumnNorms { of: name("direction"), rows: inputs, init: Box::new(direction.clone()) };
        NormalisedLayer {
            direction: Parameter::new(name("direction"), shape(Channels::Matrix(inputs, outputs)), direction),
            length: Parameter::new(name("length"), shape(Channels::Vector(outputs)), length),
            bias: Parameter::new(name("bias"), shape(Channels::Vector(outputs)), Init::Zero),
        }
    }

    /// Directions, lengths, bias.
    pub fn parameters(&self) -> Vec<Parameter> {
        vec![self.direction.clone(), self.length.clone(), self.bias.clone()]
    }

    /// The layer's output for every element of `x`.
    #[track_caller]
    pub fn apply(&self, x: &Tensor) -> Tensor {
        let (v, g, b) = (&self.direction.tensor, &self.length.tensor, &self.bias.tensor);
        let Channels::Matrix(inputs, _) = v.channels() else {
            let problem = format!("directions of {} channels", v.channels());
            return Tensor::misfit("weight_norm", &[x, v], problem, "directions are a matrix (in, out)");
        };
        // The sum over rows is a product with a row of ones.
        let ones = Tensor::constant(&vec![1.0; inputs]).broadcast_to(v.axes());
        let norm = ones.linear(&(v * v)).sqrt();
        x.linear(v) * (g / norm) + b
    }
}
