//! Volume rendering and depth samples.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::composite::{Spread, composite, depth_samples};
use raygrad_compiler::functions::hierarchical::fine_depths;
use raygrad_compiler::graph::{Axis, Tensor};
use raygrad_tests::vectors::{Bound, cases};

#[test]
fn compositing() {
    for case in cases("composite") {
        let mut bound = Bound::default();
        let size = case.sizes("rgb_samples");
        let (batch, ray, sample) =
            (Axis::new("batch", size[0]), Axis::new("ray", size[1]), Axis::new("sample", size[2]));
        let (rays, samples) = ([&batch, &ray], [&batch, &ray, &sample]);
        let direction = bound.data("ray", &rays, 3, case.numbers("ray"));
        let color = bound.data("rgb_samples", &samples, 3, case.numbers("rgb_samples"));
        let density = bound.data("density_samples", &samples, 1, case.numbers("density_samples"));
        let depth = bound.data("depth_samples", &samples, 1, case.numbers("depth_samples"));
        let length = (&direction * &direction).sum_channels().sqrt();
        let mut seen = composite(&color, &density, &depth, &length, &sample);
        if case.input("setbg_opaque").as_bool() == Some(true) {
            seen.color = seen.color + (1.0 - &seen.opacity) * case.number("bgcolor");
        }
        let mut scalar = Tensor::scalar(0.0);
        for (name, value, width) in [("rgb", &seen.color, 3), ("depth", &seen.depth, 1), ("opacity", &seen.opacity, 1)]
        {
            let upstream = bound.data(&format!("g_{name}"), &rays, width, case.numbers(&format!("g_{name}")));
            scalar = scalar + (value * upstream).sum_channels().sum(&[&batch, &ray]);
        }
        let slopes = grad(&scalar, &[&direction, &color, &density, &depth]);
        let mut wanted = vec![seen.color, seen.depth, seen.opacity, seen.weights, scalar];
        wanted.extend(slopes);
        let found = bound.run(&wanted);
        let names = ["rgb", "depth", "opacity", "prob", "scalar"];
        let slopes = ["grad_ray", "grad_rgb_samples", "grad_density_samples", "grad_depth_samples"];
        for (name, values) in names.iter().chain(&slopes).zip(&found) {
            case.check(name, values);
        }
    }
}

/// Depths of all samples, given their jitter, and depths drawn from the weights of a first pass.
#[test]
fn depths() {
    for case in cases("sampling") {
        let mut bound = Bound::default();
        let [near, far] = [0, 1].map(|i| Tensor::scalar(case.numbers("range")[i]));
        let from_weights = case.function == "sample_depth_from_pdf";
        let drawn = case.sizes(if from_weights { "prob" } else { "jitter" });
        let [batch, ray] = [("batch", 0), ("ray", 1)].map(|(name, i)| Axis::new(name, drawn.get(i).map_or(1, |n| *n)));
        let sample = Axis::new("sample", case.count("S"));
        let axes = [&batch, &ray, &sample];
        let depth = if from_weights {
            let weights = bound.data("prob", &axes, 1, case.numbers("prob"));
            fine_depths(&weights, &sample, &Axis::new("fine", case.count("S_fine")), &near, &far, Spread::Metric)
        } else {
            let jitter = match case.input("jitter").is_null() {
                true => Tensor::scalar(0.5),
                false => bound.data("jitter", &axes, 1, case.numbers("jitter")),
            };
            let spread = if case.text("param") == "inverse" { Spread::Inverse } else { Spread::Metric };
            depth_samples(&sample, &jitter, &near, &far, spread)
        };
        case.check("depth", &bound.run(&[depth])[0]);
    }
}

/// The checks of the specification: first, middle and last depth.
#[test]
fn depths_without_jitter() {
    let sample = Axis::new("sample", 128);
    let depths = |near, far, spread| {
        let (near, far) = (Tensor::scalar(near), Tensor::scalar(far));
        Bound::default().run(&[depth_samples(&sample, &Tensor::scalar(0.5), &near, &far, spread)]).remove(0)
    };
    let close = |found: f64, expected: f64| assert!((found - expected).abs() < 1e-5, "{found} instead of {expected}");
    let metric = depths(2.0, 6.0, Spread::Metric);
    close(metric[0], 2.015625);
    close(metric[127], 5.984375);
    let inverse = depths(1.0, 0.0, Spread::Inverse);
    close(inverse[0], 1.0039216);
    close(inverse[63], 1.9844961);
    close(inverse[127], 255.99934);
}
