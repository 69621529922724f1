//! Small algebra: vectors, inverses, parts of axes, losses. Identities they obey, derivatives to second order, every device.

use raygrad_compiler::Step;
use raygrad_compiler::functions::along::{concat_along, slice_along};
use raygrad_compiler::functions::inverse::{determinant, inverse, solve};
use raygrad_compiler::functions::loss::{charbonnier, mean_absolute_error, mean_squared_error};
use raygrad_compiler::functions::matrix::{apply, identity, matmul, solve_symmetric};
use raygrad_compiler::functions::vector::{dot, norm, normalize};
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_tests::backend::{devices, reference, round, run};
use raygrad_tests::vectors::Bound;
use raygrad_tests::{Rng, check_gradient, derivatives, total, worst};

/// Outputs in the reference; every device agrees with it to `tolerance` of an output's largest value.
fn everywhere(outputs: &[Tensor], bindings: &Bindings, tolerance: f64) -> Vec<Vec<f64>> {
    let named = outputs.iter().enumerate().map(|(i, t)| (format!("y{i}"), t.clone())).collect();
    let step = Step { outputs: named, updates: vec![] };
    let expected = reference(&step, &round(bindings));
    for device in devices() {
        for (i, (found, expected)) in run(&device, &step, &round(bindings)).iter().zip(&expected).enumerate() {
            let error = worst(found, expected, 1e-30);
            assert!(error <= tolerance, "{}: y{i} is off by {error:.1e}\n{found:?}\n{expected:?}", device.name());
        }
    }
    expected
}

fn bind(name: &str, shape: Shape, values: Vec<f64>) -> (Tensor, Bindings) {
    (Tensor::data(name, shape.clone()), Bindings::from([(name.to_string(), Array::floats(&shape, values))]))
}

#[test]
fn derivatives_to_second_order() {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 3));
    let vector = |n| (Shape::new(&[&frame, &row], n), -1.0, 1.0);
    derivatives("dot", &[vector(3), vector(3)], |x| dot(&x[0], &x[1]));
    derivatives("norm", &[vector(4)], |x| norm(&x[0]));
    derivatives("normalize", &[vector(3)], |x| normalize(&x[0]));
    for n in 1..=4 {
        let matrix = (Shape::new(&[&frame], (n, n)), -0.3, 0.3);
        let away = |m: &Tensor| m + identity(n) * 1.5;
        derivatives(&format!("determinant of {n}"), std::slice::from_ref(&matrix), |x| determinant(&away(&x[0])));
        derivatives(&format!("inverse of {n}"), std::slice::from_ref(&matrix), |x| inverse(&away(&x[0])));
        derivatives(&format!("solve of {n}"), &[matrix, (Shape::new(&[&row], n), -1.0, 1.0)], |x| {
            solve(&away(&x[0]), &x[1])
        });
    }
    let (part, both) = (Axis::new("part", 2), Axis::new("both", 5));
    derivatives("slice_along", &[vector(2)], |x| slice_along(&x[0], &row, 1, &part));
    derivatives("concat_along", &[vector(2), (Shape::new(&[&part], 2), -1.0, 1.0)], |x| {
        concat_along(&[(&x[0], &row), (&x[1], &part)], &both)
    });
    derivatives("mean_squared_error", &[vector(3), vector(3)], |x| mean_squared_error(&x[0], &x[1]));
    derivatives("charbonnier", &[vector(3), vector(3)], |x| charbonnier(&x[0], &x[1], 0.5));
    // Differences of one sign: no kink between the points of a central difference.
    derivatives("mean_absolute_error", &[vector(3), (vector(3).0, 1.5, 2.0)], |x| mean_absolute_error(&x[0], &x[1]));
}

#[test]
fn inverses_undo_matrices_of_any_scale() {
    let row = Axis::new("row", 40);
    for n in 1..=4 {
        for scale in [1e-15, 1.0, 1e15] {
            let values = Rng(n as u64).array(&Shape::new(&[&row], (n, n)), -scale, scale).f().to_vec();
            let (a, mut bindings) = bind("a", Shape::new(&[&row], (n, n)), values);
            let (b, more) =
                bind("b", Shape::new(&[&row], n), Rng(9).array(&Shape::new(&[&row], n), -1.0, 1.0).f().to_vec());
            bindings.extend(more);
            let (both, again) = (matmul(&inverse(&a), &a), apply(&a, &solve(&a, &b)) - &b);
            let found = everywhere(&[both - identity(n) + 1.0, again + 1.0], &bindings, 2e-3);
            assert!(found.iter().flatten().all(|x| (x - 1.0).abs() < 1e-9), "n = {n}, scale {scale}");
        }
    }
}

#[test]
fn singular_matrices_have_no_finite_inverse() {
    let row = Axis::new("row", 2);
    let (a, bindings) = bind("a", Shape::new(&[&row], (2, 2)), vec![1.0, 2.0, 2.0, 4.0, 0.0, 0.0, 0.0, 0.0]);
    let step = Step { outputs: vec![("y".into(), inverse(&a)), ("d".into(), determinant(&a))], updates: vec![] };
    for device in devices() {
        let found = run(&device, &step, &bindings);
        assert!(found[0].iter().all(|x| !x.is_finite()), "{}: {:?}", device.name(), found[0]);
        assert_eq!(found[1], [0.0, 0.0], "{}", device.name());
    }
}

