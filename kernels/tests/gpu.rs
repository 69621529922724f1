//! Every op's kernels, forward and backward: valid naga modules, WGSL that parses again, SPIR-V that `spirv-val` accepts.
#![cfg(feature = "gpu")]

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::Tensor;
use raygrad_compiler::ops::registry;
use raygrad_compiler::{Step, Target, compile};
use raygrad_kernels::gpu::{Inputs, Kernel, Limits, lower};
use raygrad_tests::MidGraph;
use std::io::Write;
use std::process::{Command, Stdio};

/// Kernels of the sample's output, loss and gradients.
fn kernels(graph: &MidGraph, name: &str) -> Vec<Kernel> {
    let wanted: Vec<&Tensor> = graph.parameters.iter().collect();
    let mut outputs = vec![("output".to_string(), graph.output.clone()), ("loss".into(), graph.loss.clone())];
    let gradients = grad(&graph.loss, &wanted);
    outputs.extend(gradients.into_iter().enumerate().map(|(i, g)| (format!("gradient {i}"), g)));
    let step = Step { outputs, updates: vec![] };
    let program = compile(&step, &Target::gpu()).unwrap_or_else(|e| panic!("{name}: {e}"));
    let lowered = lower(&program, &mut Inputs::default(), &Limits::default());
    let lowered = lowered.unwrap_or_else(|e| panic!("{name}: {e}\n{program}"));
    lowered.launches.into_iter().flat_map(|l| l.kernels).collect()
}

fn each(f: impl Fn(&str, &Kernel)) {
    for sample in registry() {
        for kernel in kernels(&MidGraph::new(&sample), &sample.name) {
            f(&sample.name, &kernel);
        }
    }
}

#[test]
fn wgsl_parses_again() {
    each(|sample, kernel| {
        let wgsl = kernel.wgsl().unwrap_or_else(|e| panic!("{sample}: {e}"));
        let parsed = naga::front::wgsl::parse_str(&wgsl);
        parsed.unwrap_or_else(|e| panic!("{sample}, {}: {}\n{wgsl}", kernel.name, e.emit_to_string(&wgsl)));
    });
}

#[test]
fn kernels_fit_what_every_device_has() {
    each(|sample, kernel| {
        assert!(kernel.bindings.len() <= 8, "{sample}, {}: {:?}", kernel.name, kernel.bindings);
        assert!(kernel.workgroup_size <= 256, "{sample}, {}", kernel.name);
        assert!(kernel.workgroups.iter().all(|n| (1..=65535).contains(n)), "{sample}, {}", kernel.name);
    });
}

#[test]
fn spirv_is_valid() {
    let installed = Command::new("spirv-val").arg("--version").output().is_ok();
    each(|sample, kernel| {
        let words = kernel.spirv().unwrap_or_else(|e| panic!("{sample}: {e}"));
        assert!(words.len() > 5, "{sample}, {}", kernel.name);
        if !installed {
            return;
        }
        let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
        let mut check = Command::new("spirv-val")
            .args(["--target-env", "vulkan1.1", "-"])
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("spirv-val starts");
        check.stdin.take().expect("a pipe").write_all(&bytes).expect("spirv-val reads");
        let result = check.wait_with_output().expect("spirv-val ends");
        let text = String::from_utf8_lossy(&result.stdout).into_owned() + &String::from_utf8_lossy(&result.stderr);
        assert!(result.status.success(), "{sample}, {}: {text}", kernel.name);
    });
}
