//! Messages of ops that do not fit: both operands with axes and channels, the user's line, and a hint.

use raygrad_compiler::autodiff::{grad, jvp};
use raygrad_compiler::functions::along::{concat_along, slice_along};
use raygrad_compiler::functions::inverse::{determinant, solve};
use raygrad_compiler::functions::lie::{se3_exp, sl3_exp, so3_exp};
use raygrad_compiler::functions::loss::charbonnier;
use raygrad_compiler::functions::matrix::{apply_homography, matmul};
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec};
use raygrad_compiler::functions::posenc::positional_encoding;
use raygrad_compiler::functions::vector::{norm, normalize};
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor, topological};
use raygrad_compiler::ops::custom::custom_adjoint;
use raygrad_compiler::ops::map;
use raygrad_compiler::reference::{Array, Bindings, Direction, EvalError, central_difference, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, Target, compile};
use raygrad_tests::{own_op, total};

fn message(t: &Tensor) -> String {
    t.error().expect("does not fit").to_string()
}

/// `file:line`, `back` lines above the call.
macro_rules! at {
    ($back:expr) => {
        format!("{}:{}", file!(), line!() - $back)
    };
}

#[test]
fn channels_of_an_elementwise_op() {
    let (ray, sample) = (Axis::new("ray", 4), Axis::new("sample", 8));
    let a = Tensor::parameter("a", Shape::new(&[&ray], 3));
    let b = Tensor::parameter("b", Shape::new(&[&ray, &sample], 2));
    let (from_a, from_b) = (at!(2), at!(1));
    let sum = &a + &b;
    let here = at!(1);
    assert_eq!(
        message(&sum),
        format!(
            "add: channels 3 and 2 do not match at {here}\n  operand 1: [ray=4] x 3, from {from_a}\n  \
             operand 2: [ray=4, sample=8] x 2, from {from_b}\n  hint: both operands need 3 channels, or one of them 1"
        )
    );
    assert!(file!().starts_with("tests/"), "paths are relative to the repository: {}", file!());
}

#[test]
fn rows_of_a_linear_layer() {
    let ray = Axis::new("ray", 4);
    let x = Tensor::data("x", Shape::new(&[&ray], 34));
    let w = Tensor::parameter("w", Shape::new(&[], (32, 256)));
    let (from_x, from_w) = (at!(2), at!(1));
    let y = x.linear(&w);
    let here = at!(1);
    assert_eq!(
        message(&y),
        format!(
            "linear: 34 input channels do not fit weights (32, 256) at {here}\n  operand 1: [ray=4] x 34, from {from_x}\n  \
             operand 2: [] x (32, 256), from {from_w}\n  hint: weights (34, out) or 32 input channels would fit"
        )
    );
}

#[test]
fn lane_types() {
    let x = Tensor::data("x", Shape::new(&[], 1).with_dtype(DType::U32));
    let from_x = at!(1);
    let y = x.exp();
    let here = at!(1);
    assert_eq!(
        message(&y),
        format!(
            "exp: operand 1 must be f32, found [] x 1 u32 at {here}\n  operand 1: [] x 1 u32, from {from_x}\n  \
             hint: convert it with .to_f32()"
        )
    );
    let z = Tensor::scalar(1.0).select(&x, &x);
    assert!(message(&z).contains("hint: a comparison gives one"), "{}", message(&z));
}

#[test]
fn axes_made_twice() {
    let (first, second) = (Axis::new("frame", 5), Axis::new("frame", 6));
    let a = Tensor::parameter("a", Shape::new(&[&first], 1));
    let b = Tensor::parameter("b", Shape::new(&[&second], 1));
    let (from_a, from_b) = (at!(2), at!(1));
    let product = a * b;
    let here = at!(1);
    assert_eq!(
        message(&product),
        format!(
            "mul: axis `frame` has size 5 in one place and 6 in another at {here}\n  operand 1: [frame=5] x 1, from {from_a}\n  \
             operand 2: [frame=6] x 1, from {from_b}\n  \
             hint: make the axis once with Axis::new and clone it, or give the second another name"
        )
    );
}

