//! Simplification keeps every value: the simplified graph against the recorded one, both in the f64 reference.

use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Tensor};
use raygrad_compiler::ops::registry;
use raygrad_compiler::reference::Bindings;
use raygrad_compiler::simplify::simplify;
use raygrad_tests::backend::reference;
use raygrad_tests::{MidGraph, total, worst};

#[test]
fn every_op_and_its_gradients_keep_their_values() {
    for sample in registry() {
        let graph = MidGraph::new(&sample);
        let wanted: Vec<_> = graph.parameters.iter().collect();
        let mut outputs = vec![("value".to_string(), graph.output.clone())];
        if sample.differentiable && !wanted.is_empty() {
            let first = grad(&graph.loss, &wanted);
            let squares = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b).unwrap();
            let second = grad(&squares, &wanted);
            outputs.extend(first.into_iter().chain(second).enumerate().map(|(i, g)| (format!("grad {i}"), g)));
        }
        let step = Step { outputs, updates: vec![] };
        let simple = simplify(&step);
        let (found, expected) = (reference(&simple, &graph.bindings), reference(&step, &graph.bindings));
        for ((name, _), (found, expected)) in step.outputs.iter().zip(found.iter().zip(&expected)) {
            let error = worst(found, expected, 1e-6);
            assert!(error < 1e-11, "{}: `{name}` changed by {error:.2e}", sample.name);
        }
    }
}

/// Two functions may each make an axis of the same name for a sum of their own.
#[test]
fn axes_of_one_name_stay_apart() {
    let sum = |size: usize| {
        let other = Axis::new("other", size);
        Tensor::index(&other).to_f32().sum(&[&other])
    };
    let outputs = [3, 12].map(|n| (format!("sum to {n}"), sum(n)));
    let simple = simplify(&Step { outputs: outputs.into(), updates: vec![] });
    assert_eq!(reference(&simple, &Bindings::new()), [[3.0], [66.0]]);
}
