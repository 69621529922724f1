//! Properties of single ops beyond their derivatives.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::random::{counter, normal, pcg3d, uniform};
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_tests::{Rng, total};

fn bind(values: &[(&str, Array)]) -> Bindings {
    values.iter().map(|(n, a)| (n.to_string(), a.clone())).collect()
}

fn value(t: &Tensor, b: &Bindings) -> Vec<f64> {
    evaluate(std::slice::from_ref(t), b).expect("evaluates")[0].f().to_vec()
}

#[test]
fn derivatives_at_kinks_are_zero_or_go_to_the_first() {
    let shape = Shape::new(&[], 2);
    let (a, b) = (Tensor::parameter("a", shape.clone()), Tensor::parameter("b", shape.clone()));
    let zeros = bind(&[("a", Array::zeros(&shape)), ("b", Array::zeros(&shape))]);
    for y in [a.relu(), a.abs(), a.sqrt()] {
        assert_eq!(value(&grad(&total(&y), &[&a])[0], &zeros), [0.0, 0.0], "{y:?}");
    }
    for y in [a.min(&b), a.max(&b)] {
        let g = grad(&total(&y), &[&a, &b]);
        assert_eq!((value(&g[0], &zeros), value(&g[1], &zeros)), (vec![1.0; 2], vec![0.0; 2]), "{y:?}");
    }
    let g = grad(&a.max_channels(), &[&a]);
    assert_eq!(value(&g[0], &zeros), [0.5, 0.5]);
}

#[test]
fn a_branch_not_taken_leaves_no_nan() {
    let shape = Shape::new(&[], 3);
    let x = Tensor::parameter("x", shape.clone());
    let b = bind(&[("x", Array::floats(&shape, vec![0.0, -1.0, 4.0]))]);
    let zero = Tensor::scalar(0.0);
    let positive = x.greater_than(&zero);
    let cases = [x.sqrt(), x.log(), 1.0 / &x, &x / &x, x.atan2(&(&x * 2.0))];
    for y in cases {
        let chosen = total(&positive.select(&y, &zero).slice(0..2));
        let first = grad(&chosen, &[&x]).remove(0);
        assert_eq!(value(&first, &b), [0.0; 3], "{y:?}");
        let second = grad(&total(&first), &[&x]).remove(0);
        assert_eq!(value(&second, &b), [0.0; 3], "{y:?}, second order");
    }
}

#[test]
fn softplus_is_linear_far_out_and_keeps_small_values() {
    let shape = Shape::new(&[], 4);
    let x = Tensor::parameter("x", shape.clone());
    let b = bind(&[("x", Array::floats(&shape, vec![-800.0, -30.0, 20.5, 800.0]))]);
    let y = value(&x.softplus(1.0), &b);
    assert_eq!([y[0], y[2], y[3]], [0.0, 20.5, 800.0]);
    assert!((y[1] / (-30f64).exp() - 1.0).abs() < 1e-12);
    let slope = value(&grad(&total(&x.softplus(1.0)), &[&x])[0], &b);
    assert_eq!([slope[2], slope[3]], [1.0, 1.0]);
    assert!(slope.iter().all(|s| s.is_finite()));
}

#[test]
fn eigenvectors_rebuild_the_matrix() {
    let frame = Axis::new("frame", 40);
    for n in 1..=9 {
        let shape = Shape::new(&[&frame], (n, n));
        let a = Tensor::data("a", shape.clone());
        let (values, vectors) = a.sym_eig();
        let diagonal: Vec<usize> = (0..n * n).map(|i| i % n).collect();
        use raygrad_compiler::functions::matrix::matmul;
        let rebuilt = matmul(&(&vectors * values.pick_as(&diagonal, (n, n))), &vectors.transpose());
        let gap = (rebuilt - (&a + a.transpose()) * 0.5).abs().max_channels();
        let ascending =
            if n > 1 { values.slice(0..n - 1).less_equal(&values.slice(1..n)).to_f32() } else { Tensor::scalar(1.0) };
        let b = bind(&[("a", Rng(n as u64).array(&shape, -1.0, 1.0))]);
        assert!(value(&gap, &b).iter().all(|e| *e < 1e-14 * n as f64), "n = {n}");
        assert!(value(&ascending, &b).iter().all(|x| *x == 1.0));
    }
}

