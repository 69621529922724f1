//! Mistakes that people make, for the messages they get. The messages name lines of this file.

use raygrad_compiler::functions::along::{concat_along, slice_along};
use raygrad_compiler::functions::homography::{Solver, fit_homography};
use raygrad_compiler::functions::inverse::{inverse, solve};
use raygrad_compiler::functions::lie::cross;
use raygrad_compiler::functions::loss::charbonnier;
use raygrad_compiler::functions::matrix::{compose_poses, matmul};
use raygrad_compiler::functions::mlp::{Mlp, MlpSpec};
use raygrad_compiler::functions::vector::norm;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, StepError};

/// Ops whose operands do not fit: what was done, and the tensor that carries the error.
pub fn recorded() -> Vec<(&'static str, Tensor)> {
    let (frame, ray, sample) = (Axis::new("frame", 5), Axis::new("ray", 1024), Axis::new("sample", 64));
    let points = Tensor::data("points", Shape::new(&[&ray, &sample], 3));
    let colour = Tensor::data("colour", Shape::new(&[&ray], 4));
    let code = Tensor::parameter("code", Shape::new(&[&frame], 32));
    let weights = Tensor::parameter("layer0.weight", Shape::new(&[], (35, 256)));
    let count = Tensor::data("count", Shape::new(&[&ray], 1).with_dtype(DType::U32));
    let part = Axis::new("part", 32);
    let other = Tensor::data("other", Shape::new(&[&Axis::new("ray", 2048)], 3));
    vec![
        ("channels of a sum that differ", &points + &colour),
        ("an axis made twice", &points * &other),
        ("a layer of the wrong width", concat([&points, &code]).ch(0).linear(&weights)),
        ("weights that are no matrix", points.linear(&code)),
        ("an axis that is not there", colour.sum(&[&sample])),
        ("a sum along an axis that is not there", colour.cumsum(&sample)),
        ("an integer where a float is due", (&count + 1.0).sqrt()),
        ("a float where an index is due", points.take(&colour.ch(0), &ray)),
        ("an index that has the axis it points along", points.take(&count, &ray)),
        ("channels past the end", colour.slice(2..6)),
        ("channels that do not fill a matrix", colour.reshape((3, 3))),
        ("a matrix that is not square", weights.sym_eig().0),
        ("matrices that do not meet", matmul(&weights, &weights)),
        ("a network with other inputs", Mlp::new(MlpSpec::new("field", &[34, 64, 3])).apply(&points)),
        ("points of three dimensions in a plane", plane(&points, &colour, &sample)),
        ("a scale that is not positive", points.gaussian(-1.0)),
        ("scattered into an axis the values have", colour.scatter(&count, &ray, &Axes::none())),
        ("bounds in the wrong order", colour.clamp(1.0, 0.0)),
        ("a power of an integer", count.powf(2.2)),
        ("an angle of an integer", count.acos()),
        ("the length of an integer", norm(&count)),
        ("a matrix that has no inverse", inverse(&weights)),
        ("a right side that does not fit", solve(&colour.reshape((2, 2)), &points)),
        ("a slice past the end", slice_along(&colour, &ray, 1000, &part)),
        ("a slice along an axis that is not there", slice_along(&colour, &sample, 0, &part)),
        ("a slice into an axis that is there", slice_along(&points, &ray, 0, &sample)),
        ("parts that do not fill an axis", concat_along(&[(&colour, &ray), (&points, &ray)], &part)),
        ("parts with other channels", concat_along(&[(&colour, &ray), (&points, &ray)], &Axis::new("both", 2048))),
        ("a comparison of other channels", points.greater_than(&colour)),
        ("a choice by a float", colour.select(&points, &points)),
        ("the mean along an axis that is not there", colour.mean(&[&sample])),
        ("the least along an axis that is not there", colour.min_over(&[&sample])),
        ("the largest channel of an integer", count.argmax_channels()),
        ("a pose that is none", compose_poses(&colour, &colour)),
        ("a cross product of four channels", cross(&colour, &colour)),
        ("a matrix too large to be solved", solve(&weights.slice(0..25).reshape((5, 5)), &points)),
        ("a Charbonnier loss without a width", charbonnier(&points, &other, 0.0)),
    ]
}

fn plane(x: &Tensor, y: &Tensor, over: &Axis) -> Tensor {
    fit_homography(x, y, &Axes::new([over.clone()]), Solver::Eigen, None)
}

/// Steps that cannot be compiled.
pub fn steps() -> Vec<(&'static str, StepError)> {
    let (frame, ray) = (Axis::new("frame", 5), Axis::new("ray", 8));
    let p = Tensor::parameter("p", Shape::new(&[&frame], 3));
    let data = Tensor::data("image", Shape::new(&[&ray], 3));
    let clash = Tensor::input("p", Role::State, Shape::new(&[&frame], 2));
    let named = |name: &str, t: &Tensor| (name.to_string(), t.clone());
    let refused = |outputs: Vec<(String, Tensor)>, updates: Vec<(Tensor, Tensor)>| {
        Step { outputs, updates }.check().expect_err("the step cannot be compiled")
    };
    vec![
        ("a recording error", refused(vec![named("loss", &(&p + &data.ch(7)).sin())], vec![])),
        ("two inputs of one name", refused(vec![named("sum", &(&p + clash.ch(0)))], vec![])),
        ("an update of data", refused(vec![], vec![(data.clone(), &data * 2.0)])),
        ("an update of a computed value", refused(vec![], vec![(&p * 1.5, p.clone())])),
        ("an update with axes of its own", refused(vec![], vec![(p.clone(), &p * &data)])),
        ("an update with other channels", refused(vec![], vec![(p.clone(), p.slice(0..2))])),
        ("two updates of one input", refused(vec![], vec![(p.clone(), &p * 2.0), (p.clone(), p.sin())])),
        ("two outputs of one name", refused(vec![named("loss", &p), named("loss", &data)], vec![])),
        ("nothing to do", refused(vec![], vec![])),
    ]
}
