//! Every op on every backend against the f64 reference: value, first and second derivatives, mid-graph.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::ops::registry;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};
use raygrad_runtime::{Device, Session};
use raygrad_tests::backend::{compare, devices};
use raygrad_tests::{MidGraph, total};

/// Value, gradients, and the gradient of the gradients' squares.
fn step(graph: &MidGraph, differentiable: bool) -> Step {
    let mut outputs = vec![("value".to_string(), graph.output.clone())];
    if differentiable {
        let wanted: Vec<_> = graph.parameters.iter().collect();
        let first = grad(&graph.loss, &wanted);
        let squares = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b);
        outputs.extend(first.iter().enumerate().map(|(i, g)| (format!("grad p{i}"), g.clone())));
        if let Some(squares) = squares {
            let second = grad(&squares, &wanted);
            outputs.extend(second.into_iter().enumerate().map(|(i, g)| (format!("second p{i}"), g)));
        }
    }
    Step { outputs, updates: vec![] }
}

fn every_op(device: &Device) {
    let mut failures = vec![];
    for sample in registry() {
        let graph = MidGraph::new(&sample);
        if let Err(e) = compare(device, &step(&graph, sample.differentiable), &graph.bindings, 2e-5) {
            failures.push(format!("{}: {e}", sample.name));
        }
    }
    assert!(failures.is_empty(), "{} ops fail\n{}", failures.len(), failures.join("\n\n"));
}

#[test]
fn every_op_on_the_cpu() {
    every_op(&Device::cpu(Some(2)).unwrap());
}

#[test]
fn inputs_are_set_part_by_part() {
    for device in devices() {
        let place = Axis::new("place", 7);
        let n = Tensor::data("n", Shape::new(&[&place], 1).with_dtype(DType::U32));
        let outputs = vec![("y".to_string(), n.wrapping_add(&Tensor::index(&place)))];
        let program = compile(&Step { outputs, updates: vec![] }, &device.target()).unwrap();
        let mut session = Session::new(device).unwrap();
        let id = session.add(program).unwrap();
        session.set_u32("n", &[10, 20, 30, 40, 50, 60, 70]).unwrap();
        session.set_u32_from("n", 2, &[1, 2, 3]).unwrap();
        session.set_u32_from("n", 6, &[4]).unwrap();
        session.run(id).unwrap();
        assert_eq!(session.read_lanes(id, "y").unwrap(), [10, 21, 3, 5, 7, 65, 10]);
    }
}
