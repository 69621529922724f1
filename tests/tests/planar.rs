//! The planar graphs, whole: every warp with every encoding, first and second order, on every device, and in training.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::reference::{Array, Bindings, Data, evaluate};
use raygrad_compiler::{Step, Tensor};
use raygrad_runtime::{Device, DeviceError, Precision};
use raygrad_tests::backend::{devices, devices_for_large_programs, gpus};
use raygrad_tests::check::check;
use raygrad_tests::planar::{Planar, SMALL, TINY, Trajectory, combinations, output, train, train_reference};
use raygrad_tests::{Rng, seed, total};

/// Steps of central differences: across the kink of a rectifier a long one gives no derivative, a short one is inexact.
const STEPS: [f64; 3] = [1e-4, 1e-5, 1e-6];
const TOLERANCE: f64 = 1e-5;
/// Slopes below this are not resolved: the 1e-8 in a homography's denominator moves the fitted point, whose derivative
/// is taken as zero, and the alignment term has a weight of 100.
const FLOOR: f64 = 0.1;

/// A direction for each of some inputs.
type Direction = Vec<(String, Vec<f64>)>;

fn direction(inputs: &[Tensor], rng: &mut Rng) -> Direction {
    let lanes = |t: &Tensor| (0..t.shape().lanes()).collect::<Vec<_>>();
    let mut along = |t: &Tensor| lanes(t).iter().map(|_| rng.uniform(-1.0, 1.0)).collect();
    inputs.iter().map(|t| (t.input_name().unwrap_or_default().to_string(), along(t))).collect()
}

/// Central difference of a scalar along `direction`.
fn difference(scalar: &Tensor, bindings: &Bindings, direction: &Direction, step: f64) -> f64 {
    let at = |t: f64| {
        let mut moved = bindings.clone();
        for (name, along) in direction {
            let array = moved.get_mut(name).expect("an input with a value");
            array.f_mut().iter_mut().zip(along).for_each(|(x, d)| *x += t * d);
        }
        evaluate(std::slice::from_ref(scalar), &moved).unwrap_or_else(|e| panic!("{e}"))[0].f()[0]
    };
    (at(step) - at(-step)) / (2.0 * step)
}

fn check_slope(what: &str, scalar: &Tensor, bindings: &Bindings, direction: &Direction, found: f64) {
    let expected = STEPS.map(|step| difference(scalar, bindings, direction, step));
    let agrees = expected.iter().any(|e| (found - e).abs() <= TOLERANCE * (FLOOR + e.abs()));
    assert!(agrees, "{what}: the graph gives {found}, central differences give {expected:?}");
}

/// Sum of the gradients' products with a direction that is bound as data.
fn slope(gradients: &[Tensor], direction: &Direction, bindings: &mut Bindings) -> Tensor {
    let product = |(g, (name, along)): (&Tensor, &(String, Vec<f64>))| {
        let name = format!("direction {name}");
        let array = Array::floats(g.shape(), along.clone());
        bindings.insert(name.clone(), array);
        total(&(g * Tensor::data(name, g.shape().clone())))
    };
    gradients.iter().zip(direction).map(product).reduce(|a, b| a + b).expect("there are parameters")
}

/// Derivatives of the losses against central differences, and everything on every device against the reference.
fn check_model(planar: &Planar, devices: &[Device]) {
    let name = &planar.name;
    let mut rng = Rng(seed(name));
    let mut bindings = planar.bindings.clone();
    let step = planar.model.train_step();
    let parameters = planar.parameters();
    let wanted: Vec<&Tensor> = parameters.iter().collect();
    let loss = output(&step, "total");
    let first = grad(&loss, &wanted);

    let values = evaluate(&first, &bindings).unwrap_or_else(|e| panic!("{name}: {e}"));
    for (p, g) in parameters.iter().zip(&values) {
        let along = direction(std::slice::from_ref(p), &mut rng);
        let found = g.f().iter().zip(&along[0].1).map(|(g, d)| g * d).sum();
        check_slope(&format!("{name}, {}", along[0].0), &loss, &bindings, &along, found);
    }

    let along = direction(&parameters, &mut rng);
    let slope = slope(&grad(&loss, &wanted), &along, &mut bindings);
    let second = grad(&slope, &wanted);
    let values = evaluate(&second, &bindings).unwrap_or_else(|e| panic!("{name}: {e}"));
    let other = direction(&parameters, &mut rng);
    let found = values.iter().zip(&other).flat_map(|(g, (_, d))| g.f().iter().zip(d)).map(|(g, d)| g * d).sum();
    check_slope(&format!("{name}, second order"), &slope, &bindings, &other, found);

    let mut outputs = step.outputs;
    let named = |order: &'static str| move |(p, g): (&Tensor, Tensor)| (format!("{order} {p:?}"), g);
    outputs.extend(parameters.iter().zip(first).map(named("first")));
    outputs.extend(parameters.iter().zip(second).map(named("second")));
    let step = Step { outputs, updates: vec![] };
    check(devices, &step, &bindings).unwrap_or_else(|e| panic!("{name}: {e}"));
}

