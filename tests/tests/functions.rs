//! Derived operations: identities they obey, derivatives to second order, and special cases.

use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::functions::homography::{Solver, fit_homography};
use raygrad_compiler::functions::image::{ImageTable, isotropic_to_pixels};
use raygrad_compiler::functions::lie::{expm, se2_exp, se3_exp, sl3_exp, so3_exp};
use raygrad_compiler::functions::matrix::{
    apply, apply_homography, compose_poses, identity, invert_pose, matmul, solve_symmetric,
};
use raygrad_compiler::functions::mlp::{Activation, Init, Mlp, MlpSpec};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, positional_encoding};
use raygrad_compiler::functions::rigid_fit::{fit_rigid_2d, fit_rigid_3d, fit_rotation_2d, fit_translation};
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::reference::Array;
use raygrad_tests::backend::{devices, reference, round, run};
use raygrad_tests::vectors::Bound;
use raygrad_tests::{Rng, check_gradient, check_second_order, derivatives, total, worst};

fn shape(axes: &[&Axis], channels: usize) -> Shape {
    Shape::new(axes, channels)
}

#[test]
fn derivatives_of_exponentials() {
    let row = Axis::new("row", 2);
    derivatives("so3_exp", &[(shape(&[&row], 3), -1.0, 1.0)], |x| so3_exp(&x[0]));
    derivatives("se3_exp", &[(shape(&[&row], 6), -1.0, 1.0)], |x| se3_exp(&x[0]));
    derivatives("se3_exp at 0", &[(shape(&[&row], 6), 0.0, 0.0)], |x| se3_exp(&x[0]));
    derivatives("se2_exp", &[(shape(&[&row], 3), -1.0, 1.0)], |x| se2_exp(&x[0]));
    derivatives("sl3_exp", &[(shape(&[&row], 8), -0.4, 0.4)], |x| sl3_exp(&x[0]));
}

#[test]
fn derivatives_of_fits() {
    let (frame, point) = (Axis::new("frame", 2), Axis::new("point", 7));
    let over = Axes::new([point.clone()]);
    let set = |n: usize| (shape(&[&frame, &point], n), -1.0, 1.0);
    derivatives("fit_rotation_2d", &[set(2), set(2)], |x| fit_rotation_2d(&x[0], &x[1], &over));
    derivatives("fit_translation", &[set(2), set(2)], |x| fit_translation(&x[0], &x[1], &over));
    derivatives("fit_rigid_2d", &[set(2), set(2)], |x| fit_rigid_2d(&x[0], &x[1], &over));
    // Targets near the points: the fit of two unrelated sets has no large gap between its eigenvalues.
    derivatives("fit_rigid_3d", &[set(3), set(3)], |x| fit_rigid_3d(&[(&x[0], &(&x[0] + &x[1] * 0.2))], &over));
    for solver in [Solver::Eigen, Solver::InverseIteration] {
        derivatives(&format!("fit_homography {solver:?}"), &[set(2), set(2)], |x| {
            fit_homography(&x[0], &(&x[0] + &x[1] * 0.2), &over, solver, None)
        });
    }
}

