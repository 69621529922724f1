//! Where single precision ends: NaN and infinities, in the reference and on every backend.

use raygrad_compiler::functions::mlp::Activation;
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::{Step, compile};
use raygrad_tests::backend::{devices, reference, run};

const VALUES: [f32; 6] = [f32::NAN, 1.0, -2.0, 0.0, f32::INFINITY, f32::NEG_INFINITY];

/// Lanes of `f` on every device, of rows of two channels: all pairs of [`VALUES`].
fn of_pairs(f: impl Fn(&Tensor, &Axis) -> Tensor) -> Vec<(String, Vec<f32>)> {
    let row = Axis::new("row", VALUES.len().pow(2));
    let x = Tensor::data("x", Shape::new(&[&row], 2));
    let outputs = vec![("y".to_string(), f(&x, &row))];
    let lanes = VALUES.iter().flat_map(|a| VALUES.map(|b| [*a as f64, b as f64])).flatten().collect();
    let bindings = Bindings::from([("x".to_string(), Array::floats(x.shape(), lanes))]);
    let step = Step { outputs, updates: vec![] };
    let single = |v: Vec<Vec<f64>>| v[0].iter().map(|x| *x as f32).collect::<Vec<f32>>();
    let reference = ("reference".to_string(), single(reference(&step, &bindings)));
    let on = |d: raygrad_runtime::Device| (d.name(), single(run(&d, &step, &bindings)));
    std::iter::once(reference).chain(devices().into_iter().map(on)).collect()
}

fn larger(a: f32, b: f32) -> f32 {
    if a.is_nan() || b.is_nan() { f32::NAN } else { a.max(b) }
}

#[test]
fn maxima_and_minima_pass_nan_on() {
    type Case<'f> = (&'f str, &'f dyn Fn(&Tensor) -> Tensor, fn(f32, f32) -> f32);
    let cases: [Case; 8] = [
        ("max", &|x| x.ch(0).max(&x.ch(1)), larger),
        ("min", &|x| x.ch(0).min(&x.ch(1)), |a, b| -larger(-a, -b)),
        ("max_channels", &|x| x.max_channels(), larger),
        ("relu", &|x| x.ch(0).relu(), |a, _| larger(a, 0.0)),
        ("clamp", &|x| x.ch(0).clamp(-1.0, 0.5), |a, _| a.clamp(-1.0, 0.5)),
        ("clamp from below", &|x| x.ch(0).clamp(-1.0, f64::INFINITY), |a, _| larger(a, -1.0)),
        ("elu", &|x| Activation::Elu.apply(&x.ch(0)), |a, _| if a > 0.0 { a } else { a.exp_m1() }),
        ("softplus", &|x| x.ch(0).softplus(1.0), |a, _| if a > 20.0 { a } else { a.exp().ln_1p() }),
    ];
    let mut failures = vec![];
    for (name, f, expected) in cases {
        for (device, found) in of_pairs(|x, _| f(x)) {
            for (i, y) in found.into_iter().enumerate() {
                let pair = (VALUES[i / VALUES.len()], VALUES[i % VALUES.len()]);
                let expected = expected(pair.0, pair.1);
                if !(y.is_nan() && expected.is_nan() || y == expected || (y - expected).abs() < 1e-6) {
                    failures.push(format!("{device}: {name} of {pair:?} is {y}, not {expected}"));
                }
            }
        }
    }
    assert!(failures.is_empty(), "{} points\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn maxima_over_rows_and_rectified_layers_pass_nan_on() {
    // Positions of NaN that different parts of a reduction see: vectors, what is left of them, chunks.
    for (rows, place) in [(5, 0), (5, 4), (100, 3), (100, 98), (9000, 17), (9000, 8990)] {
        let (frame, row) = (Axis::new("frame", 2), Axis::new("row", rows));
        let x = Tensor::data("x", Shape::new(&[&frame, &row], 3));
        let w = Tensor::data("w", Shape::new(&[], (3, 16)));
        let layer = x.linear(&w).relu();
        let outputs = vec![
            ("largest".to_string(), x.max_over(&[&row])),
            ("over frames".to_string(), x.max_over(&[&frame])),
            ("layer".to_string(), layer),
        ];
        let mut lanes: Vec<f64> = (0..6 * rows).map(|i| (i % 7) as f64 - 9.0).collect();
        lanes[3 * place + 1] = f64::NAN;
        let bindings = Bindings::from([
            ("x".to_string(), Array::floats(x.shape(), lanes)),
            ("w".to_string(), Array::floats(w.shape(), (0..48).map(|i| (i % 5) as f64 - 2.0).collect())),
        ]);
        let step = Step { outputs, updates: vec![] };
        let expected = reference(&step, &bindings);
        assert!(expected.iter().all(|v| v.iter().any(|x| x.is_nan()) && v.iter().any(|x| !x.is_nan())));
        for device in devices() {
            let program = || compile(&step, &device.target()).map(|p| p.to_string());
            for (i, (found, expected)) in run(&device, &step, &bindings).iter().zip(&expected).enumerate() {
                let same = found.iter().zip(expected).all(|(a, b)| a == b || a.is_nan() && b.is_nan());
                assert!(same, "{}, {rows} rows, {place}: {}\n{:?}", device.name(), step.outputs[i].0, program());
            }
        }
    }
}