#[test]
fn parts_of_axes_join_to_the_whole() {
    let (frame, row) = (Axis::new("frame", 2), Axis::new("row", 7));
    let values: Vec<f64> = (0..28).map(f64::from).collect();
    let (x, bindings) = bind("x", Shape::new(&[&frame, &row], 2), values.clone());
    let (a, b, c, whole) = (Axis::new("a", 3), Axis::new("b", 1), Axis::new("c", 3), Axis::new("whole", 7));
    let parts = [slice_along(&x, &row, 0, &a), slice_along(&x, &row, 3, &b), slice_along(&x, &row, 4, &c)];
    let joined = concat_along(&[(&parts[0], &a), (&parts[1], &b), (&parts[2], &c)], &whole);
    let turned = concat_along(&[(&parts[2], &c), (&parts[0], &a)], &Axis::new("turned", 6));
    let found = everywhere(&[joined, turned], &bindings, 0.0);
    assert_eq!(found[0], values);
    assert_eq!(found[1][..12], [8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
}

#[test]
fn positions_of_extremes_are_the_first_of_equal_ones() {
    let row = Axis::new("row", 4);
    let values = vec![1.0, 3.0, 3.0, -2.0, -2.0, 5.0, f64::NAN, 1.0, 2.0, 2.0, f64::NAN, 1.0];
    let (x, bindings) = bind("x", Shape::new(&[&row], 3), values);
    let (most, least) = (x.argmax_channels().to_f32(), x.argmin_channels().to_f32());
    let found = everywhere(&[most, least], &bindings, 0.0);
    assert_eq!(found, [[1.0, 2.0, 2.0, 0.0], [0.0, 0.0, 1.0, 2.0]]);
    let (most, least) = (x.argmax_over(&row).to_f32(), x.argmin_over(&row).to_f32());
    assert_eq!(everywhere(&[most, least], &bindings, 0.0), [[3.0, 0.0, 1.0], [1.0, 1.0, 3.0]]);
    let (row, column) = (Axis::new("row", 3), Axis::new("column", 4));
    let (none, less) = (f64::NAN, f64::NEG_INFINITY);
    let values = vec![0.5, 2.0, 2.0, 1.0, none, none, none, none, less, none, -1.0, -1.0];
    let (x, bindings) = bind("x", Shape::new(&[&row, &column], 1), values);
    let shares = x.argmax_over(&column).equal(&Tensor::index(&column)).to_f32();
    let found = everywhere(&[x.argmax_over(&column).to_f32(), shares.sum(&[&column])], &bindings, 0.0);
    assert_eq!(found, [[1.0, 0.0, 2.0], [1.0, 1.0, 1.0]]);
}

#[test]
fn whole_powers_take_any_base() {
    let row = Axis::new("row", 4);
    let (x, bindings) = bind("x", Shape::new(&[&row], 1), vec![-2.0, 0.0, 0.5, 3.0]);
    let y = [
        x.powi(0),
        x.powi(1),
        x.powi(3),
        x.powi(8),
        (&x + 5.0).powi(-2),
        x.powf(0.0),
        x.max(&Tensor::scalar(0.0)).powf(1.5),
    ];
    let found = everywhere(&y, &bindings, 2e-6);
    assert_eq!(found[0], [1.0; 4]);
    assert_eq!(found[1], [-2.0, 0.0, 0.5, 3.0]);
    assert_eq!(found[2], [-8.0, 0.0, 0.125, 27.0]);
    assert_eq!(found[3], [256.0, 0.0, 1.0 / 256.0, 6561.0]);
    assert_eq!(found[4][..2], [1.0 / 9.0, 1.0 / 25.0]);
    assert_eq!(found[5], [1.0; 4]);
    assert!((found[6][3] - 27f64.sqrt()).abs() < 1e-12 && found[6][1] == 0.0);
}

#[test]
fn the_gradient_of_a_solution_does_not_mind_equal_eigenvalues() {
    let mut bound = Bound::default();
    let g = Tensor::parameter("g", Shape::new(&[], (3, 3)));
    bound.fill(&g, &[2.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0]);
    let h = solve_symmetric(&g, &Tensor::constant(&[1.0, 2.0, -1.0]));
    let loss = total(&(&h * Tensor::constant(&[0.3, -1.0, 0.5])));
    check_gradient(&loss, &[g], &bound.bindings, 1e-8, "solve_symmetric");
}

#[test]
fn systems_that_are_not_positive() {
    let mut bound = Bound::default();
    let g = Tensor::parameter("g", Shape::new(&[], (3, 3)));
    bound.fill(&g, &[0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -4.0]);
    let h = solve_symmetric(&g, &Tensor::constant(&[3.0, 5.0, 2.0]));
    assert!(worst(&bound.run(std::slice::from_ref(&h))[0], &[5.0, 3.0, -0.5], 1.0) < 1e-9);
    let loss = total(&(&h * Tensor::constant(&[0.3, -1.0, 0.5])));
    check_gradient(&loss, &[g], &bound.bindings, 1e-7, "solve_symmetric");
}
