//! Where single precision ends: NaN, infinities, zero, tiny and huge numbers, and what is nearly singular. Values and gradients of
//! every backend are compared with the f64 reference point by point.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::inverse::inverse;
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::mlp::Activation;
use raygrad_compiler::functions::vector::{norm, normalize};
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::{Step, compile};
use raygrad_tests::backend::{devices, reference, round, run};
use raygrad_tests::total;

/// The largest number that single precision may take for zero.
const NOTHING: f64 = 1.2e-38;

/// An operand: values of its channels at every point.
type Operand<'v> = &'v [&'v [f64]];

/// What `f` gives of some points, and the gradients of a weighted sum of its channels, on every device.
fn at(name: &str, operands: &[Operand], f: impl Fn(&[Tensor]) -> Tensor, tolerance: f64) -> Vec<String> {
    let point = Axis::new("point", operands[0].len());
    let mut bindings = Bindings::new();
    let mut parameters = vec![];
    for (i, points) in operands.iter().enumerate() {
        let shape = Shape::new(&[&point], points[0].len());
        bindings.insert(format!("p{i}"), Array::floats(&shape, points.concat()));
        parameters.push(Tensor::parameter(format!("p{i}"), shape));
    }
    let y = f(&parameters);
    let weights: Vec<f64> = (0..y.width()).map(|c| 1.0 / (1.0 + c as f64)).collect();
    let loss = total(&(y.reshape(y.width()) * Tensor::constant(&weights)));
    let mut outputs = vec![("value".to_string(), y)];
    for (i, g) in grad(&loss, &parameters.iter().collect::<Vec<_>>()).into_iter().enumerate() {
        outputs.push((format!("gradient {i}"), g));
    }
    let (step, bindings) = (Step { outputs, updates: vec![] }, round(&bindings));
    let expected = reference(&step, &bindings);
    let mut failures = vec![];
    for device in devices() {
        for (((what, _), found), expected) in step.outputs.iter().zip(run(&device, &step, &bindings)).zip(&expected) {
            let width = expected.len() / point.size();
            for (i, (found, expected)) in found.chunks(width).zip(expected.chunks(width)).enumerate() {
                let scale = expected.iter().fold(0.0f64, |m, x| m.max(x.abs()));
                let near = |(a, b): (&f64, &f64)| a == b || (a - b).abs() <= tolerance * scale + NOTHING;
                if !expected.iter().all(|x| x.is_finite()) || !found.iter().zip(expected).all(near) {
                    let at: Vec<_> = operands.iter().map(|o| o[i]).collect();
                    let device = device.name();
                    failures.push(format!("{device}: {name}, {what} at {at:?} is {found:?}, not {expected:?}"));
                }
            }
        }
    }
    failures
}

fn none(failures: Vec<Vec<String>>) {
    let all = failures.concat();
    assert!(all.is_empty(), "{} points\n{}", all.len(), all.join("\n"));
}

/// Points of one channel.
fn points<const N: usize>(values: &[f64; N]) -> [&[f64]; N] {
    std::array::from_fn(|i| &values[i..=i])
}

#[test]
fn angles_of_tiny_and_huge_vectors() {
    let y = points(&[1e-25, 3e-25, 1e25, 2e30, 1e-30, 1.0, 0.0, -1e-20, 3e37, 0.3]);
    let x = points(&[1e-25, -4e-25, 1e25, -1e28, 1.0, 1e-30, 1e-20, 0.0, 3e37, -0.4]);
    none(vec![at("atan2", &[&y, &x], |p| p[0].atan2(&p[1]), 2e-6)]);
}

#[test]
fn quotients_roots_and_logarithms_far_from_one() {
    let a = points(&[1e-25, 1e20, 1e30, -3e-18, 0.0, 1.0]);
    let b = points(&[1e-15, 1e25, -1e-4, 2e-18, 1e-18, 3.0]);
    let x = points(&[1e-36, 1e-30, 1e-10, 0.3, 1e30, 3e38]);
    none(vec![
        at("div", &[&a, &b], |p| &p[0] / &p[1], 1e-6),
        at("sqrt", &[&x], |p| p[0].sqrt(), 1e-6),
        at("sqrt at 0", &[&points(&[0.0])], |p| p[0].sqrt(), 0.0),
        at("log", &[&x], |p| p[0].log(), 1e-6),
    ]);
}

#[test]
fn activations_near_zero_and_far_out() {
    let x = points(&[1e-30, -1e-30, 1e-8, -1e-8, 3e-4, -3e-4, 0.2, -0.2, -1.0, 2.0, 15.0, -15.0, -80.0, 0.0]);
    let activations = [
        Activation::Elu,
        Activation::Softplus(1.0),
        Activation::Gaussian(0.1),
        Activation::Silu,
        Activation::Sine(30.0),
        Activation::Relu,
    ];
    let all = activations.map(|a| at(&format!("{a:?}"), &[&x], move |p| a.apply(&p[0]), 1e-5));
    let gaussian = at("wide gaussian", &[&points(&[1e19, 1e25, -3e38])], |p| p[0].gaussian(2.0), 0.0);
    none(all.into_iter().chain([gaussian]).collect());
}

#[test]
fn digits_of_functions_near_their_special_points() {
    let small = points(&[1e-30, -1e-30, 1e-8, -1e-8, 3e-4, -0.3, 0.49, 0.51, -0.51, 3.0, 80.0]);
    let all: Vec<f64> = small.iter().map(|x| x[0]).chain([-15.0, -90.0, 0.0]).collect();
    let wide: Vec<&[f64]> = all.chunks(1).collect();
    let sines = points(&[0.0, 1e-30, -1e-8, 0.3, -0.7, 0.999, 0.9999999, -0.9999999, 1.5, -40.0]);
    let bases = points(&[1e-30, 1e-3, 0.7, 1.0, 1.5, 1e3, 0.0]);
    let exponents = points(&[0.5, -2.5, 3.0, 0.0, 20.0, -3.0, 2.0]);
    none(vec![
        at("expm1", &[&wide], |p| p[0].expm1(), 2e-6),
        at("log1p", &[&small], |p| p[0].log1p(), 2e-6),
        at("asin", &[&sines], |p| p[0].asin(), 2e-6),
        at("acos", &[&sines], |p| p[0].acos(), 2e-6),
        at("pow", &[&bases, &exponents], |p| p[0].pow(&p[1]), 2e-5),
    ]);
}

#[test]
fn lengths_and_directions_of_tiny_and_huge_vectors() {
    let vectors: [&[f64]; 7] = [
        &[1e-30, 2e-30, -2e-30],
        &[0.0, 0.0, 0.0],
        &[3e30, -4e30, 1e29],
        &[1e-20, 0.0, 1e20],
        &[0.6, 0.8, 0.0],
        &[0.0, -2e-38, 0.0],
        &[1.5e38, 1.5e38, 0.0],
    ];
    let short: Vec<&[f64]> = vectors[..5].to_vec();
    none(vec![
        at("norm", &[&vectors], |p| norm(&p[0]), 2e-6),
        at("normalize", &[&short], |p| normalize(&p[0]), 4e-6),
        at(
            "inverse",
            &[&[&[1e-12, 2e-12, 3e-12, -4e-12], &[1e12, 1.0, 1.0, 1e12]]],
            |p| inverse(&p[0].reshape((2, 2))),
            4e-6,
        ),
    ]);
}

#[test]
fn motions_near_none_and_near_half_a_turn() {
    let half = std::f64::consts::PI;
    let twists: [&[f64]; 6] = [
        &[0.0; 6],
        &[1e-30, -1e-30, 2e-30, 1.0, 2.0, 3.0],
        &[1e-6, 2e-5, -1e-7, 1e-9, 0.0, 1e-8],
        &[half, 0.0, 0.0, 1.0, -1.0, 0.5],
        &[half / 2.0, -half / 2.0, half / 2f64.sqrt() - 1e-4, 0.3, 0.2, 0.1],
        &[3.0, 2.0, 2.5, -1.0, 1.0, 1.0],
    ];
    none(vec![at("se3_exp", &[&twists], |p| se3_exp(&p[0]), 2e-5)]);
}

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
    let cases: [Case; 11] = [
        ("max", &|x| x.ch(0).max(&x.ch(1)), larger),
        ("min", &|x| x.ch(0).min(&x.ch(1)), |a, b| -larger(-a, -b)),
        ("max_channels", &|x| x.max_channels(), larger),
        ("relu", &|x| x.ch(0).relu(), |a, _| larger(a, 0.0)),
        ("clamp", &|x| x.ch(0).clamp(-1.0, 0.5), |a, _| a.clamp(-1.0, 0.5)),
        ("clamp from below", &|x| x.ch(0).clamp(-1.0, f64::INFINITY), |a, _| larger(a, -1.0)),
        // No driver may make a product of it.
        ("powf of 2", &|x| x.ch(0).powf(2.0), |a, _| if a < 0.0 { f32::NAN } else { a * a }),
        ("powf of 1", &|x| x.ch(0).powf(1.0), |a, _| if a < 0.0 { f32::NAN } else { a }),
        ("powf of 0", &|x| x.ch(0).powf(0.0), |_, _| 1.0),
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