#[test]
fn an_axis_that_is_not_there() {
    let (ray, sample) = (Axis::new("ray", 4), Axis::new("sample", 8));
    let x = Tensor::data("x", Shape::new(&[&ray], 1));
    for (t, op) in [(x.sum(&[&sample]), "sum"), (x.cumsum(&sample), "cumsum"), (x.shift(&sample, 1), "shift")] {
        let text = message(&t);
        assert!(text.starts_with(&format!("{op}: [ray=4] x 1 has no ax")), "{text}");
        assert!(text.contains("sample") && text.contains("hint: axes here: [ray=4]"), "{text}");
    }
}

#[test]
fn derived_functions_name_the_users_line() {
    let a = Tensor::parameter("a", Shape::new(&[], (2, 3)));
    let from_a = at!(1);
    let product = matmul(&a, &a);
    let here = at!(1);
    assert_eq!(
        message(&product),
        format!(
            "matmul: 3 columns do not meet 2 rows at {here}\n  operand 1: [] x (2, 3), from {from_a}\n  \
             operand 2: [] x (2, 3), from {from_a}\n  hint: the inner sizes must agree; transpose() one of them?"
        )
    );
}

/// What a run stops at, or a plan lists, is then a line of the user's.
#[test]
fn every_node_of_a_derived_function_carries_the_users_line() {
    let (row, part, both) = (Axis::new("row", 3), Axis::new("part", 2), Axis::new("both", 6));
    let x = Tensor::parameter("x", Shape::new(&[&row], 16));
    let (v, m) = (x.slice(0..3), x.reshape((4, 4)));
    let made = [
        ("norm", norm(&v)),
        ("normalize", normalize(&v)),
        ("determinant", determinant(&m)),
        ("solve", solve(&m, &x.slice(0..4))),
        ("slice_along", slice_along(&x, &row, 1, &part)),
        ("concat_along", concat_along(&[(&x, &row), (&x, &row)], &both)),
        ("argmin_channels", x.argmin_channels().to_f32()),
        ("powi", x.powi(-5)),
        ("charbonnier", charbonnier(&x, &m.reshape(16), 0.1)),
        ("elu", Activation::Elu.apply(&x)),
        ("so3_exp", so3_exp(&v)),
        ("se3_exp", se3_exp(&x.slice(0..6))),
        ("sl3_exp", sl3_exp(&x.slice(0..8))),
        ("positional_encoding", positional_encoding(&v, 3, None)),
        ("apply_homography", apply_homography(&x.slice(0..9).reshape((3, 3)), &x.slice(0..2))),
    ];
    for (name, y) in made {
        let gradient = grad(&y.sum_channels().sum_over(y.axes()), &[&x]).remove(0);
        for node in topological([y, gradient]) {
            assert_eq!(node.source().file(), file!(), "{name}: {node:?} of line {}", node.source().line());
        }
    }
}

