//! Simplification keeps every value: the simplified graph against the recorded one, both in the f64 reference.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Shape, Tensor, topological};
use raygrad_compiler::ops::pick::concat;
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

/// A code that enters two layers of a network gets its gradient from sums over rows: no layer brings those of every row back to
/// the code.
#[test]
fn gradients_of_codes_are_summed_before_layers() {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 12));
    let data = Tensor::data("x", Shape::new(&[&frame, &row], 3));
    let parameter = |name: &str, shape: Shape| Tensor::parameter(name, shape);
    let code = parameter("code", Shape::new(&[&frame], 4));
    let (first, second) = (parameter("first", Shape::new(&[], (7, 5))), parameter("second", Shape::new(&[], (12, 2))));
    let x = concat([&data, &code]);
    let hidden = x.linear(&first).sin();
    let y = concat([&hidden, &x]).linear(&second);
    let gradient = grad(&total(&(&y * &y)), &[&code]).remove(0);
    let step = Step { outputs: vec![("code".into(), gradient)], updates: vec![] };
    let simple = simplify(&step);
    let mut bindings = Bindings::new();
    for (name, shape) in
        [("x", data.shape()), ("code", code.shape()), ("first", first.shape()), ("second", second.shape())]
    {
        let values = (0..shape.lanes()).map(|i| ((i * 37 + 11) % 23) as f64 * 0.05 - 0.5).collect();
        bindings.insert(name.into(), Array::floats(shape, values));
    }
    let (found, expected) = (reference(&simple, &bindings), reference(&step, &bindings));
    assert!(worst(&found[0], &expected[0], 1e-6) < 1e-12, "{found:?} instead of {expected:?}");
    let to_code = |t: &Tensor| t.op().name() == "linear_transposed" && t.axes().contains(&row) && t.width() >= 4;
    let wide: Vec<Tensor> = topological(simple.roots()).into_iter().filter(to_code).collect();
    // What is left brings gradients back to the five hidden channels.
    assert!(wide.iter().all(|t| t.width() == 5), "{wide:?}");
    assert_eq!(wide.len(), 1, "{wide:?}");
}

/// A layer of one channel is added to all channels of another, and has no second one to choose.
#[test]
fn layers_that_are_added_to_wider_ones_stay() {
    let (row, x) = (Axis::new("row", 3), |name: &str, row: &Axis| Tensor::data(name, Shape::new(&[row], 2)));
    let w = |name: &str, columns: usize| Tensor::data(name, Shape::new(&[], (2, columns)));
    let added = x("x", &row).linear(&w("wide", 3)) + x("x", &row).linear(&w("narrow", 1));
    let step = Step { outputs: vec![("sum".into(), added.slice(1..3).sum(&[&row]))], updates: vec![] };
    let array = |shape: Shape| Array::floats(&shape, (1..=shape.lanes()).map(|i| i as f64).collect());
    let shapes =
        [("x", Shape::new(&[&row], 2)), ("wide", Shape::new(&[], (2, 3))), ("narrow", Shape::new(&[], (2, 1)))];
    let bindings: Bindings = shapes.into_iter().map(|(name, shape)| (name.to_string(), array(shape))).collect();
    let simple = simplify(&step);
    assert_eq!(reference(&simple, &bindings), reference(&step, &bindings));
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
