//! Volume rendering: one pass over the samples on a CPU, and the values of the reference on every device.

use raygrad_compiler::functions::mlp::Activation;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::plan::BufferKind;
use raygrad_compiler::plan::region::RegionOp;
use raygrad_compiler::reference::Bindings;
use raygrad_compiler::{Program, Step, Target, compile};
use raygrad_runtime::Device;
use raygrad_tests::backend::devices_for_large_programs;
use raygrad_tests::check::{check, same_bits};
use raygrad_tests::rendering::{Rendering, Sizes};
use raygrad_tests::{Rng, seed};
use std::collections::BTreeMap;

const SMALL: Sizes = Sizes { frames: 2, rays: 3, samples: 8, width: 17, hidden: Activation::Relu, warped: true };

fn checked(step: &Step, bindings: &Bindings) {
    step.check().unwrap_or_else(|e| panic!("{e}"));
    check(&devices_for_large_programs(), step, bindings).unwrap_or_else(|e| panic!("{e}"));
    let threads = [1, 2].map(|n| Device::cpu(Some(n)).unwrap_or_else(|e| panic!("{e}")));
    same_bits(&threads[0], &threads[1], step, bindings).unwrap_or_else(|e| panic!("{e}"));
}

fn plan(step: &Step, target: Target) -> Program {
    compile(step, &target).unwrap_or_else(|e| panic!("{e}"))
}

/// Launches that reduce inside their tiles.
fn reducing(program: &Program) -> usize {
    let reduces = |op: &RegionOp| matches!(op, RegionOp::RowReduce(_));
    program.launches.iter().filter(|l| l.region.body.iter().any(|i| reduces(&i.op))).count()
}

#[test]
fn values_and_gradients() {
    let more = Sizes { frames: 3, rays: 5, samples: 16, ..SMALL };
    let long = Sizes { rays: 1, samples: 130, warped: false, ..SMALL };
    for sizes in [SMALL, more, long, Sizes { warped: false, ..SMALL }] {
        let scene = Rendering::new(sizes);
        checked(&scene.step(), &scene.bindings);
    }
}

#[test]
fn second_derivatives() {
    for warped in [true, false] {
        let scene = Rendering::new(Sizes { width: 9, hidden: Activation::Tanh, warped, ..SMALL });
        let (step, bindings) = scene.second_order();
        checked(&step, &bindings);
    }
}

/// Every layer of the field is computed once forwards and once backwards, all of them in one launch.
#[test]
fn one_pass_over_the_samples() {
    let large = Sizes { frames: 4, rays: 64, samples: 128, width: 257, ..SMALL };
    // Given rays: the first layers need nothing from memory, the view branch does.
    for sizes in [SMALL, large, Sizes { warped: false, ..SMALL }, Sizes { warped: false, ..large }] {
        let program = plan(&Rendering::new(sizes).step(), Target::cpu());
        let field = |b: usize| match &program.buffers[b].kind {
            BufferKind::Input { name, .. } => name.starts_with("field") || name.starts_with("view"),
            _ => false,
        };
        let mut products: BTreeMap<(String, usize, bool), usize> = BTreeMap::new();
        let mut over_samples = 0;
        for region in program.launches.iter().map(|l| &l.region) {
            let layers = region.body.iter().filter_map(|i| match &i.op {
                RegionOp::Linear(w) if field(w.buffer.0 as usize) => Some(w),
                _ => None,
            });
            let before: usize = products.values().sum();
            for w in layers {
                let name = program.buffer(w.buffer).label.clone();
                *products.entry((name, w.first, w.transposed)).or_default() += 1;
            }
            let samples = region.domain.iter().any(|a| a.name() == "sample");
            over_samples += usize::from(samples && products.values().sum::<usize>() > before);
        }
        // Six layers, the first of the view branch in two parts. Backwards the parts of an operand come apart.
        let forwards = products.keys().filter(|(_, _, transposed)| !transposed).count();
        assert_eq!((forwards, products.len()), (7, 16), "{products:#?}\n{program}");
        assert!(products.values().all(|n| *n == 1), "{products:#?}\n{program}");
        assert_eq!((over_samples, reducing(&program)), (1, 1), "{program}");
    }
}

