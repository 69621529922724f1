//! What the tests share: seeded numbers, bindings, and the graph around an op under test.

pub mod backend;
pub mod check;
pub mod forms;
pub mod graphs;
pub mod mistakes;
pub mod own_op;
pub mod plan;
pub mod planar;
pub mod rendering;
pub mod vectors;

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::ops::Sample;
use raygrad_compiler::reference::{Array, Bindings, Direction, central_difference, evaluate};

/// Seeded random numbers (splitmix64: Steele, Lea, Flood, Fast splittable pseudorandom number generators, 2014).
pub struct Rng(pub u64);

impl Rng {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    /// Uniform in `low..high`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.bits() >> 11) as f64 * 2f64.powi(-53)
    }
    /// Uniform in `0..n`.
    pub fn below(&mut self, n: usize) -> usize {
        (self.bits() >> 33) as usize % n
    }
    pub fn chance(&mut self, probability: f64) -> bool {
        self.uniform(0.0, 1.0) < probability
    }
    /// Uniform values for every lane of `shape`.
    pub fn array(&mut self, shape: &Shape, low: f64, high: f64) -> Array {
        Array::floats(shape, (0..shape.lanes()).map(|_| self.uniform(low, high)).collect())
    }
}

/// A text's seed: tests keep their numbers when others are added.
pub fn seed(text: &str) -> u64 {
    text.bytes().fold(0xCBF2_9CE4_8422_2325, |h, b| (h ^ b as u64).wrapping_mul(0x0100_0000_01B3))
}

/// Sum over all axes and channels.
pub fn total(t: &Tensor) -> Tensor {
    t.sum_channels().sum_over(t.axes())
}

/// A sample's op in the middle of a graph: parameters `p0, p1, ..` pass through a smooth function into the sample's
/// domain, the result is multiplied by the random `upstream`, passes through another one, and is summed.
pub struct MidGraph {
    pub parameters: Vec<Tensor>,
    pub output: Tensor,
    pub loss: Tensor,
    pub bindings: Bindings,
}

impl MidGraph {
    pub fn new(sample: &Sample) -> MidGraph {
        let mut rng = Rng(seed(&sample.name));
        let mut bindings = Bindings::new();
        let (mut parameters, mut inputs) = (vec![], vec![]);
        for (i, input) in sample.inputs.iter().enumerate() {
            let name = format!("p{i}");
            bindings.insert(name.clone(), rng.array(&input.shape, -1.2, 1.2));
            let p = Tensor::parameter(name, input.shape.clone());
            inputs.push(p.sin() * ((input.high - input.low) / 2.0) + (input.high + input.low) / 2.0);
            parameters.push(p);
        }
        let output = (sample.build)(&inputs);
        bindings.insert("upstream".into(), rng.array(output.shape(), -1.0, 1.0));
        let upstream = Tensor::data("upstream", output.shape().clone());
        let loss = total(&(&output * upstream).sin());
        MidGraph { parameters, output, loss, bindings }
    }
}

/// Largest difference between two slices, relative to the largest magnitude in `expected`, or to `floor` if that is more.
pub fn worst(found: &[f64], expected: &[f64], floor: f64) -> f64 {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(floor, |m, x| m.max(x.abs()));
    // A NaN anywhere must not pass: `max` would drop it.
    let far = |(a, b): (&f64, &f64)| if (a - b).is_nan() { f64::INFINITY } else { (a - b).abs() };
    found.iter().zip(expected).map(far).fold(0.0, f64::max) / scale
}

const STEP: f64 = 2e-3;

/// Gradient of `output` with respect to each parameter, compared with central differences lane by lane and along one
/// random direction; `tolerance` is relative to the largest derivative.
pub fn check_gradient(output: &Tensor, parameters: &[Tensor], bindings: &Bindings, tolerance: f64, what: &str) {
    let wanted: Vec<&Tensor> = parameters.iter().collect();
    let gradients = grad(output, &wanted);
    for (p, g) in parameters.iter().zip(&gradients) {
        assert_eq!(g.shape(), p.shape(), "{what}: the gradient has another shape");
    }
    let found = evaluate(&gradients, bindings).unwrap_or_else(|e| panic!("{what}: {e}"));
    for (p, g) in parameters.iter().zip(&found) {
        let name = p.input_name().expect("a parameter has a name");
        let difference = |d: &Direction| central_difference(output, bindings, name, d, STEP).expect("evaluates");
        let lanes: Vec<f64> = (0..g.f().len()).map(|i| difference(&Direction::Lane(i))).collect();
        let error = worst(g.f(), &lanes, 1e-2);
        assert!(error < tolerance, "{what}, {name}: off by {error:.2e}\n{:?}\n{lanes:?}", g.f());
        let mut rng = Rng(seed(what));
        let v: Vec<f64> = lanes.iter().map(|_| rng.uniform(-1.0, 1.0)).collect();
        let along: f64 = g.f().iter().zip(&v).map(|(g, v)| g * v).sum();
        let error = worst(&[along], &[difference(&Direction::Along(&v))], 1e-2);
        assert!(error < tolerance, "{what}, {name}: off by {error:.2e} along a direction");
    }
}

/// The same for the derivative of the gradient along a random direction.
pub fn check_second_order(output: &Tensor, parameters: &[Tensor], bindings: &Bindings, tolerance: f64, what: &str) {
    let wanted: Vec<&Tensor> = parameters.iter().collect();
    let mut bindings = bindings.clone();
    let mut rng = Rng(seed(what) ^ 1);
    let paired = grad(output, &wanted).into_iter().zip(parameters).enumerate().map(|(i, (g, p))| {
        let name = format!("v{i}");
        bindings.insert(name.clone(), rng.array(p.shape(), -1.0, 1.0));
        total(&(g * Tensor::data(name, p.shape().clone())))
    });
    let slope = paired.reduce(|a, b| a + b).expect("there are parameters");
    check_gradient(&slope, parameters, &bindings, tolerance, what);
}

/// Checks first and second derivatives of `f` on uniform parameters, times a random factor.
pub fn derivatives(name: &str, shapes: &[(Shape, f64, f64)], f: impl Fn(&[Tensor]) -> Tensor) {
    let mut bindings = Bindings::new();
    let mut rng = Rng(seed(name));
    let mut parameters = vec![];
    for (i, (shape, low, high)) in shapes.iter().enumerate() {
        bindings.insert(format!("p{i}"), rng.array(shape, *low, *high));
        parameters.push(Tensor::parameter(format!("p{i}"), shape.clone()));
    }
    let y = f(&parameters);
    assert!(y.error().is_none(), "{name}: {:?}", y.error());
    bindings.insert("upstream".into(), rng.array(y.shape(), -1.0, 1.0));
    let loss = total(&(&y * Tensor::data("upstream", y.shape().clone())));
    check_gradient(&loss, &parameters, &bindings, 1e-7, name);
    check_second_order(&loss, &parameters, &bindings, 1e-6, name);
}

/// An array of the given axes and channels.
pub fn floats(axes: &[&Axis], channels: usize, values: &[f64]) -> Array {
    Array::floats(&Shape::new(axes, channels), values.to_vec())
}
