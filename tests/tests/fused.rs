//! Small steps that fusion or lowering once got wrong, each on every device against the reference.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::matrix::matmul;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, Target, compile};
use raygrad_tests::backend::devices;
use raygrad_tests::check::check;
use raygrad_tests::{Rng, seed};

/// Inputs with random values.
struct Inputs {
    rng: Rng,
    bindings: Bindings,
}

impl Inputs {
    fn new(what: &str) -> Inputs {
        Inputs { rng: Rng(seed(what)), bindings: Bindings::new() }
    }
    fn parameter(&mut self, name: &str, shape: Shape) -> Tensor {
        self.bindings.insert(name.into(), self.rng.array(&shape, -1.0, 1.0));
        Tensor::parameter(name, shape)
    }
    fn index(&mut self, name: &str, axes: &[&Axis], below: usize) -> Tensor {
        let shape = Shape::new(axes, 1).with_dtype(DType::U32);
        let values = (0..shape.lanes()).map(|_| self.rng.below(below) as u32).collect();
        self.bindings.insert(name.into(), Array::integers(&shape, values));
        Tensor::data(name, shape)
    }
    fn check(&self, outputs: &[&Tensor], updates: &[(&Tensor, &Tensor)]) {
        let outputs = outputs.iter().enumerate().map(|(i, t)| (format!("output {i}"), (*t).clone())).collect();
        let updates = updates.iter().map(|(input, t)| ((*input).clone(), (*t).clone())).collect();
        let step = Step { outputs, updates };
        step.check().unwrap_or_else(|e| panic!("{e}"));
        check(&devices(), &step, &self.bindings).unwrap_or_else(|e| panic!("{e}"));
    }
}

#[test]
fn constants_keep_their_places_over_several_tiles() {
    let (frame, ray) = (Axis::new("frame", 3), Axis::new("ray", 1500));
    let mut inputs = Inputs::new("constants");
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 4));
    // The sum's place is free when the constants, which are stored as they are, get theirs.
    let y = x.sum_channels().sin() * &x;
    let constants = Tensor::constant(&[1.0, 2.0, 3.0, 4.0]).broadcast_to(x.axes());
    inputs.check(&[&y.sum_over(x.axes()), &constants, &concat([&y, &Tensor::constant(&[0.5, 0.25])])], &[]);
}

#[test]
fn a_bias_recorded_after_its_layer() {
    let ray = Axis::new("ray", 200);
    for negative in [false, true] {
        let mut inputs = Inputs::new("bias");
        let x = inputs.parameter("x", Shape::new(&[&ray], 5));
        let w = inputs.parameter("w", Shape::new(&[], (5, 8)));
        let y = x.sin().linear(&w);
        let b = inputs.parameter("b", Shape::new(&[], 8));
        let bias = if negative { -&b } else { b };
        inputs.check(&[&(&y + bias).relu()], &[]);
    }
}

#[test]
fn a_layer_and_a_layer_that_does_not_vary_along_the_rows() {
    let (frame, ray) = (Axis::new("frame", 2), Axis::new("ray", 40));
    let mut inputs = Inputs::new("two layers");
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 5));
    let code = inputs.parameter("code", Shape::new(&[&frame], 3));
    let w = inputs.parameter("w", Shape::new(&[], (5, 4)));
    let v = inputs.parameter("v", Shape::new(&[], (2, 4)));
    // Recorded along the rays, but the same for all of them.
    let wide = code.broadcast_to(x.axes()).channel_groups(vec![vec![0, 1], vec![2]]);
    let (y, z) = (x.linear(&w), wide.linear(&v));
    inputs.check(&[&(&y + &z)], &[]);
    inputs.check(&[&(&z + &y).relu()], &[]);
    inputs.check(&[&z.greater_than(&Tensor::scalar(9.0)).select(&z, &y)], &[]);
}