#[test]
fn derivatives_of_the_rest() {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 3));
    derivatives("positional_encoding", &[(shape(&[&row], 2), -1.0, 1.0)], |x| {
        positional_encoding(&x[0], 3, Some(&Tensor::constant(&[1.0, 0.5, 0.0])))
    });
    let homography = (Shape::new(&[&frame], (3, 3)), -0.2, 0.2);
    derivatives("apply_homography", &[homography, (shape(&[&row], 2), -1.0, 1.0)], |x| {
        apply_homography(&(&x[0] + identity(3)), &x[1])
    });
    let matrix = (Shape::new(&[&frame], (4, 4)), -1.0, 1.0);
    derivatives("solve_symmetric", &[matrix, (shape(&[], 4), -1.0, 1.0)], |x| {
        solve_symmetric(&(matmul(&x[0], &x[0].transpose()) + identity(4)), &x[1])
    });
    for activation in [Activation::Tanh, Activation::Gaussian(0.5), Activation::Softplus(2.0), Activation::Sigmoid] {
        let spec = MlpSpec::new("net", &[2, 3, 3, 1]).skip(&[2]).hidden(activation).axes(&Axes::new([frame.clone()]));
        let mlp = Mlp::new(spec);
        let mut bound = Bound::default();
        let mut rng = Rng(1);
        let mut parameters: Vec<Tensor> = mlp.parameters.iter().map(|p| p.tensor.clone()).collect();
        parameters.push(Tensor::parameter("x", shape(&[&row], 2)));
        for p in &parameters {
            let name = p.input_name().expect("a parameter has a name").to_string();
            bound.bindings.insert(name, rng.array(p.shape(), -1.0, 1.0));
        }
        let loss = total(&mlp.apply(&parameters[6]).sin());
        check_gradient(&loss, &parameters, &bound.bindings, 1e-7, "mlp");
        check_second_order(&loss, &parameters, &bound.bindings, 1e-6, "mlp");
    }
}

#[test]
fn matrix_exponentials_are_accurate() {
    let row = Axis::new("row", 50);
    let mut bound = Bound::default();
    let mut rng = Rng(3);
    // Entries below 0.6 give norms up to about 2.
    let values = rng.array(&Shape::new(&[&row], (3, 3)), -0.65, 0.65).f().to_vec();
    let a = bound.data("a", &[&row], (3, 3), values.clone());
    let found = bound.run(&[expm(&a)]);
    for (a, found) in values.chunks(9).zip(found[0].chunks(9)) {
        assert!(worst(found, &taylor(a), 1.0) < 1e-13);
    }
    let h = bound.data("h", &[&row], 8, rng.array(&shape(&[&row], 8), -0.5, 0.5).f().to_vec());
    let both = matmul(&sl3_exp(&h), &sl3_exp(&-h));
    assert!(bound.run(&[(both - identity(3)).abs().max_channels()])[0].iter().all(|e| *e < 1e-13));
}

/// The exponential's series, summed until nothing changes.
fn taylor(a: &[f64]) -> Vec<f64> {
    let mut sum: Vec<f64> = (0..9).map(|i| (i % 4 == 0) as usize as f64).collect();
    let mut term = sum.clone();
    for k in 1..60 {
        term = (0..9).map(|i| (0..3).map(|m| term[i / 3 * 3 + m] * a[m * 3 + i % 3]).sum::<f64>() / k as f64).collect();
        sum.iter_mut().zip(&term).for_each(|(s, t)| *s += t);
    }
    sum
}

#[test]
fn poses_compose_with_their_inverse_to_the_identity() {
    let row = Axis::new("row", 20);
    let mut bound = Bound::default();
    let twist = bound.data("twist", &[&row], 6, Rng(5).array(&shape(&[&row], 6), -2.0, 2.0).f().to_vec());
    let pose = se3_exp(&twist);
    let both = compose_poses(&pose, &invert_pose(&pose));
    let gap = both - Tensor::constant_matrix(3, 4, &[1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0.]);
    assert!(bound.run(&[gap.abs().max_channels()])[0].iter().all(|e| *e < 1e-12));
}