fn check_models(method: &str) {
    let devices = devices_for_large_programs();
    let chosen: Vec<Planar> = combinations().into_iter().filter(|p| p.name.starts_with(method)).collect();
    assert!(!chosen.is_empty(), "no model is called {method}");
    chosen.iter().for_each(|p| check_model(p, &devices));
}

#[test]
fn known_warps() {
    check_models("none");
}

#[test]
fn global_rotations_and_translations() {
    check_models("global 1");
    check_models("global 2");
}

#[test]
fn global_rigid_motions_and_homographies() {
    check_models("global 3");
    check_models("global 8");
}

#[test]
fn local_rotations_and_translations() {
    check_models("local 1");
    check_models("local 2");
}

#[test]
fn local_rigid_motions() {
    check_models("local 3");
}

#[test]
fn local_motions_to_homographies_by_eigenvectors() {
    check_models("local 8 eigen");
}

#[test]
fn local_motions_to_homographies_by_inverse_iteration() {
    check_models("local 8 inverse-iteration");
}

/// How far two trajectories may be apart.
struct Tolerance {
    /// Of losses, relative to the expected ones.
    losses: f64,
    /// Of parameters, relative to how far they moved.
    moved: f64,
}

fn assert_close(what: &str, start: &Bindings, found: &Trajectory, expected: &Trajectory, tolerance: Tolerance) {
    for (it, (found, expected)) in found.losses.iter().zip(&expected.losses).enumerate() {
        for (found, expected) in found.iter().zip(expected) {
            let error = (found - expected).abs();
            assert!(
                error <= tolerance.losses * expected.abs(),
                "{what}: loss {found} in step {it}, expected {expected}"
            );
        }
    }
    const PER_STEP: [&str; 6] = ["progress", "step", "lr.field", "lr.warp", "adam.bias1", "adam.bias2"];
    for (name, expected) in expected.after.iter().filter(|(name, _)| !PER_STEP.contains(&name.as_str())) {
        let (Some(found), Some(start)) = (found.after.get(name), start.get(name)) else { continue };
        if !matches!(expected.data, Data::F(_)) {
            continue;
        }
        let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        let (error, path) = (distance(found.f(), expected.f()), distance(start.f(), expected.f()));
        assert!(
            error <= tolerance.moved * path + 1e-6,
            "{what}: {name} is off by {error:.2e} after moving by {path:.2e}"
        );
    }
}

#[test]
fn five_steps_of_training_against_the_reference() {
    let devices = devices_for_large_programs();
    let averaged = [&SMALL[..], &["optim.average=2"]].concat();
    for preset in ["planar-l2g", "planar-l2g-rigid", "planar-barf", "planar-naive", "planar-none"] {
        let mut planar = Planar::new(preset, &averaged);
        let expected = train_reference(&mut planar, 5);
        for device in &devices {
            let found = train(device, &mut planar, 5);
            let what = format!("{preset} on {:?}", device.target().kind);
            let tolerance = Tolerance { losses: 1e-4, moved: 2e-2 };
            assert_close(&what, &planar.bindings, &found, &expected, tolerance);
        }
    }
}