#[test]
fn a_layer_of_few_terms_beside_another() {
    let (frame, ray) = (Axis::new("frame", 3), Axis::new("ray", 77));
    let mut inputs = Inputs::new("few terms");
    let wide = inputs.parameter("wide", Shape::new(&[&frame, &ray], 20));
    let w = inputs.parameter("w", Shape::new(&[], (20, 70)));
    for terms in 1..=4 {
        // One that varies along the rows, from transposed weights too, and one that does not.
        let few = inputs.parameter(&format!("few {terms}"), Shape::new(&[&frame, &ray], terms));
        let code = inputs.parameter(&format!("code {terms}"), Shape::new(&[&frame], terms));
        let v = inputs.parameter(&format!("v {terms}"), Shape::new(&[], (terms, 70)));
        let u = inputs.parameter(&format!("u {terms}"), Shape::new(&[], (70, terms)));
        let (y, mask) = (wide.linear(&w), wide.ch(0).greater_than(&Tensor::scalar(0.0)));
        let sums = (&y + few.linear(&v)).sin();
        inputs.check(&[&sums, &sums.sum(&[&frame, &ray])], &[]);
        inputs.check(&[&mask.select(&(&y - few.linear_transposed(&u)), &y).relu()], &[]);
        inputs.check(&[&(code.broadcast_to(wide.axes()).linear(&v) + &y), &few.linear(&v)], &[]);
    }
}

#[test]
fn a_gather_along_an_axis_that_others_vary_along() {
    let (frame, ray, slot) = (Axis::new("frame", 4), Axis::new("ray", 40), Axis::new("slot", 3));
    let mut inputs = Inputs::new("gather");
    let by_frame = inputs.parameter("by frame", Shape::new(&[&frame], 3));
    let by_ray = inputs.parameter("by ray", Shape::new(&[&ray], 3));
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 3));
    let one = inputs.index("one", &[], 4);
    let per_ray = inputs.index("per ray", &[&ray], 5);
    let per_frame = inputs.index("per frame", &[&frame], 50);
    let fixed = concat([&by_frame.take(&one, &frame), &x]);
    let across = by_frame.take(&per_ray, &frame) * &x + by_ray.take(&per_frame, &ray);
    // A table that is the same in every slot, and one that is a part of an input.
    let per_slot = inputs.index("which slot", &[&frame], 3);
    let repeated = by_ray.broadcast_to(&Axes::new([ray.clone(), slot.clone()])).take(&per_slot, &slot);
    let part = by_ray.slice(1..3).take(&per_frame, &ray);
    inputs.check(&[&fixed, &across, &repeated, &part], &[]);
}

#[test]
fn outer_products_of_parts_that_lack_a_kept_axis() {
    let (frame, ray) = (Axis::new("frame", 3), Axis::new("ray", 20));
    let mut inputs = Inputs::new("outer");
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 2));
    let code = inputs.parameter("code", Shape::new(&[], 3));
    let d = inputs.parameter("d", Shape::new(&[&ray], 4));
    let keep = Axes::new([frame.clone()]);
    inputs.check(&[&concat([&code, &x]).outer(&d, &keep), &concat([&x, &code]).outer(&d, x.axes())], &[]);
}

#[test]
fn parameters_that_take_each_others_lanes() {
    let mut inputs = Inputs::new("lanes");
    let p = inputs.parameter("p", Shape::new(&[], (20, 32)));
    let q = inputs.parameter("q", Shape::new(&[], 640));
    inputs.check(&[], &[(&p, &q.reshape((640, 1))), (&q, &p.reshape((640, 1)))]);
    inputs.check(&[], &[(&p, &q), (&q, &p)]);
    inputs.check(&[&q], &[(&p, &(&q * 0.5).reshape((20, 32))), (&q, &(p.reshape(640) + &q).sin())]);
    let rotated: Vec<usize> = (0..640).map(|c| (c + 70) % 640).collect();
    inputs.check(&[], &[(&q, &q.pick(&rotated))]);
    inputs.check(&[&p], &[(&q, &(q.pick(&rotated) * 0.5))]);
    // Next to a value whose channels are rearranged, and beside one that others read in every channel.
    let (g, r) = (inputs.parameter("g", Shape::new(&[], 640)), inputs.parameter("r", Shape::new(&[], 1)));
    inputs.check(&[], &[(&q, &(&q - &g.pick(&rotated) * 0.5)), (&p, &(&p * 0.5))]);
    inputs.check(&[], &[(&q, &(&q * &r)), (&r, &(&r * 0.5))]);
    inputs.check(&[], &[(&q, &(&q * &r - &g.pick(&rotated))), (&r, &(&r * q.sum_channels()))]);
}