#[test]
fn other_arguments() {
    let x = Tensor::data("x", Shape::new(&[], 4));
    assert!(message(&x.softplus(0.0)).contains("beta is 0"));
    assert!(message(&x.gaussian(f64::NAN)).contains("sigma is NaN"));
    assert!(message(&x.ch(4)).contains("channels 0 to 3 exist"));
    assert!(message(&x.reshape((2, 3))).contains("4 channels cannot be seen as (2, 3)"));
    assert!(message(&x.sym_eig().0).contains("reshape the channels to (n, n)"));
    assert!(message(&x.linear(&x)).contains("weights are (in, out): (4, out) fits here"));
    assert!(message(&Tensor::constant(&[])).contains("constant: [] x 0 is empty"));
    assert!(message(&Tensor::parameter("w", Shape::new(&[], 0))).contains("input: [] x 0 is empty"));
    assert!(message(&x.pick_as(&[0, 1, 2], (2, 2))).contains("3 channels arranged as (2, 2)"));
    assert!(message(&x.pick(&[1 << 32])).contains("channels 0 to 3 exist"));
    assert!(message(&x.channel_groups(vec![vec![7]])).contains("channels 0 to 3 exist"));
    assert!(message(&x.channel_groups(vec![])).contains("no groups of channels"));
    assert!(message(&map(own_op::Neg, &[&x, &x])).contains("2 operands for an op of 1"));
    assert!(message(&jvp(&x.sin(), &[&x], &[])).contains("0 tangents for 1 inputs"));
    let wider = Tensor::data("wider", Shape::new(&[&Axis::new("other", 3)], 4));
    for tangent in [wider, Tensor::constant(&[1.0, 2.0])] {
        let text = message(&jvp(&x.sin(), &[&x], &[&tangent]));
        assert!(text.contains("a tangent (operand 2) does not fit its input") && text.contains("errors.rs"), "{text}");
    }
    let whole = x.to_u32();
    for (loss, by) in [(&whole, &x), (&x, &whole)] {
        let text = message(&grad(loss, &[by])[0]);
        assert!(text.contains("whole numbers have no derivative") && text.contains("errors.rs"), "{text}");
    }
    let spec = MlpSpec::new("net", &[4, 8, 2]).skip(&[1, 7]);
    assert!(message(&Mlp::new(spec).apply(&x)).contains("layer 7 sees the input again, but there are 2 layers"));
}

#[test]
fn two_axes_of_one_name_in_one_shape() {
    let (first, second) = (Axis::new("frame", 3), Axis::new("frame", 3));
    let x = Tensor::data("x", Shape::new(&[&first], 1));
    let wider = x.broadcast_to(&Axes::new([first.clone(), second.clone()]));
    assert!(message(&wider).contains("two different axes are called `frame`"));
    assert!(message(&Tensor::data("y", Shape::new(&[&first, &second], 1))).contains("two different axes"));
    // Of one name, which is along two axes of one name.
    let y = Tensor::data("x", Shape::new(&[&second], 1));
    let outputs = vec![("x".to_string(), total(&x)), ("y".to_string(), total(&y))];
    let text = Step { outputs, updates: vec![] }.check().expect_err("refused").to_string();
    assert!(text.contains("along other axes of the same names"), "{text}");
}

#[test]
fn central_differences_of_what_is_not_there() {
    let row = Axis::new("row", 3);
    let (x, n) = (Tensor::data("x", Shape::new(&[&row], 1)), Tensor::index(&row));
    let mut bound = Bindings::from([("x".to_string(), Array::floats(x.shape(), vec![1.0, 2.0, 3.0]))]);
    bound.insert("n".into(), Array::integers(n.shape(), vec![0, 1, 2]));
    let refused = |output: &Tensor, name: &str, direction: &Direction, part: &str| {
        let text = central_difference(output, &bound, name, direction, 1e-3).expect_err("refused").to_string();
        assert!(text.contains(name) && text.contains(part), "{text}");
    };
    refused(&x, "y", &Direction::Lane(0), "no input of that name");
    refused(&x, "x", &Direction::Lane(3), "no lane 3");
    refused(&x, "x", &Direction::Along(&[1.0]), "the direction has 1 numbers");
    refused(&x, "n", &Direction::Lane(0), "u32");
    refused(&x.to_u32(), "x", &Direction::Lane(0), "whole numbers");
    assert_eq!(central_difference(&(&x * 2.0), &bound, "x", &Direction::Lane(2), 0.5).ok(), Some(2.0));
}

#[test]
fn sizes_that_cannot_be() {
    let none = Axis::new("none", 0);
    assert!(message(&Tensor::index(&none)).contains("index: [none=0] x 1 u32 is empty"));
    let x = Tensor::data("x", Shape::new(&[], 1));
    assert!(message(&x.broadcast_to(&Axes::new([none]))).contains("[none=0] x 1 is empty"));
    let huge = ["a", "b", "c"].map(|n| Tensor::index(&Axis::new(n, 1 << 21)).to_f32());
    let text = message(&(&huge[0] * &huge[1] * &huge[2]));
    assert!(text.contains("is larger than any memory"), "{text}");
}

