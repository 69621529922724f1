//! Mixed precision on the CPU: products of bfloat16 pairs, on this machine's best instruction set.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Shape, Tensor, topological};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::Bindings;
use raygrad_compiler::{Step, compile};
use raygrad_runtime::{Device, Precision};
use raygrad_tests::backend::{compare, run};
use raygrad_tests::{Rng, seed, total};

fn cpu(threads: usize, precision: Precision) -> Device {
    Device::cpu(Some(threads)).and_then(|d| d.with_precision(precision)).unwrap_or_else(|e| panic!("{e}"))
}

type Activation = fn(&Tensor) -> Tensor;

/// Two layers with an activation between them, and the gradients of everything, of weights a second time: products over channels, over rows, with odd
/// numbers of both, of operands in parts (`wide`), of weights of each frame's own, and, after a rectifier, masked ones.
fn network(activation: Activation, rows: usize, widths: [usize; 3], wide: usize, per_frame: bool) -> Step {
    let (frame, row) = (Axis::new("frame", 3), Axis::new("row", rows));
    let own: &[&Axis] = if per_frame { &[&frame] } else { &[] };
    let [inputs, hidden, outputs] = widths;
    let x = Tensor::parameter("x", Shape::new(&[&frame, &row], inputs));
    let v = Tensor::parameter("v", Shape::new(own, (inputs, hidden)));
    let b = Tensor::parameter("b", Shape::new(own, hidden));
    let w = Tensor::parameter("w", Shape::new(own, (hidden + wide, outputs)));
    let h = activation(&(x.linear(&v) + &b));
    let h = if wide == 0 { h } else { concat([&h, &Tensor::data("wide", Shape::new(&[&frame, &row], wide))]) };
    let y = h.linear(&w);
    let up = Tensor::data("up", y.shape().clone());
    let gradients = grad(&total(&(&y * up)), &[&x, &v, &b, &w]);
    // In a direction of the inputs' own, once more.
    let second = grad(&total(&(&gradients[0] * &x)), &[&v, &w]);
    let outputs = [vec![y], gradients, second].concat();
    let names = ["y", "dx", "dv", "db", "dw", "d2v", "d2w"];
    Step { outputs: names.iter().map(|n| n.to_string()).zip(outputs).collect(), updates: vec![] }
}

fn networks(activation: Activation) -> Vec<Step> {
    vec![
        network(activation, 333, [2, 34, 3], 0, false),
        network(activation, 64, [63, 70, 33], 0, false),
        network(activation, 100, [7, 64, 1], 0, true),
        network(activation, 401, [70, 65, 96], 67, false),
        network(activation, 8, [1, 5, 1], 0, false),
    ]
}

/// Every input bound to numbers of `draw`.
fn bind(step: &Step, what: &str, draw: impl Fn(&mut Rng) -> f64) -> Bindings {
    let mut rng = Rng(seed(what));
    let mut bindings = Bindings::default();
    for t in topological(step.roots()) {
        if let Some(name) = t.input_name() {
            let mut array = rng.array(t.shape(), 0.0, 1.0);
            array.f_mut().iter_mut().for_each(|x| *x = draw(&mut rng));
            bindings.insert(name.into(), array);
        }
    }
    bindings
}

#[test]
fn products_of_small_integers_are_those_of_single_precision_to_the_bit() {
    let (single, mixed) = (cpu(2, Precision::F32), cpu(2, Precision::Mixed));
    for (i, step) in networks(Tensor::relu).iter().enumerate() {
        // Sums stay below 256: bfloat16 holds them all.
        let bindings = bind(step, "integers", |rng| 2.0 * (rng.bits() % 2) as f64 - 1.0);
        let (expected, found) = (run(&single, step, &bindings), run(&mixed, step, &bindings));
        for (((name, _), found), expected) in step.outputs.iter().zip(&found).zip(&expected) {
            assert!(found.iter().any(|x| *x != 0.0), "network {i}: `{name}` is zero");
            let differ = found.iter().zip(expected).filter(|(f, e)| f != e).count();
            assert_eq!(differ, 0, "network {i}: `{name}` differs in so many of {} values", found.len());
        }
    }
}

#[test]
fn networks_and_their_gradients_are_near_the_reference() {
    for step in networks(|x| x.softplus(1.0)) {
        let bindings = bind(&step, "reals", |rng| 2.0 * (rng.bits() % 4096) as f64 / 4096.0 - 1.0);
        // Eight bits of mantissa; of hundreds of products, some errors add up.
        if let Err(e) = compare(&cpu(2, Precision::Mixed), &step, &bindings, 2e-2) {
            panic!("{e}");
        }
        // Operands are rounded: in single precision the same comparison passes at a thousandth of that.
        assert!(compare(&cpu(2, Precision::Mixed), &step, &bindings, 2e-5).is_err(), "nothing was rounded");
    }
}

#[test]
fn results_have_the_same_bits_for_any_number_of_threads() {
    let step = network(Tensor::relu, 4000, [34, 64, 3], 0, false);
    let bindings = bind(&step, "threads", |rng| 2.0 * (rng.bits() % 4096) as f64 / 4096.0 - 1.0);
    let one = run(&cpu(1, Precision::Mixed), &step, &bindings);
    for threads in [2, 5] {
        assert!(run(&cpu(threads, Precision::Mixed), &step, &bindings) == one, "{threads} threads");
    }
}

#[test]
fn the_device_says_what_it_multiplies() {
    assert!(cpu(2, Precision::Mixed).name().contains("bf16 products"));
    assert!(!cpu(2, Precision::F32).name().contains("bf16"));
    // The same device again in single precision.
    let back = cpu(2, Precision::Mixed).with_precision(Precision::F32).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(back.name(), cpu(2, Precision::F32).name());
    // Programs are those of the CPU at any precision.
    assert!(compile(&networks(Tensor::relu)[0], &back.target()).is_ok());
}
