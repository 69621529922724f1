//! Plans and kernels as reviewed text: of every form of kernel and of the planar models.
//!
//! After an intended change, `INSTA_UPDATE=always cargo test -p raygrad-tests --test snapshots` writes the new texts; review
//! their differences like code. Source lines are left out, so that moving code changes nothing.

use raygrad_compiler::{Step, Target, compile};
use raygrad_tests::forms::forms;
use raygrad_tests::planar::Planar;

fn snapshot(name: &str, text: &str) {
    let mut settings = insta::Settings::clone_current();
    settings.set_snapshot_path("../snapshots");
    settings.set_prepend_module_to_snapshot(false);
    settings.set_omit_expression(true);
    settings.bind(|| insta::assert_snapshot!(name, text));
}

fn plan(step: &Step, target: &Target) -> String {
    without_lines(&compile(step, target).unwrap_or_else(|e| panic!("{e}")).to_string())
}

/// The text without the source lines, `file.rs:12`, in the names of buffers.
fn without_lines(text: &str) -> String {
    let word = |w: &str| w.split_once(".rs:").is_some_and(|(_, line)| line.starts_with(|c: char| c.is_ascii_digit()));
    let line = |l: &str| l.split(' ').filter(|w| !word(w)).collect::<Vec<_>>().join(" ");
    text.lines().map(line).collect::<Vec<_>>().join("\n")
}

fn plans(step: &Step) -> String {
    format!("{}\n\n{}", plan(step, &Target::cpu()), plan(step, &Target::gpu()))
}

#[test]
fn plans_of_every_form() {
    for (name, step) in forms() {
        snapshot(&format!("plan-{name}"), &plans(&step));
    }
}

#[test]
fn plans_of_the_planar_models() {
    for preset in ["planar-l2g", "planar-l2g-small", "planar-l2g-rigid", "planar-barf"] {
        let step = Planar::recorded(preset).train_step();
        snapshot(&format!("plan-{preset}-cpu"), &plan(&step, &Target::cpu()));
        snapshot(&format!("plan-{preset}-gpu"), &plan(&step, &Target::gpu()));
    }
}

/// Names of tensors and axes count up as they are made: none may show.
#[test]
fn plans_do_not_depend_on_what_was_recorded_before() {
    let all = || -> Vec<String> { forms().iter().map(|(_, step)| plans(step)).collect() };
    let first = all();
    let planar = || plans(&Planar::recorded("planar-l2g").train_step());
    let model = planar();
    let others: Vec<_> =
        (0..3).map(|_| std::thread::spawn(move || Planar::recorded("planar-barf").train_step())).collect();
    assert!(all() == first && planar() == model);
    others.into_iter().for_each(|t| assert!(t.join().is_ok()));
    assert!(all() == first && planar() == model);
}

#[cfg(feature = "gpu")]
mod wgsl {
    use super::{Planar, snapshot};
    use raygrad_compiler::autodiff::grad;
    use raygrad_compiler::functions::composite::composite_above;
    use raygrad_compiler::graph::{Axis, Shape, Tensor};
    use raygrad_compiler::ops::pick::concat;
    use raygrad_compiler::{Step, Target, compile};
    use raygrad_kernels::gpu::{Half, Inputs, Limits, Matrices, SOFTWARE_TILES, lower};
    use raygrad_tests::forms::forms;

    /// Every kernel of a step.
    fn kernels(step: &Step) -> String {
        kernels_within(step, &Limits { max_binding: u64::MAX, ..Limits::default() })
    }

    fn kernels_within(step: &Step, limits: &Limits) -> String {
        kernels_of(step, &Target::gpu(), limits)
    }

    fn kernels_of(step: &Step, target: &Target, limits: &Limits) -> String {
        let program = compile(step, target).unwrap_or_else(|e| panic!("{e}"));
        let lowered = lower(&program, &mut Inputs::default(), limits).unwrap_or_else(|e| panic!("{e}"));
        let kernels = lowered.launches.iter().flat_map(|l| &l.kernels);
        let text = kernels.map(|k| {
            let wgsl = k.wgsl().unwrap_or_else(|e| panic!("{e}"));
            format!("// {}: {:?} workgroups of {}\n{wgsl}", k.name, k.workgroups, k.workgroup_size)
        });
        text.collect::<Vec<_>>().join("\n")
    }

    #[test]
    fn kernels_of_every_form() {
        for (name, step) in forms() {
            snapshot(&format!("wgsl-{name}"), &kernels(&step));
        }
    }

    /// A layer and what follows from it in half precision, without cooperative matrices and with them, and in the tiles of drivers
    /// in software.
    #[test]
    fn kernels_of_other_tiles() {
        let row = Axis::new("row", 1200);
        let x = Tensor::data("x", Shape::new(&[&row], 40));
        let w = Tensor::parameter("w", Shape::new(&[], (40, 100)));
        let b = Tensor::parameter("b", Shape::new(&[], 100));
        let y = (x.linear(&w) + &b).relu();
        let loss = (&y * &y).sum_channels().sum(&[&row]);
        let gradients = grad(&loss, &[&w, &b]);
        let step =
            Step { outputs: ["dw", "db"].map(str::to_string).into_iter().zip(gradients).collect(), updates: vec![] };
        for (name, matrices) in [("halves", None), ("matrices", Some(Matrices { side: 16, subgroup: 32 }))] {
            let limits = Limits { half: Some(Half { matrices }), max_workgroup_bytes: 48 << 10, ..Limits::default() };
            snapshot(&format!("wgsl-{name}"), &kernels_within(&step, &limits));
        }
        snapshot("wgsl-software", &kernels_within(&step, &Limits { tiles: SOFTWARE_TILES, ..Limits::default() }));
    }

    /// A network that stays in a workgroup, and one that follows rays until they are dark.
    #[test]
    fn kernels_of_resident_networks() {
        let p = |name: &str, rows: usize, columns: usize| Tensor::parameter(name, Shape::new(&[], (rows, columns)));
        let (ray, sample) = (Axis::new("ray", 300), Axis::new("sample", 100));
        let depth = Tensor::data("depth", Shape::new(&[&ray, &sample], 1));
        let x = concat([&depth.sin(), &depth.cos()]);
        let hidden = x.linear(&p("a", 2, 24)).relu();
        let y = concat([&hidden, &x]).linear(&p("b", 26, 4));
        let one = Tensor::scalar(1.0);
        let seen = composite_above(1e-3, &y.slice(1..4).sigmoid(), &y.ch(0).softplus(1.0), &depth, &one, &sample);
        for (name, output) in [("network", y), ("ray", seen.color)] {
            let step = Step { outputs: vec![("y".into(), output)], updates: vec![] };
            let target = Target::gpu().with_resident(&step);
            snapshot(&format!("plan-{name}"), &super::plan(&step, &target));
            let limits = Limits { max_binding: u64::MAX, ..Limits::default() };
            snapshot(&format!("wgsl-{name}"), &kernels_of(&step, &target, &limits));
        }
    }

    #[test]
    fn kernels_of_the_planar_models() {
        for preset in ["planar-l2g", "planar-barf"] {
            snapshot(&format!("wgsl-{preset}"), &kernels(&Planar::recorded(preset).train_step()));
        }
    }
}
