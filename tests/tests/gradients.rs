//! Every op of the registry: shape, first and second derivatives against central differences, mid-graph.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::Tensor;
use raygrad_compiler::ops::{Sample, registry};
use raygrad_compiler::reference::{Bindings, Direction, central_difference, evaluate};
use raygrad_tests::{MidGraph, Rng, seed, total, worst};

const STEP: f64 = 2e-3;

/// Gradient of `output` with respect to each parameter, compared lane by lane and along one random direction.
fn check(output: &Tensor, parameters: &[Tensor], bindings: &Bindings, tolerance: f64, what: &str) {
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

fn each(f: impl Fn(&Sample)) {
    let samples = registry();
    assert!(samples.len() > 60, "only {} samples", samples.len());
    samples.iter().for_each(f);
}

#[test]
fn names_of_samples_are_unique() {
    let mut names: Vec<String> = registry().into_iter().map(|s| s.name).collect();
    names.sort();
    let count = names.len();
    names.dedup();
    assert_eq!(names.len(), count);
}

#[test]
fn values_have_the_recorded_shape_and_are_finite() {
    each(|sample| {
        let graph = MidGraph::new(sample);
        let values = evaluate(&[graph.output.clone(), graph.loss], &graph.bindings);
        let values = values.unwrap_or_else(|e| panic!("{}: {e}", sample.name));
        assert_eq!(values[0].shape, *graph.output.shape(), "{}", sample.name);
        assert!(values[0].f().iter().all(|x| x.is_finite()), "{}: {:?}", sample.name, values[0].f());
    });
}

#[test]
fn first_derivatives_agree_with_central_differences() {
    each(|sample| {
        let graph = MidGraph::new(sample);
        if sample.differentiable {
            check(&graph.loss, &graph.parameters, &graph.bindings, 1e-8, &sample.name);
        } else {
            let wanted: Vec<&Tensor> = graph.parameters.iter().collect();
            for g in evaluate(&grad(&graph.loss, &wanted), &graph.bindings).expect("evaluates") {
                assert!(g.f().iter().all(|x| x.is_finite()), "{}: {:?}", sample.name, g.f());
            }
        }
    });
}

#[test]
fn second_derivatives_agree_with_central_differences() {
    each(|sample| {
        let graph = MidGraph::new(sample);
        if !sample.differentiable || graph.parameters.is_empty() {
            return;
        }
        let wanted: Vec<&Tensor> = graph.parameters.iter().collect();
        let mut bindings = graph.bindings.clone();
        let mut rng = Rng(seed(&sample.name) ^ 1);
        let paired = grad(&graph.loss, &wanted).into_iter().zip(&graph.parameters).enumerate().map(|(i, (g, p))| {
            let name = format!("v{i}");
            bindings.insert(name.clone(), rng.array(p.shape(), -1.0, 1.0));
            total(&(g * Tensor::data(name, p.shape().clone())))
        });
        let slope = paired.reduce(|a, b| a + b).expect("there are parameters");
        check(&slope, &graph.parameters, &bindings, 1e-7, &sample.name);
    });
}
