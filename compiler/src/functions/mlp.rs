//! Multi-layer perceptrons: affine layers `y = x W + b`, with the input again at the skip layers.

use crate::graph::{Axes, Shape, Tensor};
use crate::ops::pick::concat;

/// What follows an affine layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    None,
    Relu,
    Sigmoid,
    Tanh,
    /// With its beta.
    Softplus(f64),
    /// With its sigma.
    Gaussian(f64),
    /// `x sigmoid(x)`.
    Silu,
    /// `x` above 0, `e^x - 1` below.
    Elu,
    /// `sin(omega x)`, with its omega.
    Sine(f64),
}

impl Activation {
    #[track_caller]
    pub fn apply(self, x: &Tensor) -> Tensor {
        match self {
            Activation::None => x.clone(),
            Activation::Relu => x.relu(),
            Activation::Sigmoid => x.sigmoid(),
            Activation::Tanh => x.tanh(),
            Activation::Softplus(beta) => x.softplus(beta),
            Activation::Gaussian(sigma) => x.gaussian(sigma),
            Activation::Silu => x * x.sigmoid(),
            Activation::Elu => {
                let zero = Tensor::scalar(0.0);
                // The minimum keeps the exponential, and with it the gradient not taken, finite.
                x.greater_than(&zero).select(x, &x.min(&zero).expm1())
            }
            Activation::Sine(omega) => (x * omega).sin(),
        }
    }
}

/// How a host fills a parameter before training.
#[derive(Clone, Debug, PartialEq)]
pub enum Init {
    Zero,
    /// Uniform in `-bound..bound`.
    Uniform(f64),
    /// Normal with mean 0 and this deviation.
    Normal(f64),
    /// Of a weight matrix, the first rows normal with mean 0 and this deviation, the others zero.
    NormalRows {
        rows: usize,
        deviation: f64,
    },
    /// Norms of the columns of another parameter, which has its name, so many rows, and initial values of its own.
    ColumnNorms {
        of: String,
        rows: usize,
        init: Box<Init>,
    },
}

impl Init {
    /// Uniform in `+-1 / sqrt(fan_in)`, for weights and biases: the default of PyTorch's affine layers.
    pub fn fan_in(fan_in: usize) -> Init {
        Init::Uniform(1.0 / (fan_in as f64).sqrt())
    }
    /// Uniform in `+-gain sqrt(6 / (fan_in + fan_out))` (Glorot and Bengio, 2010).
    pub fn glorot(gain: f64, fan_in: usize, fan_out: usize) -> Init {
        Init::Uniform(gain * (6.0 / (fan_in + fan_out) as f64).sqrt())
    }
    /// The same values times `factor`.
    pub fn scaled(self, factor: f64) -> Init {
        match self {
            Init::Zero => Init::Zero,
            Init::Uniform(bound) => Init::Uniform(bound * factor),
            Init::Normal(deviation) => Init::Normal(deviation * factor),
            Init::NormalRows { rows, deviation } => Init::NormalRows { rows, deviation: deviation * factor },
            Init::ColumnNorms { of, rows, init } => Init::ColumnNorms { of, rows, init: Box::new(init.scaled(factor)) },
        }
    }
}

/// A tensor that a step may update, and its initial values.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub tensor: Tensor,
    pub init: Init,
    /// Whether the optimiser moves it; else it stays as it started.
    pub trained: bool,
}

impl Parameter {
    /// The trained parameter called `name`.
    #[track_caller]
    pub fn new(name: impl Into<String>, shape: Shape, init: Init) -> Parameter {
        Parameter { tensor: Tensor::parameter(name, shape), init, trained: true }
    }
    /// The same parameter, trained only if `trained`.
    pub fn trained(self, trained: bool) -> Parameter {
        Parameter { trained, ..self }
    }
}

/// Shape of a network.
#[derive(Clone, Debug)]
pub struct MlpSpec {
    /// Parameters are called `{prefix}.{layer}.weight` and `{prefix}.{layer}.bias`.
    pub prefix: String,
    /// Channels of the input, of every hidden layer, and of the output.
    pub widths: Vec<usize>,
    /// Layers that see `[hidden, input]` instead of the hidden channels alone.
    pub skip: Vec<usize>,
    pub hidden: Activation,
    pub output: Activation,
    /// Axes of the parameters: one network for every element of these.
    pub axes: Axes,
}

