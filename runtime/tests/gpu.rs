//! The backends for GPUs against the f64 reference, on whatever adapter there is; in tests that is software.
//!
//! Without an adapter these tests fail, unless `RAYGRAD_NO_GPU=1` says that none is expected.
#![cfg(feature = "gpu")]

use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::Tensor;
use raygrad_compiler::ops::registry;
use raygrad_runtime::Device;
use raygrad_tests::backend::{self, compare};
use raygrad_tests::{MidGraph, total};

/// Value, gradients, and gradients of the gradients' squares.
fn step(graph: &MidGraph, differentiable: bool) -> Step {
    let mut outputs = vec![("value".to_string(), graph.output.clone())];
    if differentiable {
        outputs.push(("loss".into(), graph.loss.clone()));
        let wanted: Vec<&Tensor> = graph.parameters.iter().collect();
        let first = grad(&graph.loss, &wanted);
        outputs.extend(first.iter().enumerate().map(|(i, g)| (format!("grad p{i}"), g.clone())));
        if let Some(squares) = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b) {
            let second = grad(&squares, &wanted);
            outputs.extend(second.into_iter().enumerate().map(|(i, g)| (format!("second p{i}"), g)));
        }
    }
    Step { outputs, updates: vec![] }
}

#[test]
fn every_op_on_wgpu() {
    backend::wgpu().iter().for_each(every_op);
}

#[test]
fn every_op_on_vulkan() {
    backend::vulkan().iter().for_each(every_op);
}

fn every_op(device: &Device) {
    let only = std::env::var("RAYGRAD_ONLY").ok();
    let mut failures = vec![];
    for sample in registry().into_iter().filter(|s| only.as_ref().is_none_or(|o| s.name.contains(o.as_str()))) {
        let graph = MidGraph::new(&sample);
        let start = std::time::Instant::now();
        // Rotations round in f32, and small gaps between eigenvalues enlarge what they leave.
        let tolerance = if sample.name == "sym_eig 9" { 1e-3 } else { 2e-5 };
        if let Err(e) = compare(device, &step(&graph, sample.differentiable), &graph.bindings, tolerance) {
            failures.push(format!("{}: {e}", sample.name));
        }
        println!("{:5} ms  {}", start.elapsed().as_millis(), sample.name);
    }
    assert!(failures.is_empty(), "{} ops fail\n{}", failures.len(), failures.join("\n\n"));
}
