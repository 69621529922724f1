//! One small step for each form of kernel.

use crate::total;
use raygrad_compiler::Step;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::scalar::DType;

/// Names and steps.
pub fn forms() -> Vec<(&'static str, Step)> {
    vec![
        ("pointwise", pointwise()),
        ("layers", layers()),
        ("rows", rows()),
        ("reduce", reduce()),
        ("scan", scan()),
        ("take", take()),
        ("scatter", scatter()),
        ("eigen", eigen()),
        ("update", update()),
    ]
}

fn step(outputs: &[(&str, &Tensor)]) -> Step {
    Step { outputs: outputs.iter().map(|(n, t)| (n.to_string(), (*t).clone())).collect(), updates: vec![] }
}

fn axes() -> (Axis, Axis) {
    (Axis::new("frame", 4), Axis::new("ray", 300))
}

/// Chains of pointwise ops over rows, broadcasting by name.
fn pointwise() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 3));
    let y = Tensor::data("y", Shape::new(&[&ray], 1));
    let z = (x.sin() * &y + 1.0).abs().sqrt();
    let kept = z.greater_than(&Tensor::scalar(1.0)).select(&z, &Tensor::constant(&[0.1, 0.2, 0.3]));
    step(&[("z", &z), ("kept", &concat([&kept.ch(2), &kept.ch(0), &y]))])
}

/// Two wide layers with biases and activations, forwards and backwards: matrix kernels, masks, outer products.
fn layers() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 8));
    let parameter = |name: &str, shape: Shape| Tensor::parameter(name, shape);
    let (w1, b1) = (parameter("w1", Shape::new(&[], (8, 128))), parameter("b1", Shape::new(&[], 128)));
    let (w2, b2) = (parameter("w2", Shape::new(&[], (128, 3))), parameter("b2", Shape::new(&[], 3)));
    let y = ((x.linear(&w1) + &b1).relu().linear(&w2) + &b2).sigmoid();
    let loss = total(&(&y * &y));
    let g = grad(&loss, &[&w1, &b1, &w2, &b2]);
    step(&[("loss", &loss), ("w1", &g[0]), ("b1", &g[1]), ("w2", &g[2]), ("b2", &g[3])])
}

/// Layers whose weights vary from row to row, and products that are not summed over the innermost axis.
fn rows() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 3));
    let per_ray = Tensor::parameter("per ray", Shape::new(&[&ray], (3, 2)));
    let per_frame = Tensor::parameter("per frame", Shape::new(&[&frame], (2, 2)));
    let y = x.linear(&per_ray).linear(&per_frame);
    let g = grad(&total(&(&y * &y)), &[&per_ray, &per_frame]);
    step(&[("y", &y), ("per ray", &g[0]), ("per frame", &g[1])])
}

/// Sums and maxima over inner, outer and all axes.
fn reduce() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 3));
    let inner = (&x * &x).sum(&[&ray]);
    let outer = x.cos().mean(&[&frame]);
    step(&[("inner", &inner), ("outer", &outer), ("all", &total(&x.exp())), ("largest", &x.max_over(&[&frame, &ray]))])
}

/// Cumulative sums and shifts along the inner and the outer axis.
fn scan() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 2));
    let y = (-x.cumsum(&ray)).exp() - x.shift(&ray, 1);
    step(&[("y", &y), ("outer", &x.reverse_cumsum(&frame)), ("sum", &y.sum(&[&ray]))])
}

/// A gather by a computed index.
fn take() -> Step {
    let (frame, ray) = axes();
    let texel = Axis::new("texel", 64);
    let table = Tensor::data("table", Shape::new(&[&texel], 3));
    let at = Tensor::data("at", Shape::new(&[&frame, &ray], 1));
    step(&[("found", &(table.take(&(at * 64.0).to_u32(), &texel) * 2.0))])
}

/// Its adjoint.
fn scatter() -> Step {
    let (frame, ray) = axes();
    let texel = Axis::new("texel", 64);
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 3));
    let at = Tensor::data("at", Shape::new(&[&frame, &ray], 1).with_dtype(DType::U32));
    let none = x.scatter(&at, &texel, &Axes::none());
    let kept = (&x * 2.0).scatter(&at, &texel, &Axes::new([frame]));
    step(&[("none kept", &none), ("frames kept", &kept)])
}

/// Eigenvectors of sums of outer products.
fn eigen() -> Step {
    let (frame, ray) = axes();
    let x = Tensor::data("x", Shape::new(&[&frame, &ray], 3));
    let (values, vectors) = x.outer(&x, &Axes::new([frame])).sym_eig();
    step(&[("values", &values), ("vectors", &vectors)])
}

/// Adam on a wide parameter whose gradient comes in parts: all launches work lane by lane and in place.
fn update() -> Step {
    let p = Tensor::parameter("p", Shape::new(&[], (64, 64)));
    let part = |name: &str| Tensor::data(name, Shape::new(&[], 32 * 64));
    let g = concat([&part("g0"), &part("g1")]).reshape((64, 64));
    let scalar = |name: &str| Tensor::per_step(name, Shape::new(&[], 1));
    let scalars = StepScalars { lr: scalar("lr"), bias1: scalar("bias1"), bias2: scalar("bias2") };
    let old = Moments::of(&p);
    let (value, new) = Adam::default().update(&p, &g, &old, &scalars);
    Step { outputs: vec![], updates: vec![(p, value), (old.m, new.m), (old.v, new.v)] }
}
