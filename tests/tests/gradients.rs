//! Every op of the registry: shape, first and second derivatives against central differences, mid-graph.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::Tensor;
use raygrad_compiler::ops::{Sample, registry};
use raygrad_compiler::reference::evaluate;
use raygrad_tests::{MidGraph, check_gradient, check_second_order};

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
            check_gradient(&graph.loss, &graph.parameters, &graph.bindings, 1e-8, &sample.name);
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
        if sample.differentiable && !graph.parameters.is_empty() {
            check_second_order(&graph.loss, &graph.parameters, &graph.bindings, 1e-7, &sample.name);
        }
    });
}
