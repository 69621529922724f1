//! Volume rendering at a small size: rays from a warp network or given ones, points along them, a field with a skip layer and a view
//! branch, compositing, a loss of colour, depth and opacity, and its gradients.

use crate::{Rng, seed, total};
use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec};
use raygrad_compiler::functions::posenc::{encoded_width, positional_encoding};
use raygrad_compiler::graph::{Axis, Shape, Tensor, topological};
use raygrad_compiler::ops::input::Input;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::Bindings;

/// Frames, rays and samples, and what the field looks like.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    pub frames: usize,
    pub rays: usize,
    pub samples: usize,
    pub width: usize,
    pub hidden: Activation,
    /// Rays from a warp network, or given up to a shift a frame: cheap to compute wherever they are needed.
    pub warped: bool,
}

pub struct Rendering {
    pub rgb: Tensor,
    pub depth: Tensor,
    pub opacity: Tensor,
    pub loss: Tensor,
    /// Of the field, the warp network, and the codes of the frames.
    pub parameters: Vec<Tensor>,
    pub bindings: Bindings,
}

const BANDS: usize = 2;
const CODE: usize = 4;

impl Rendering {
    pub fn new(sizes: Sizes) -> Rendering {
        let (frame, ray) = (Axis::new("frame", sizes.frames), Axis::new("ray", sizes.rays));
        let sample = Axis::new("sample", sizes.samples);
        let per_ray = |name: &str, channels: usize| Tensor::data(name, Shape::new(&[&frame, &ray], channels));
        let code = Tensor::parameter("code", Shape::new(&[&frame], CODE));
        let warp = Mlp::new(MlpSpec::new("warp", &[2 + CODE, 12, 6]).hidden(Activation::Tanh));
        let moved = if sizes.warped {
            warp.apply(&concat([&per_ray("pixel", 2), &code]))
        } else {
            per_ray("rays", 6) + code.pick(&[0, 1, 2, 3, 0, 1])
        };
        let origin = moved.slice(0..3) * 0.3;
        let direction = moved.slice(3..6) * 0.3 + Tensor::constant(&[0.1, -0.2, 1.0]);
        let length = (&direction * &direction).sum_channels().sqrt();

        // Depths grow along a ray; the last interval is long.
        let noise = Tensor::data("noise", Shape::new(&[&frame, &ray, &sample], 1));
        let index = Tensor::index(&sample).to_f32();
        let depth = (&index + noise) * (1.0 / sizes.samples as f64) + 0.5;
        let last = index.greater_than(&Tensor::scalar(sizes.samples as f64 - 1.5));
        let interval = last.select(&Tensor::scalar(4.0), &(depth.shift(&sample, -1) - &depth));
        let points = origin + &depth * &direction;

        let w = sizes.width;
        let inputs = encoded_width(3, BANDS);
        let trunk = Mlp::new(MlpSpec::new("field", &[inputs, w, w, w, w]).skip(&[2]).hidden(sizes.hidden));
        let out = trunk.apply(&positional_encoding(&points, BANDS, None));
        let view = positional_encoding(&(&direction / &length), 1, None);
        let spec = MlpSpec::new("view", &[w - 1 + encoded_width(3, 1), 8, 3]).hidden(sizes.hidden);
        let colours = Mlp::new(spec.output(Activation::Sigmoid));
        let colour = colours.apply(&concat([&out.slice(1..w), &view]));

        let a = out.ch(0).softplus(1.0) * interval * length;
        let weight = (1.0 - (-&a).exp()) * (-a.cumsum(&sample)).exp();
        let along = |x: &Tensor| x.sum(&[&sample]);
        let (rgb, far, opacity) = (along(&(&weight * colour)), along(&(&weight * depth)), along(&weight));
        let error = &rgb + (1.0 - &opacity) * 0.7 - per_ray("target", 3);
        let off = &far - per_ray("range", 1);
        let loss = (&error * &error).mean_all() + (&off * &off).mean_all() * 0.1;
        let networks = [&trunk, &colours, &warp].into_iter().take(if sizes.warped { 3 } else { 2 });
        let parameters = networks.flat_map(|m| &m.parameters).map(|p| p.tensor.clone());
        let parameters: Vec<Tensor> = parameters.chain([code]).collect();
        let bindings = bindings(&loss);
        Rendering { rgb, depth: far, opacity, loss, parameters, bindings }
    }

    fn wanted(&self) -> Vec<&Tensor> {
        self.parameters.iter().collect()
    }

    /// What is rendered, the loss, its gradients, and a step down them.
    pub fn step(&self) -> Step {
        let gradients = grad(&self.loss, &self.wanted());
        let values = [("rgb", &self.rgb), ("depth", &self.depth), ("opacity", &self.opacity), ("loss", &self.loss)];
        let mut step = Step::default();
        step.outputs.extend(values.map(|(name, t)| (name.to_string(), t.clone())));
        for (p, g) in self.parameters.iter().zip(gradients) {
            step.updates.push((p.clone(), p - &g * 0.1));
            step.outputs.push((format!("grad {}", p.input_name().unwrap_or_default()), g));
        }
        step
    }

    /// Derivatives of the gradients along a random direction, and its values.
    pub fn second_order(&self) -> (Step, Bindings) {
        let mut bindings = self.bindings.clone();
        let mut rng = Rng(seed("second order"));
        let gradients = grad(&self.loss, &self.wanted());
        let along = self.parameters.iter().zip(gradients).enumerate().map(|(i, (p, g))| {
            let name = format!("v{i}");
            bindings.insert(name.clone(), rng.array(p.shape(), -1.0, 1.0));
            total(&(g * Tensor::data(name, p.shape().clone())))
        });
        let slope = along.reduce(|a, b| a + b).expect("there are parameters");
        let second = grad(&slope, &self.wanted());
        let name = |p: &Tensor| format!("second {}", p.input_name().unwrap_or_default());
        let outputs = self.parameters.iter().zip(second).map(|(p, g)| (name(p), g)).collect();
        (Step { outputs, updates: vec![] }, bindings)
    }
}

fn bindings(loss: &Tensor) -> Bindings {
    let mut rng = Rng(seed("rendering"));
    let mut all = Bindings::new();
    for input in topological([loss.clone()]).iter().filter_map(|t| t.op_as::<Input>()) {
        let (low, high) = match &*input.name {
            "noise" | "target" | "range" => (0.1, 0.9),
            "pixel" | "rays" | "code" => (-1.0, 1.0),
            _ => (-0.5, 0.5),
        };
        all.insert(input.name.clone(), rng.array(&input.shape, low, high));
    }
    all
}
