//! Fine depths and merged lists of depths, against a search and a sort on the host.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::composite::Spread;
use raygrad_compiler::functions::hierarchical::{fine_depths, merge_depths};
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::{Array, evaluate};
use raygrad_compiler::{Step, Target, compile};
use raygrad_tests::backend::devices;
use raygrad_tests::check::check;
use raygrad_tests::vectors::Bound;
use raygrad_tests::{Rng, seed, total, worst};

const RAYS: usize = 5;

/// Weights and depths of some rays, and what comes of them.
struct Rays {
    bound: Bound,
    /// `[ray][sample]`.
    weights: Vec<Vec<f64>>,
    depths: Vec<Vec<f64>>,
    range: [f64; 2],
    spread: Spread,
    inputs: [Tensor; 2],
    fine: Tensor,
    merged: Tensor,
}

impl Rays {
    /// The first ray has no weight at all, the second is opaque in one bin, the others are not opaque.
    fn new(samples: usize, more: usize, spread: Spread) -> Rays {
        let mut rng = Rng(seed("rays"));
        let weights: Vec<Vec<f64>> = (0..RAYS)
            .map(|ray| {
                let one = |i: usize| match ray {
                    0 => 0.0,
                    1 => f64::from(i == samples / 2),
                    _ => rng.uniform(0.1, 1.5) / samples as f64,
                };
                (0..samples).map(one).collect()
            })
            .collect();
        let range = if spread == Spread::Metric { [2.0, 6.0] } else { [1.0, 0.0] };
        let depths: Vec<Vec<f64>> = (0..RAYS)
            .map(|_| {
                (0..samples).map(|i| at(range, spread, (i as f64 + rng.uniform(0.0, 1.0)) / samples as f64)).collect()
            })
            .collect();
        let (ray, sample) = (Axis::new("ray", RAYS), Axis::new("sample", samples));
        let (fine_axis, merged_axis) = (Axis::new("fine", more), Axis::new("merged", samples + more));
        let mut bound = Bound::default();
        let mut parameter = |name: &str, values: &[Vec<f64>]| {
            let shape = Shape::new(&[&ray, &sample], 1);
            bound.bindings.insert(name.into(), Array::floats(&shape, values.concat()));
            Tensor::parameter(name, shape)
        };
        let inputs = [parameter("weights", &weights), parameter("depths", &depths)];
        let [near, far] = range.map(Tensor::scalar);
        let fine = fine_depths(&inputs[0], &sample, &fine_axis, &near, &far, spread);
        let merged = merge_depths(&inputs[1], &sample, &fine, &fine_axis, &merged_axis);
        Rays { bound, weights, depths, range, spread, inputs, fine, merged }
    }

    /// As the text of the method says it: the first edge whose cumulative weight is above u.
    fn expected(&self) -> Vec<Vec<f64>> {
        let more = self.fine.axes().last().expect("an axis").size();
        let one = |weights: &Vec<f64>| {
            let samples = weights.len();
            let mut cdf = vec![0.0];
            weights.iter().for_each(|w| cdf.push(cdf[cdf.len() - 1] + w));
            let depth = |j: usize| {
                let u = (j as f64 + 0.5) / more as f64;
                let above = cdf.iter().position(|c| *c > u).unwrap_or(samples + 1);
                let (low, high) = (above - 1, above.min(samples));
                let t = (u - cdf[low]) / (cdf[high] - cdf[low] + 1e-8);
                at(self.range, self.spread, (low as f64 + t * (high - low) as f64) / samples as f64)
            };
            (0..more).map(depth).collect()
        };
        self.weights.iter().map(one).collect()
    }

    fn step(&self) -> Step {
        let outputs = vec![("fine".to_string(), self.fine.clone()), ("merged".to_string(), self.merged.clone())];
        Step { outputs, updates: vec![] }
    }
}

/// The depth at a share of the range.
fn at([near, far]: [f64; 2], spread: Spread, share: f64) -> f64 {
    let value = near + share * (far - near);
    if spread == Spread::Metric { value } else { 1.0 / (value + 1e-8) }
}