#[test]
fn equal_eigenvalues_have_finite_gradients() {
    let shape = Shape::new(&[], (3, 3));
    let a = Tensor::parameter("a", shape.clone());
    let (values, vectors) = a.sym_eig();
    let loss = total(&(values * Tensor::constant(&[1.0, 2.0, 3.0]))) + total(&vectors);
    let g = grad(&loss, &[&a]).remove(0);
    for diagonal in [[0.0, 0.0, 0.0], [2.0, 2.0, 2.0], [1.0, 1.0, 3.0]] {
        let mut m = vec![0.0; 9];
        (0..3).for_each(|i| m[4 * i] = diagonal[i]);
        let found = value(&g, &bind(&[("a", Array::floats(&shape, m))]));
        assert!(found.iter().all(|x| x.is_finite() && x.abs() < 10.0), "{diagonal:?}: {found:?}");
    }
}

#[test]
fn random_numbers_are_replayable_and_distinct() {
    let (frame, row) = (Axis::new("frame", 30), Axis::new("row", 100));
    let axes = Axes::new([frame, row]);
    let lanes = evaluate(&[counter(&axes, 4)], &Bindings::new()).expect("evaluates");
    assert_eq!(lanes[0].u(), (0..12_000).collect::<Vec<u32>>());

    let step = |s: u32| Tensor::integers(&[s]);
    let at = |t: Tensor| value(&t, &Bindings::new());
    let u = at(uniform(&axes, 4, 1, &step(7)));
    assert_eq!(u, at(uniform(&axes, 4, 1, &step(7))));
    for other in [uniform(&axes, 4, 2, &step(7)), uniform(&axes, 4, 1, &step(8))] {
        let other = at(other);
        let product: f64 = u.iter().zip(&other).map(|(a, b)| (a - 0.5) * (b - 0.5)).sum::<f64>() / 12_000.0;
        assert!(product.abs() < 4.0 / 12.0 / 12_000f64.sqrt(), "streams and steps are independent");
    }
    moments(&u, 0.5, 1.0 / 12.0);
    assert!(u.iter().all(|x| (0.0..1.0).contains(x)));
    let neighbours: f64 = u.windows(2).map(|w| (w[0] - 0.5) * (w[1] - 0.5)).sum::<f64>() / 12_000.0;
    assert!(neighbours.abs() < 4.0 / 12.0 / 12_000f64.sqrt());
    for of in 0..8 {
        let z = at(normal(&axes, 4, 1 + of / 4, &step(of)));
        moments(&z, 0.0, 1.0);
        let fourth: f64 = z.iter().map(|x| x.powi(4)).sum::<f64>() / 12_000.0;
        assert!((fourth - 3.0).abs() < 0.4, "{fourth}");
        // A tenth of all numbers lies beyond each decile.
        let deciles = [-1.2816, -0.8416, -0.5244, -0.2533, 0.0, 0.2533, 0.5244, 0.8416, 1.2816];
        for (i, limit) in deciles.into_iter().enumerate() {
            let (below, p) = (z.iter().filter(|x| **x < limit).count() as f64, 0.1 * (i + 1) as f64);
            let deviation = (12_000.0 * p * (1.0 - p)).sqrt();
            assert!((below - 12_000.0 * p).abs() < 4.5 * deviation, "step {of}: {below} below {limit}");
        }
    }
}

fn moments(x: &[f64], mean: f64, variance: f64) {
    let n = x.len() as f64;
    let m = x.iter().sum::<f64>() / n;
    let v = x.iter().map(|x| (x - m).powi(2)).sum::<f64>() / n;
    assert!((m - mean).abs() < 4.0 * (variance / n).sqrt(), "mean {m}");
    assert!((v - variance).abs() < 0.05 * variance, "variance {v}");
}

#[test]
fn the_hash_is_the_published_one() {
    // Bits of the three-lane hash, computed apart from this program in exact integer arithmetic.
    assert_eq!(pcg3d(0, 0, 0), HASHES[0]);
    assert_eq!(pcg3d(1, 2, 3), HASHES[1]);
    assert_eq!(pcg3d(0xFFFF_FFFF, 0x8000_0000, 12_345), HASHES[2]);
}

const HASHES: [u32; 3] = [2611992518, 4204755366, 2925550283];