#[test]
fn fits_recover_exact_motions() {
    let (frame, point) = (Axis::new("frame", 6), Axis::new("point", 9));
    let over = Axes::new([point.clone()]);
    let mut bound = Bound::default();
    let mut rng = Rng(7);
    let mut data = |name: &str, axes: &[&Axis], n: usize, range: f64| {
        let values = rng.array(&shape(axes, n), -range, range).f().to_vec();
        bound.data(name, axes, n, values)
    };
    let (x2, x3) = (data("x2", &[&point], 2, 1.0), data("x3", &[&frame, &point], 3, 1.0));
    let (m2, m3, h) = (data("m2", &[&frame], 3, 2.0), data("m3", &[&frame], 6, 1.5), data("h", &[&frame], 8, 0.3));
    let (rigid2, rigid3, homography) = (se2_exp(&m2), se3_exp(&m3), sl3_exp(&h));
    use raygrad_compiler::functions::matrix::apply_affine;
    let projected = apply_homography(&homography, &x2);
    let unit = &homography / homography.ch(8);
    let gaps = [
        fit_rigid_2d(&x2, &apply_affine(&rigid2, &x2), &over) - rigid2,
        fit_rigid_3d(&[(&x3, &apply_affine(&rigid3, &x3))], &over) - rigid3,
        fit_homography(&x2, &projected, &over, Solver::Eigen, None) - &unit,
        fit_homography(&x2, &projected, &over, Solver::InverseIteration, None) - &unit,
    ];
    for (i, gap) in bound.run(&gaps.map(|g| g.abs().max_channels())).iter().enumerate() {
        // The projection's 1e-8 bounds the last two.
        let bound = if i < 2 { 1e-12 } else { 1e-6 };
        assert!(gap.iter().all(|e| *e < bound), "fit {i}: {gap:?}");
    }
}

#[test]
fn degenerate_homographies_are_left_out() {
    let (frame, point) = (Axis::new("frame", 3), Axis::new("point", 9));
    let over = Axes::new([point.clone()]);
    let mut bound = Bound::default();
    let mut rng = Rng(9);
    let mut values = rng.array(&shape(&[&frame, &point], 2), -1.0, 1.0).f().to_vec();
    // Frame 1: both sets are one point repeated.
    values[18..36].fill(0.25);
    let x = Tensor::parameter("x", shape(&[&frame, &point], 2));
    bound.fill(&x, &values);
    let moved = bound.data("moved", &[&frame, &point], 2, rng.array(x.shape(), -0.1, 0.1).f().to_vec());
    let index = Tensor::index(&frame);
    let degenerate = index.less_than(&Tensor::integers(&[2]));
    let y = degenerate.select(&x, &(&x + moved));
    for solver in [Solver::Eigen, Solver::InverseIteration] {
        let h = fit_homography(&x, &y, &over, solver, Some(&degenerate));
        let slope = grad(&total(&h), &[&x]).remove(0);
        let found = bound.run(&[h, slope]);
        let eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(found[0][..18], [eye, eye].concat());
        assert_eq!(found[1][..36], [0.0; 36]);
        assert!(found.iter().flatten().all(|x| x.is_finite()));
        assert!(found[1][36..].iter().any(|x| x.abs() > 0.1));
    }
}

#[test]
fn encoding_and_weights_of_the_published_definition() {
    let mut bound = Bound::default();
    let x = bound.data("x", &[], 2, vec![0.3, -0.2]);
    let expected = [
        0.3, -0.2, 0.809017, 0.951057, -0.587785, 0.587785, -0.309017, -0.809017, -0.587785, -0.951057, -0.587785,
        0.809017, 0.309017, -0.809017,
    ];
    let progress = bound.data("progress", &[], 1, vec![0.33]);
    let encoding = positional_encoding(&x, 3, None);
    let found = bound.run(&[
        encoding,
        coarse_to_fine_weights(&progress, 10, 0.1, 0.5),
        coarse_to_fine_weights(&progress, 4, 0.1, 0.5),
        positional_encoding(&x, 0, None),
    ]);
    assert!(worst(&found[0], &expected, 1.0) < 1e-6);
    assert!(worst(&found[1], &[1.0, 1.0, 1.0, 1.0, 1.0, 0.853553, 0.0, 0.0, 0.0, 0.0], 1.0) < 1e-6);
    assert!(worst(&found[2], &[1.0, 1.0, 0.206107, 0.0], 1.0) < 1e-6);
    assert_eq!(found[3], [0.3, -0.2]);
}