#[test]
fn gradient_rules_that_leave_out_an_operand() {
    let (x, y) = (Tensor::parameter("x", Shape::new(&[], 1)), Tensor::parameter("y", Shape::new(&[], 1)));
    let value = custom_adjoint(&(&x * &y), &[&x, &y], |x, g| vec![Some(g * &x[1])]);
    let here = at!(1);
    let text = message(&grad(&value, &[&x])[0]);
    assert!(text.contains("custom_adjoint: 2 gradients for 3 operands") && text.contains(&here), "{text}");
}

#[test]
fn steps_name_the_users_lines() {
    let axis = Axis::new("row", 70_000);
    let x = Tensor::parameter("x", Shape::new(&[], 1));
    let (of_x, data) = (at!(1), Tensor::data("x", Shape::new(&[], 1)));
    let of_data = at!(1);
    let twice = &x * 2.0;
    let of_twice = at!(1);
    let wide = Tensor::constant(&[1.0, 2.0]);
    let of_wide = at!(1);
    let squares = &Tensor::index(&axis).to_f32() * &Tensor::index(&Axis::new("column", 70_000)).to_f32();
    let of_squares = at!(1);
    let total = squares.sum_over(squares.axes());
    let step = |outputs: &[&Tensor], updates: &[(&Tensor, &Tensor)]| Step {
        outputs: outputs.iter().enumerate().map(|(i, t)| (i.to_string(), (*t).clone())).collect(),
        updates: updates.iter().map(|(a, b)| ((*a).clone(), (*b).clone())).collect(),
    };
    let gpu = Target::gpu();
    for (step, expected) in [
        (step(&[&x, &data], &[]), vec!["Parameter [] x 1", "Data [] x 1", &of_x, &of_data]),
        (step(&[], &[(&twice, &x)]), vec!["found `mul`", &of_twice]),
        (step(&[], &[(&x, &wide)]), vec!["is [] x 2, expected [] x 1", &of_wide]),
        (step(&[], &[(&x, &twice), (&x, &twice)]), vec!["two updates of `x`", &of_x, &of_twice]),
        (step(&[&total], &[]), vec!["[row=70000, column=70000]", "counts to 4294967295", &of_squares]),
    ] {
        let text = compile(&step, &gpu).expect_err("refused").to_string();
        assert!(expected.iter().all(|e| text.contains(e)), "{text}: {expected:?}");
    }
    assert!(compile(&step(&[&total], &[]), &Target::cpu()).is_ok());
}

#[test]
fn an_error_travels_to_whatever_is_computed_from_it() {
    let x = Tensor::parameter("x", Shape::new(&[], 4));
    let bad = x.ch(7);
    let later = (&bad * 2.0).sin().sum_channels();
    assert_eq!(message(&later), message(&bad));
    assert_eq!(message(&grad(&later, &[&x])[0]), message(&bad));
    match evaluate(&[later], &Bindings::new()) {
        Err(EvalError::Record(e)) => assert_eq!(e.to_string(), message(&bad)),
        other => panic!("evaluated to {other:?}"),
    }
}

#[test]
fn values_of_inputs() {
    let x = Tensor::parameter("x", Shape::new(&[], 4));
    let text = |b: &Bindings| evaluate(std::slice::from_ref(&x), b).expect_err("refused").to_string();
    assert_eq!(text(&Bindings::new()), "input `x` ([] x 4) has no value");
    let wrong = Bindings::from([("x".to_string(), Array::floats(&Shape::new(&[], 3), vec![0.0; 3]))]);
    assert_eq!(text(&wrong), "input `x` is [] x 4, but the value given is [] x 3");
}