impl MlpSpec {
    /// Rectified hidden layers, no skip, no output activation.
    pub fn new(prefix: impl Into<String>, widths: &[usize]) -> MlpSpec {
        MlpSpec {
            prefix: prefix.into(),
            widths: widths.to_vec(),
            skip: vec![],
            hidden: Activation::Relu,
            output: Activation::None,
            axes: Axes::none(),
        }
    }
    pub fn skip(mut self, layers: &[usize]) -> MlpSpec {
        self.skip = layers.to_vec();
        self
    }
    pub fn hidden(mut self, activation: Activation) -> MlpSpec {
        self.hidden = activation;
        self
    }
    pub fn output(mut self, activation: Activation) -> MlpSpec {
        self.output = activation;
        self
    }
    pub fn axes(mut self, axes: &Axes) -> MlpSpec {
        self.axes = axes.clone();
        self
    }
}

/// A network: its parameters and how they are applied.
#[derive(Clone, Debug)]
pub struct Mlp {
    pub spec: MlpSpec,
    /// Weight `(in, out)` and bias of every layer, in order: weight 0, bias 0, weight 1, ...
    pub parameters: Vec<Parameter>,
}

impl Mlp {
    /// Records the parameters, to be initialised like PyTorch's affine layers; change their `init` for anything else.
    #[track_caller]
    pub fn new(spec: MlpSpec) -> Mlp {
        let mut parameters = vec![];
        for (layer, pair) in spec.widths.windows(2).enumerate() {
            let fan_in = pair[0] + if spec.skip.contains(&layer) { spec.widths[0] } else { 0 };
            let init = Init::fan_in(fan_in);
            let shape = |channels| Shape::new(&[], 1).with_channels(channels).with_axes(spec.axes.clone());
            let weight = shape(crate::graph::Channels::Matrix(fan_in, pair[1]));
            let bias = shape(crate::graph::Channels::Vector(pair[1]));
            let name = |what: &str| format!("{}.{layer}.{what}", spec.prefix);
            parameters.push(Parameter::new(name("weight"), weight, init.clone()));
            parameters.push(Parameter::new(name("bias"), bias, init));
        }
        Mlp { spec, parameters }
    }

    pub fn layers(&self) -> usize {
        self.parameters.len() / 2
    }

    /// The network's output for every element of `x`.
    #[track_caller]
    pub fn apply(&self, x: &Tensor) -> Tensor {
        let inputs = self.spec.widths.first().copied().unwrap_or(0);
        if self.layers() == 0 || x.width() != inputs {
            let problem = format!("{} input channels for a network of widths {:?}", x.channels(), self.spec.widths);
            return Tensor::misfit(
                "mlp",
                &[x],
                problem,
                format!("{inputs} channels, and at least two widths, would fit"),
            );
        }
        if let Some(layer) = self.spec.skip.iter().find(|layer| **layer >= self.layers()) {
            let problem = format!("layer {layer} sees the input again, but there are {} layers", self.layers());
            return Tensor::misfit("mlp", &[x], problem, "layers are counted from 0");
        }
        let x = x.reshape(inputs);
        let mut hidden = x.clone();
        for layer in 0..self.layers() {
            if self.spec.skip.contains(&layer) {
                hidden = concat([&hidden, &x]);
            }
            let (weight, bias) = (&self.parameters[2 * layer].tensor, &self.parameters[2 * layer + 1].tensor);
            let last = layer + 1 == self.layers();
            let activation = if last { self.spec.output } else { self.spec.hidden };
            hidden = activation.apply(&(hidden.linear(weight) + bias));
        }
        hidden
    }

    /// Multiplies the initial values of the first layer, weights and bias, by `factor`. With coarse-to-fine encoding only
    /// the raw channels are open at first, and `sqrt(inputs / raw inputs)` restores the scale of the hidden ones.
    pub fn scale_first_layer(mut self, factor: f64) -> Mlp {
        for p in self.parameters.iter_mut().take(2) {
            p.init = p.init.clone().scaled(factor);
        }
        self
    }
}