#[test]
fn the_fitted_example_of_the_homography() {
    let h = [1.047312, 0.100795, 0.048645, 0.028987, 1.022646, -0.018907, 0.197083, -0.088276, 0.947519];
    let mut bound = Bound::default();
    let v = bound.data("v", &[], 8, vec![0.05, -0.02, 0.1, 0.03, 0.04, -0.06, 0.2, -0.1]);
    let found = sl3_exp(&v);
    assert!(worst(&bound.run(std::slice::from_ref(&found))[0], &h, 1.0) < 1e-6);
    let point = Axis::new("point", 6);
    let x = vec![-0.3, -0.3, -0.3, 0.3, 0.3, 0.3, 0.3, -0.3, 0.0, 0.0, 0.1, -0.2];
    let x = bound.data("x", &[&point], 2, x);
    let noise = bound.data("noise", &[&point], 2, [[0.0; 8].as_slice(), &[0.01, 0.0, 0.0, -0.02]].concat());
    let y = apply_homography(&found, &x) + noise;
    let over = Axes::new([point.clone()]);
    let svd = [1.105337, 0.107042, 0.053439, 0.026451, 1.088167, -0.023789, 0.214234, -0.102994, 1.0];
    let lu = [1.105352, 0.107393, 0.053609, 0.026702, 1.088157, -0.023625, 0.215363, -0.101846, 1.0];
    for (solver, expected) in [(Solver::Eigen, svd), (Solver::InverseIteration, lu)] {
        let found = bound.run(&[fit_homography(&x, &y, &over, solver, None)]);
        assert!(worst(&found[0], &expected, 1.0) < 1e-6, "{solver:?}: {found:?}");
    }
}

