//! Simplification keeps every value: the simplified graph against the recorded one, both in the f64 reference.

use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::ops::registry;
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