#[test]
fn depths_are_those_of_a_search_and_a_sort() {
    for (samples, more) in [(6, 5), (8, 16), (64, 128)] {
        for spread in [Spread::Metric, Spread::Inverse] {
            let rays = Rays::new(samples, more, spread);
            let found = rays.bound.run(&[rays.fine.clone(), rays.merged.clone()]);
            let fine = rays.expected();
            let merged: Vec<f64> = rays
                .depths
                .iter()
                .zip(&fine)
                .flat_map(|(a, b)| {
                    let mut all = [a.clone(), b.clone()].concat();
                    all.sort_by(f64::total_cmp);
                    all
                })
                .collect();
            // Each to its own size: inverse depths reach 1e8.
            for (found, expected) in found.iter().zip([fine.concat(), merged]) {
                let relative: Vec<f64> = found.iter().zip(&expected).map(|(f, e)| f / e).collect();
                assert!(worst(&relative, &vec![1.0; expected.len()], 1.0) < 1e-9, "{samples} + {more}, {spread:?}");
            }
        }
    }
}

#[test]
fn every_device_finds_them() {
    let rays = Rays::new(16, 33, Spread::Metric);
    check(&devices(), &rays.step(), &rays.bound.bindings).unwrap_or_else(|e| panic!("{e}"));
}

/// Comparisons of every depth with every other one are never stored.
#[test]
fn no_table_of_pairs_is_written() {
    let rays = Rays::new(16, 33, Spread::Metric);
    for target in [Target::cpu(), Target::gpu()] {
        let program = compile(&rays.step(), &target).unwrap_or_else(|e| panic!("{e}"));
        let largest = program.buffers.iter().map(|b| b.shape.axes.elements()).max();
        assert_eq!(largest, Some(RAYS * (16 + 33)), "{program}");
    }
}

#[test]
fn equal_depths_all_stay() {
    let (sample, fine, merged) = (Axis::new("sample", 3), Axis::new("fine", 2), Axis::new("merged", 5));
    let mut bound = Bound::default();
    let a = bound.data("a", &[&sample], 1, vec![1.0, 2.0, 2.0]);
    let b = bound.data("b", &[&fine], 1, vec![2.0, 1.0]);
    assert_eq!(bound.run(&[merge_depths(&a, &sample, &b, &fine, &merged)])[0], [1.0, 1.0, 2.0, 2.0, 2.0]);
}

#[test]
fn gradients_stop_at_the_depths() {
    let rays = Rays::new(6, 5, Spread::Metric);
    let [weights, depths] = &rays.inputs;
    let loss = total(&(&rays.merged * &rays.merged)) + total(&rays.fine);
    let slopes = grad(&loss, &[weights, depths]);
    let found = evaluate(&slopes, &rays.bound.bindings).unwrap_or_else(|e| panic!("{e}"));
    assert!(found.iter().all(|g| g.f().iter().all(|x| *x == 0.0)));
}

#[test]
fn misfits_name_the_call() {
    let (sample, fine) = (Axis::new("sample", 3), Axis::new("fine", 2));
    let depth = |axis: &Axis, n: usize| Tensor::data(format!("{axis} {n}"), Shape::new(&[axis], n));
    let one = Tensor::scalar(1.0);
    let cases = [
        (
            fine_depths(&depth(&sample, 2), &sample, &fine, &one, &one, Spread::Metric),
            "fine_depths: weights have 2 channels, not 1",
        ),
        (
            merge_depths(&depth(&sample, 1), &sample, &depth(&fine, 1), &fine, &Axis::new("merged", 4)),
            "merge_depths: 3 and 2 depths in a list of 4",
        ),
    ];
    for (t, problem) in cases {
        let text = t.error().expect("does not fit").to_string();
        assert!(text.starts_with(&format!("{problem} at {}:", file!())), "{text}");
    }
}

/// The kernels are modules that naga finds valid.
#[cfg(feature = "gpu")]
#[test]
fn a_gpu_can_run_them() {
    use raygrad_kernels::gpu::{Inputs, Limits, lower};
    let rays = Rays::new(64, 128, Spread::Inverse);
    let program = compile(&rays.step(), &Target::gpu()).unwrap_or_else(|e| panic!("{e}"));
    let lowered = lower(&program, &mut Inputs::default(), &Limits::default()).unwrap_or_else(|e| panic!("{e}"));
    for kernel in lowered.launches.iter().flat_map(|l| &l.kernels) {
        kernel.wgsl().unwrap_or_else(|e| panic!("{e}"));
        kernel.spirv().unwrap_or_else(|e| panic!("{e}"));
    }
}
