//! The messages people get for their mistakes, as reviewed text.

use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, Target, compile};
use raygrad_runtime::{Device, RunError, Session};
use raygrad_tests::mistakes;

fn snapshot(name: &str, messages: &[(String, String)]) {
    let text: Vec<String> = messages.iter().map(|(what, message)| format!("# {what}\n{message}")).collect();
    let mut settings = insta::Settings::clone_current();
    settings.set_snapshot_path("../snapshots");
    settings.set_prepend_module_to_snapshot(false);
    settings.set_omit_expression(true);
    settings.bind(|| insta::assert_snapshot!(name, text.join("\n\n")));
}

#[test]
fn recording() {
    let message = |(what, t): (&str, Tensor)| {
        let e = t.error().unwrap_or_else(|| panic!("{what}: it fits"));
        (what.to_string(), e.to_string())
    };
    snapshot("messages-recording", &mistakes::recorded().into_iter().map(message).collect::<Vec<_>>());
}

#[test]
fn steps() {
    let all: Vec<_> = mistakes::steps().into_iter().map(|(what, e)| (what.to_string(), e.to_string())).collect();
    snapshot("messages-steps", &all);
}

/// A program with inputs `x` (floats) and `n` (an integer), and the output `y`.
fn step(rows: usize) -> Step {
    let ray = Axis::new("ray", rows);
    let x = Tensor::data("x", Shape::new(&[&ray], 2));
    let n = Tensor::per_step("n", Shape::new(&[], 1).with_dtype(DType::U32));
    Step { outputs: vec![("y".into(), x * n.to_f32())], updates: vec![] }
}

#[test]
fn running() {
    let device = Device::cpu(Some(1)).expect("starts a thread");
    let mut session = Session::new(device).expect("opens");
    let program = |rows, target: Target| compile(&step(rows), &target).expect("compiles");
    let id = session.add(program(8, Target::cpu())).expect("loads");
    let mut all = vec![];
    let mut note = |what: &str, result: Result<(), RunError>| {
        all.push((what.to_string(), result.expect_err("refused").to_string()));
    };
    note("a value too few", session.set("x", &[0.0; 15]));
    note("integers for a float", session.set_u32("x", &[0; 16]));
    note("a float for an integer", session.set("n", &[1.0]));
    note("part of an integer input, beyond its end", session.set_u32_from("n", 1, &[1]));
    note("part of an input of floats", session.set_u32_from("x", 0, &[1]));
    note("part of an input that no program has", session.set_u32_from("w", 0, &[1]));
    note("an input that no program has", session.set("w", &[1.0]));
    note("an input that no program has, read", session.get("w").map(drop));
    note("an output that the program lacks", session.read(id, "z").map(drop));
    note("a program of another size", session.add(program(9, Target::cpu())).map(drop));
    note("a program for a GPU", session.add(program(8, Target::gpu())).map(drop));
    let n = Tensor::data("n", Shape::new(&[], 1).with_dtype(DType::U32));
    let once = Step { outputs: vec![("y".into(), n.to_f32())], updates: vec![] };
    note(
        "an input set once, which was one of every step",
        session.add(compile(&once, &Target::cpu()).expect("compiles")).map(drop),
    );
    let mut other = Session::new(Device::cpu(Some(1)).expect("starts a thread")).expect("opens");
    note("a program too large", other.add(program(1 << 45, Target::cpu())).map(drop));
    note("its input", other.set("x", &[1.0]));
    other.add(program(9, Target::cpu())).expect("loads");
    note("a program of another session", other.run(id));
    note("an output of a program of another session", other.read(id, "y").map(drop));
    for (what, threads) in [("no threads", 0), ("threads for thousands of cores", 1025)] {
        all.push((what.into(), Device::cpu(Some(threads)).err().expect("refused").to_string()));
    }
    snapshot("messages-running", &all);
}