/// Many channels that are written and of which few are made: without staging, one invocation would compute all of them.
#[test]
fn sums_of_many_channels_that_are_written_too() {
    let mut inputs = Inputs::new("sums of many");
    let parts = [2, 128].map(|n| inputs.parameter(&format!("part {n}"), Shape::new(&[], (n, 16))).reshape(16 * n));
    let [p, q] = ["p", "q"].map(|n| inputs.parameter(n, Shape::new(&[], 2080)));
    let every = |n: u32| (0..n).map(|first| (first..2080).step_by(n as usize).collect()).collect();
    let whole = (concat(&parts) + &p).sin();
    let few = (&whole * &whole).channel_groups(every(64));
    inputs.check(&[&whole, &few, &(&few + whole.slice(100..164))], &[]);
    // One that replaces what the sums' other operands are made of.
    let replaced = &q * 0.5;
    inputs.check(&[&whole, &(&replaced * &q).channel_groups(every(64))], &[(&q, &replaced)]);
}

/// Long products of small matrices, in stages; the last is multiplied by the state that it replaces.
#[test]
fn a_state_that_a_later_stage_reads() {
    let frame = Axis::new("frame", 30);
    let mut inputs = Inputs::new("stages");
    let state = inputs.parameter("state", Shape::new(&[&frame], (4, 4)));
    let next = (0..20).fold(state.clone(), |product, _| matmul(&product, &(&state * 0.5)));
    inputs.check(&[&matmul(&next, &state)], &[(&state, &next)]);
}

#[test]
fn states_that_read_other_elements_of_themselves() {
    let (frame, ray) = (Axis::new("frame", 3), Axis::new("ray", 300));
    let mut inputs = Inputs::new("elements");
    let s = inputs.parameter("s", Shape::new(&[&frame, &ray], 2));
    let count = Tensor::input("count", Role::State, Shape::new(&[], 1).with_dtype(DType::U32));
    inputs.bindings.insert("count".into(), Array::integers(count.shape(), vec![5]));
    let next = count.wrapping_add(&Tensor::integers(&[1]));
    inputs.check(&[&count], &[(&s, &s.shift(&ray, 1)), (&count, &next)]);
    inputs.check(&[&next], &[(&s, &s.shift(&frame, -1)), (&count, &next)]);
    inputs.check(&[&s], &[(&s, &s.mean(&[&ray]))]);
    inputs.check(&[], &[(&s, &(&s - s.mean(&[&frame])))]);
    inputs.check(&[], &[(&s, &s.reverse_cumsum(&frame))]);
}

/// On the way back the inner sum is one over a gradient that is the same in every frame, several frames to a tile of a CPU.
#[test]
fn sums_along_lines_that_are_all_the_same() {
    let (frame, ray) = (Axis::new("frame", 200), Axis::new("ray", 3));
    let mut inputs = Inputs::new("lines");
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 5));
    let w = inputs.parameter("w", Shape::new(&[], (5, 16)));
    let y = x.linear(&w).tanh();
    let both = concat([&y, &y.sum(&[&ray])]).sum(&[&frame]) * 0.01;
    let along = (&both * both.sin()).sum_channels();
    let gradients = grad(&along.sum(&[&ray]), &[&x, &w]);
    inputs.check(&[&gradients[0], &gradients[1]], &[]);
    // A maximum and a sum, of values that do not vary along the lines either.
    let level = inputs.parameter("level", Shape::new(&[&ray], 5));
    let same = level.broadcast_to(x.axes());
    inputs.check(&[&(&x + same.sum(&[&ray]) * same.max_over(&[&ray]) + y.sum(&[&ray]).ch(0))], &[]);
}

/// What equals its maximum must be that very value, not one computed again in another launch, where it may be rounded otherwise.
#[test]
fn what_is_compared_with_its_maximum_is_computed_once() {
    let (frame, ray) = (Axis::new("frame", 4), Axis::new("ray", 600));
    let mut inputs = Inputs::new("maximum");
    let x = inputs.parameter("x", Shape::new(&[&frame, &ray], 3));
    let y = x.sin() + &x;
    let channel = (&x * 3.0).sin() + 2.0;
    let loss = (y.max_over(&[&ray]).exp() * channel.max_channels().mean(&[&ray])).mean_all();
    let gradient = grad(&loss, &[&x]).remove(0);
    inputs.check(&[&loss, &gradient], &[]);
    let step = Step { outputs: vec![("gradient".into(), gradient)], updates: vec![] };
    for target in [Target::cpu(), Target::gpu()] {
        let program = compile(&step, &target).unwrap_or_else(|e| panic!("{e}"));
        let labels = program.launches.iter().flat_map(|l| &l.region.body).map(|i| i.label.as_str());
        let sines = labels.flat_map(|l| l.split('+')).filter(|l| *l == "sin").count();
        assert_eq!(sines, 2, "{program}");
    }
}
