//! Normalised device coordinates of rays, against projections of points on the host.

use raygrad::radiance::rays::Rays;
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::Array;
use raygrad_tests::vectors::{Bound, cases, numbers};
use raygrad_tests::{Rng, check_gradient, check_second_order, total, worst};

const RAYS: usize = 7;
const LENS: [f64; 4] = [10.0, 12.0, 4.0, 3.0];

/// Rays that leave from before the near plane and look along +z, and their values.
fn rays(bound: &mut Bound) -> (Axis, Rays, [Vec<f64>; 2]) {
    let ray = Axis::new("ray", RAYS);
    let mut rng = Rng(11);
    let mut draw = |low: [f64; 3], high: [f64; 3]| -> Vec<f64> {
        (0..RAYS * 3).map(|i| rng.uniform(low[i % 3], high[i % 3])).collect()
    };
    let values = [draw([-0.4, -0.4, -0.5], [0.4, 0.4, 0.5]), draw([-0.5, -0.5, 0.8], [0.5, 0.5, 1.2])];
    let mut parameter = |name: &str, values: &[f64]| {
        let shape = Shape::new(&[&ray], 3);
        bound.bindings.insert(name.into(), Array::floats(&shape, values.to_vec()));
        Tensor::parameter(name, shape)
    };
    let rays = Rays { origin: parameter("origin", &values[0]), direction: parameter("direction", &values[1]) };
    (ray, rays, values)
}

/// Where a point of the world lies in the cube.
fn projected(p: [f64; 3]) -> [f64; 3] {
    let [fx, fy, cx, cy] = LENS;
    [fx / cx * p[0] / p[2], fy / cy * p[1] / p[2], 1.0 - 2.0 / p[2]]
}

#[test]
fn points_along_a_ray_stay_on_it() {
    let mut bound = Bound::default();
    let (ray, rays, [origin, direction]) = rays(&mut bound);
    let ndc = rays.to_ndc(&Tensor::constant(&LENS));
    // Of depth in the world, and of that in the cube.
    let depths: Vec<f64> = (0..RAYS).map(|i| 1.5 + i as f64).collect();
    let points: Vec<[f64; 3]> =
        (0..RAYS).map(|i| std::array::from_fn(|c| origin[3 * i + c] + depths[i] * direction[3 * i + c])).collect();
    let within: Vec<f64> = points.iter().map(|p| 1.0 - 1.0 / p[2]).collect();
    let depth = bound.data("depth", &[&ray], 1, within);
    let found = bound.run(&[ndc.at(&depth), ndc.at(&Tensor::scalar(0.0)), rays.depth_of_ndc(&depth)]);
    let expected: Vec<f64> = points.iter().flat_map(|p| projected(*p)).collect();
    assert!(worst(&found[0], &expected, 1.0) < 1e-12);
    assert!(found[1].chunks(3).all(|p| p[2] == -1.0), "the near plane is at -1");
    assert!(worst(&found[2], &depths, 1.0) < 1e-12);
    // The far end is infinity: as far as a depth can be told.
    let far = bound.run(&[rays.depth_of_ndc(&Tensor::scalar(1.0))]).remove(0);
    assert!(far.iter().all(|d| d.is_finite() && *d > 1e5));
}

#[test]
fn derivatives() {
    let mut bound = Bound::default();
    let (_, rays, _) = rays(&mut bound);
    let ndc = rays.to_ndc(&Tensor::constant(&LENS));
    let back = rays.depth_of_ndc(&Tensor::scalar(0.6));
    let loss = total(&(&ndc.origin * &ndc.direction)) + total(&ndc.direction.sin()) + total(&back.sin());
    let parameters = [rays.origin, rays.direction];
    check_gradient(&loss, &parameters, &bound.bindings, 1e-7, "ndc");
    check_second_order(&loss, &parameters, &bound.bindings, 1e-6, "ndc");
}

#[test]
fn rays_of_the_official_code() {
    for case in cases("rays").iter().filter(|c| c.function.starts_with("convert_NDC")) {
        let mut bound = Bound::default();
        let size = case.sizes("center");
        let (view, ray) = (Axis::new("view", size[0]), Axis::new("ray", size[1]));
        let lens = numbers(case.input("intr")).chunks(9).flat_map(|k| [k[0], k[4], k[2], k[5]]).collect();
        let lens = bound.data("lens", &[&view], 4, lens);
        let origin = bound.data("center", &[&view, &ray], 3, case.numbers("center"));
        let direction = bound.data("ray", &[&view, &ray], 3, case.numbers("ray"));
        let ndc = Rays { origin, direction }.to_ndc(&lens);
        let axes = ndc.direction.axes().clone();
        let found = bound.run(&[ndc.origin.broadcast_to(&axes), ndc.direction]);
        case.check("center_ndc", &found[0]);
        case.check("ray_ndc", &found[1]);
    }
}