/// Products of halves, with the scaled loss: Adam divides gradients by their own size, so that what rounding does to the
/// smallest of them, and so to their sign, counts as much as to the largest.
#[test]
fn five_steps_of_training_in_mixed_precision() {
    let set = [&SMALL[..], &["warp.layers=[64,64,64]", "warp.skip=[2]", "field.layers=[64,64]", "run.precision=mixed"]];
    for preset in ["planar-l2g", "planar-barf"] {
        let mut planar = Planar::new(preset, &set.concat());
        for state in ["loss_scale", "loss_scale.steps"] {
            planar.bindings.get_mut(state).expect("a state of the loss scale").f_mut().fill(0.0);
        }
        let expected = train_reference(&mut planar, 5);
        for device in devices() {
            let name = device.name();
            let mixed = match device.with_precision(Precision::Mixed) {
                Ok(mixed) => mixed,
                // Nothing requires halves of a GPU; those that tests run on anywhere store them.
                Err(DeviceError::NoHalf { .. }) => {
                    println!("skipped: {name} has no half precision");
                    continue;
                }
                Err(e) => panic!("{e}"),
            };
            let found = train(&mixed, &mut planar, 5);
            let what = format!("{preset} on {}", mixed.name());
            // The CPU's halves have 8 bits, those of GPUs 11.
            let wide = if matches!(mixed, Device::Cpu { .. }) { 3.0 } else { 1.0 };
            let tolerance = Tolerance { losses: 1e-2 * wide, moved: 0.1 * wide };
            assert_close(&what, &planar.bindings, &found, &expected, tolerance);
            assert_eq!(found.after["loss_scale"].f(), [65536.0], "{what}: a gradient was not finite");
        }
    }
}

/// The same training on all devices, losses to 1e-4 in every step.
fn twenty_steps_on_all(set: &[&str]) {
    let cpu = Device::cpu(Some(2)).expect("starts threads");
    for preset in ["planar-l2g", "planar-barf"] {
        let mut planar = Planar::new(preset, set);
        let expected = train(&cpu, &mut planar, 20);
        for gpu in gpus() {
            let found = train(&gpu, &mut planar, 20);
            assert_close(preset, &planar.bindings, &found, &expected, Tolerance { losses: 1e-4, moved: 5e-2 });
        }
    }
}

#[test]
fn twenty_steps_are_the_same_on_all_devices() {
    twenty_steps_on_all(&TINY);
}

#[test]
#[ignore = "minutes of kernel compilation on software drivers: scripts/test.sh --nightly runs it"]
fn twenty_steps_of_wide_networks_are_the_same_on_all_devices() {
    let set = ["data.patch_crop=[24,32]", "warp.layers=[64,64,64]", "warp.skip=[2]", "field.layers=[64,64]"];
    twenty_steps_on_all(&set);
}

fn bits(a: &Array) -> Vec<u64> {
    match &a.data {
        Data::F(v) => v.iter().map(|x| x.to_bits()).collect(),
        Data::U(v) => v.iter().map(|u| u64::from(*u)).collect(),
    }
}

#[test]
fn training_gives_the_same_bits_for_any_number_of_threads() {
    let set = ["data.patch_crop=[40,60]", "warp.layers=[64,64,64]", "warp.skip=[2]", "field.layers=[64,64]"];
    let drawn = [&set[..], &["data.points_per_patch=700"]].concat();
    for (preset, set) in [("planar-l2g", &set[..]), ("planar-barf", &set[..]), ("planar-l2g", &drawn[..])] {
        let mut planar = Planar::new(preset, set);
        let mut run = |threads: usize| {
            let found = train(&Device::cpu(Some(threads)).expect("starts threads"), &mut planar, 5);
            let mut inputs: Vec<(String, Vec<u64>)> = found.after.iter().map(|(n, a)| (n.clone(), bits(a))).collect();
            inputs.sort();
            let losses: Vec<u64> = found.losses.iter().flatten().map(|x| x.to_bits()).collect();
            assert!(found.losses[4] != found.losses[0], "{preset}: {:?} does not move", found.losses);
            (losses, inputs)
        };
        let one = run(1);
        for threads in [1, 2, 5] {
            assert!(run(threads) == one, "{preset} {set:?} differs with {threads} threads");
        }
    }
}
