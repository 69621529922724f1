//! Simplification keeps every value: the simplified graph against the recorded one, both in the f64 reference.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::ops::{map, registry};
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::simplify::simplify;
use raygrad_compiler::{Step, Target, compile};
use raygrad_runtime::{Device, Session};
use raygrad_tests::backend::reference;
use raygrad_tests::{MidGraph, own_op, total, worst};

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

/// Products of factors that single precision does not hold stay apart: the reference has more room and cannot tell.
#[test]
fn factors_collect_only_where_single_precision_holds_their_product() {
    let x = Tensor::data("x", Shape::new(&[], 1));
    for (factors, x_is, expected) in
        [([1e30, 1e30], 0.0, 0.0), ([1e-30, 1e-30], 1e30, 1e-30), ([1e20, 1e-30], 2.0, 2e-10), ([3.0, 0.5], 2.0, 3.0)]
    {
        let y = &x * factors[0] * factors[1];
        let z = factors[1] * (factors[0] * &x);
        let step = Step { outputs: vec![("y".into(), y), ("z".into(), z)], updates: vec![] };
        let mut session = Session::new(Device::cpu(Some(1)).unwrap()).unwrap();
        let program = session.add(compile(&step, &Target::cpu()).unwrap()).unwrap();
        session.set("x", &[x_is]).unwrap();
        session.run(program).unwrap();
        for name in ["y", "z"] {
            let found = session.read(program, name).unwrap()[0];
            assert!((found - expected).abs() <= 1e-6 * expected, "{factors:?}: {found} instead of {expected}");
        }
    }
}

/// What a mean over an axis named twice is divided by.
#[test]
fn a_mean_counts_an_axis_once() {
    let axis = Axis::new("row", 4);
    let mean = Tensor::index(&axis).to_f32().mean(&[&axis, &axis]);
    assert_eq!(reference(&Step { outputs: vec![("mean".into(), mean)], updates: vec![] }, &Bindings::new()), [[1.5]]);
}

/// Two ops that print alike are two ops.
#[test]
fn ops_are_told_apart_by_type_and_name() {
    let x = Tensor::data("x", Shape::new(&[], 1));
    let outputs = vec![("negative".to_string(), -&x), ("twice".to_string(), map(own_op::Neg, &[&x]))];
    let simple = simplify(&Step { outputs, updates: vec![] });
    let x = Bindings::from([("x".to_string(), Array::floats(&Shape::new(&[], 1), vec![3.0]))]);
    assert_eq!(reference(&simple, &x), [[-3.0], [6.0]]);
}