#[test]
fn lookups_interpolate_and_are_zero_outside() {
    let mut bound = Bound::default();
    let (texel, point) = (Axis::new("texel", 6), Axis::new("point", 6));
    let pixels = Tensor::parameter("pixels", shape(&[&texel], 1));
    bound.fill(&pixels, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    let at = vec![0.0, 0.0, 2.0, 1.0, 0.5, 0.5, -0.5, 0.0, 2.25, 1.5, -9.0, 40.0];
    let at = bound.data("at", &[&point], 2, at);
    let table = ImageTable { pixels, texel, width: 3, height: 2 };
    let y = table.bilinear(&at);
    let slopes = grad(&total(&y), &[&table.pixels]);
    let found = bound.run(&[y, slopes[0].clone()]);
    assert_eq!(found[0], [1.0, 6.0, 3.0, 0.5, 6.0 * 0.75 * 0.5, 0.0]);
    assert_eq!(found[1], [1.0 + 0.25 + 0.5, 0.25, 0.0, 0.25, 0.25, 1.0 + 0.375]);
    let image = Axis::new("image", 12);
    let smooth = Tensor::parameter("smooth", shape(&[&image], 2));
    let table = ImageTable { pixels: smooth.clone(), texel: image, width: 4, height: 3 };
    let whole = Tensor::constant(&[1.0, 0.0]);
    derivatives("bilinear", &[(shape(&[&point], 2), 0.1, 0.9), (smooth.shape().clone(), -1.0, 1.0)], |x| {
        ImageTable { pixels: x[1].clone(), ..table.clone() }.bilinear(&(&x[0] + &whole))
    });
    let corner = bound.data("corner", &[], 2, vec![(0.5 / 3.0 * 2.0 - 1.0), (0.5 / 2.0 * 2.0 - 1.0) * 2.0 / 3.0]);
    assert!(bound.run(&[isotropic_to_pixels(&corner, 3, 2)])[0].iter().all(|x| x.abs() < 1e-15));
}

#[test]
fn networks_name_and_initialise_their_parameters() {
    let mlp = Mlp::new(MlpSpec::new("warp", &[130, 256, 256, 256, 256, 256, 256, 6]).skip(&[4]));
    let names: Vec<&str> = mlp.parameters.iter().filter_map(|p| p.tensor.input_name()).collect();
    assert_eq!(names[..3], ["warp.0.weight", "warp.0.bias", "warp.1.weight"]);
    assert_eq!(mlp.parameters[8].tensor.shape().to_string(), "[] x (386, 256)");
    assert_eq!(mlp.parameters[9].init, Init::Uniform(1.0 / 386f64.sqrt()));
    let count: usize = mlp.parameters.iter().map(|p| p.tensor.shape().lanes()).sum();
    assert_eq!(count, 397_318);
    let image = Mlp::new(MlpSpec::new("image", &[34, 256, 3])).scale_first_layer(17f64.sqrt());
    let bound = 17f64.sqrt() / 34f64.sqrt();
    assert!(image.parameters[..2].iter().all(|p| p.init == Init::Uniform(bound)));
    assert_eq!(image.parameters[2].init, Init::Uniform(1.0 / 16.0));
    let wrong = mlp.apply(&Tensor::constant(&[0.0; 34]));
    let text = wrong.error().expect("does not fit").to_string();
    assert!(text.starts_with("mlp: 34 input channels") && text.contains("hint: 130 channels"), "{text}");
}

#[test]
fn adam_steps_by_its_formula() {
    let adam = Adam::default();
    let x = Tensor::parameter("x", shape(&[], 2));
    let g = Tensor::data("g", shape(&[], 2));
    let old = Moments::of(&x);
    let scalar = |name: &str| Tensor::per_step(name, shape(&[], 1));
    let step = StepScalars { lr: scalar("lr"), bias1: scalar("bias1"), bias2: scalar("bias2") };
    let (new, moments) = adam.update(&x, &g, &old, &step);
    let mut bound = Bound::default();
    let mut state = [vec![1.0, -2.0], vec![0.0, 0.0], vec![0.0, 0.0]];
    let (mut p, mut m, mut v) = ([1.0, -2.0], [0.0; 2], [0.0; 2]);
    for t in 1..4 {
        let slope = [0.3 * t as f64, -1e-9];
        for i in 0..2 {
            m[i] = 0.9 * m[i] + 0.1 * slope[i];
            v[i] = 0.999 * v[i] + 0.001 * slope[i] * slope[i];
            let (m1, v1) = (m[i] / (1.0 - 0.9f64.powi(t)), v[i] / (1.0 - 0.999f64.powi(t)));
            p[i] -= 0.01 * m1 / (v1.sqrt() + 1e-8);
        }
        for (name, value) in [("x", &state[0]), ("adam.m.x", &state[1]), ("adam.v.x", &state[2])] {
            bound.bindings.insert(name.into(), Array::floats(&shape(&[], 2), value.clone()));
        }
        let (bias1, bias2) = adam.bias_corrections(t as u64);
        for (name, value) in [("lr", 0.01), ("bias1", bias1), ("bias2", bias2)] {
            bound.bindings.insert(name.into(), Array::floats(&shape(&[], 1), vec![value]));
        }
        bound.bindings.insert("g".into(), Array::floats(&shape(&[], 2), slope.to_vec()));
        let found = bound.run(&[new.clone(), moments.m.clone(), moments.v.clone()]);
        assert!(worst(&found[0], &p, 1.0) < 1e-14);
        state = [found[0].clone(), found[1].clone(), found[2].clone()];
    }
    assert!((p[1] + 2.0).abs() > 1e-4, "a tiny gradient still moves its parameter");
}

#[test]
fn misfits_of_functions_name_the_call() {
    let x = Tensor::data("x", shape(&[], 4));
    let over = Axes::none();
    let cases = [
        (so3_exp(&x), "so3_exp: rotation vectors have 4 channels, not 3", line!()),
        (se3_exp(&x), "se3_exp: twists have 4 channels, not 6", line!()),
        (sl3_exp(&x), "sl3_exp: homography vectors have 4 channels, not 8", line!()),
        (apply(&x, &x), "apply: channels 4 do not apply to 4 channels", line!()),
        (fit_rigid_3d(&[(&x, &x)], &over), "fit_rigid_3d: points have 4 channels, not 3", line!()),
        (fit_rigid_3d(&[], &over), "fit_rigid_3d: no points", line!()),
        (fit_homography(&x, &x, &over, Solver::Eigen, None), "fit_homography: points have 4 channels, not 2", line!()),
        (coarse_to_fine_weights(&x, 4, 0.5, 0.5), "coarse_to_fine_weights: 4 bands opening from 0.5 to 0.5", line!()),
        (invert_pose(&x), "invert_pose: channels 4 are no pose", line!()),
    ];
    for (t, problem, line) in cases {
        let text = t.error().expect("does not fit").to_string();
        assert!(text.starts_with(&format!("{problem} at {}:{line}\n", file!())), "{text}");
        assert!(text.contains("\n  hint: "), "{text}");
    }
}

/// Near its end an alignment leaves little between a map and its homography: gradients through the fit must keep their digits
/// where the smallest eigenvalue is below what single precision holds.
#[test]
fn gradients_through_nearly_exact_homographies() {
    let (frame, point) = (Axis::new("frame", 5), Axis::new("point", 400));
    let over = Axes::new([point.clone()]);
    let (x, y) = (Tensor::data("x", shape(&[&point], 2)), Tensor::parameter("y", shape(&[&frame, &point], 2)));
    let h = fit_homography(&x, &y, &over, Solver::InverseIteration, None);
    let apart = &y - apply_homography(&h, &x);
    let loss = (&apart * &apart).mean_all();
    let step = Step { outputs: vec![("gradient".into(), grad(&loss, &[&y]).remove(0))], updates: vec![] };
    for noise in [1e-2, 1e-3, 3e-4, 1e-4] {
        let (mut points, mut images) = (vec![], vec![]);
        for i in 0..400 {
            points.extend([f64::from(i % 20) / 20.0 - 0.5, f64::from(i / 20) / 20.0 - 0.5]);
        }
        for k in 0..5 {
            let k = f64::from(k);
            for p in points.chunks(2) {
                let [u, v] = [p[0], p[1]];
                let w = 1.0 + 0.05 * k * u - 0.05 * v;
                let moved = [((1.1 + 0.05 * k) * u + 0.1 * v + 0.2) / w, (0.9 * v - 0.05 * k * u + 0.1) / w];
                images.push(moved[0] + noise * (5.0 * u + k).sin() * (3.0 * v - 2.0 * k).cos());
                images.push(moved[1] + noise * (4.0 * v + k).sin());
            }
        }
        let mut bound = Bound::default();
        bound.bindings.insert("x".into(), Array::floats(x.shape(), points));
        bound.bindings.insert("y".into(), Array::floats(y.shape(), images));
        let bindings = round(&bound.bindings);
        let expected = reference(&step, &bindings).remove(0);
        for device in devices() {
            let found = run(&device, &step, &bindings).remove(0);
            for (k, (found, expected)) in found.chunks(800).zip(expected.chunks(800)).enumerate() {
                let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
                let off =
                    norm(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / norm(&mut expected.iter().copied());
                // Coordinates of size 1 have 6e-8 to go by: of a distance of 1e-4 that is a thousandth, of its gradient more.
                let allowed = 1e-4 / noise;
                assert!(off < allowed.clamp(0.03, 0.2), "{}: noise {noise}, frame {k}: off by {off}", device.name());
            }
        }
    }
}

/// Inputs of one name are one input, also to gradients.
#[test]
fn gradients_of_what_was_recorded_twice() {
    let w = || Tensor::parameter("w", shape(&[], 1));
    let (one, two) = (w(), w());
    let mut bound = Bound::default();
    bound.bindings.insert("w".into(), Array::floats(one.shape(), vec![3.0]));
    let product = &one * &two;
    for wanted in [&one, &two, &w()] {
        assert_eq!(bound.run(&grad(&product, &[wanted])), [[6.0]]);
    }
    // Any node may be wanted, a constant divisor too.
    let two = Tensor::scalar(2.0);
    assert_eq!(bound.run(&grad(&(&one / &two), &[&two])), [[-0.75]]);
    // And the weights of the bands of an encoding, if somebody trains them.
    let bands = Tensor::parameter("bands", shape(&[], 2));
    bound.bindings.insert("bands".into(), Array::floats(bands.shape(), vec![0.3, 0.7]));
    let encoded = total(&positional_encoding(&one, 2, Some(&bands)));
    check_gradient(&encoded, &[one, bands], &bound.bindings, 1e-7, "weights of bands");
}