/// A GPU ends its region with every reduction.
#[test]
fn a_gpu_reduces_between_launches() {
    let scene = Rendering::new(SMALL);
    let program = plan(&scene.step(), Target::gpu());
    assert_eq!(reducing(&program), 0, "{program}");
}

struct Lines {
    x: Tensor,
    sample: Axis,
    bindings: Bindings,
}

impl Lines {
    /// A layer on `[ray, sample]`, whose inputs and weights are parameters.
    fn new(rays: usize, samples: usize) -> Lines {
        let (ray, sample) = (Axis::new("ray", rays), Axis::new("sample", samples));
        let x = Tensor::parameter("x", Shape::new(&[&ray, &sample], 3));
        let w = Tensor::parameter("w", Shape::new(&[], (3, 4)));
        let mut rng = Rng(seed("lines"));
        let bindings = [&x, &w].map(|p| (p.input_name().unwrap_or_default().into(), rng.array(p.shape(), -1.0, 1.0)));
        Lines { x: x.linear(&w).sin(), sample, bindings: bindings.into() }
    }

    fn check(&self, outputs: &[&Tensor], launches: usize) {
        let outputs = outputs.iter().enumerate().map(|(i, t)| (format!("output {i}"), (*t).clone())).collect();
        let step = Step { outputs, updates: vec![] };
        let program = plan(&step, Target::cpu());
        assert_eq!(reducing(&program), launches, "{program}");
        checked(&step, &self.bindings);
    }
}

#[test]
fn long_lines_are_whole_tiles_only_where_they_are_many() {
    for (rays, samples, launches) in [(3, 192, 1), (3, 300, 0), (16, 300, 1), (16, 1024, 1), (16, 1025, 0)] {
        let lines = Lines::new(rays, samples);
        lines.check(&[&(&lines.x - lines.x.mean(&[&lines.sample])).exp()], launches);
    }
}

#[test]
fn sums_and_maxima_of_one_line_feed_each_other() {
    let lines = Lines::new(5, 20);
    let e = (&lines.x - lines.x.max_over(&[&lines.sample])).exp();
    let soft = &e / e.sum(&[&lines.sample]);
    let largest = soft.max_channels().max_over(&[&lines.sample]);
    lines.check(&[&soft, &(&soft * &largest).sum(&[&lines.sample]), &largest], 1);
}

/// The same value is needed inside the tile, by other launches, and by samples that wait for a sum over all rays.
#[test]
fn a_sum_of_a_line_that_others_need_too() {
    let lines = Lines::new(6, 10);
    let (x, sample) = (&lines.x, &lines.sample);
    let mean = x.mean(&[sample]);
    let squares = (&mean * &mean + 1.0).sqrt();
    let all = squares.sum_over(squares.axes());
    let inside = x * &squares;
    let later = x * &squares / &all + inside.sum(&[sample]);
    lines.check(&[&inside, &later, &squares, &later.sum_over(later.axes())], 1);
    // Nothing goes back into the samples: the sum ends its region.
    lines.check(&[&squares, &all], 0);
}

#[test]
fn what_does_not_vary_along_a_line() {
    let lines = Lines::new(6, 10);
    let x = &lines.x;
    // The layer of a mean has the axes of the samples, but is the same for all of them.
    let w = Tensor::constant_matrix(4, 2, &[0.5, -0.25, 0.1, 0.2, 0.3, -0.1, 0.7, 0.4]);
    let level = x.mean(&[&lines.sample]).broadcast_to(x.axes());
    let same = level.channel_groups(vec![vec![0, 1], vec![2], vec![3], vec![0]]).linear(&w).broadcast_to(x.axes());
    let sum = (&same * x.slice(0..2)).sum(&[&lines.sample]);
    lines.check(&[&(x.slice(2..4) * &sum + &same), &same], 1);
    let axes = Axes::new([lines.sample.clone()]);
    lines.check(&[&(x - x.mean(&[&lines.sample])).outer(x, &axes)], 1);
}
