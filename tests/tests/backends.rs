//! Every op on every backend against the f64 reference: value, first and second derivatives, mid-graph.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::ops::registry;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};
use raygrad_runtime::{Device, Session};
use raygrad_tests::backend::{compare, devices};
use raygrad_tests::{MidGraph, total};

/// Value, gradients, and the gradient of the gradients' squares.
fn step(graph: &MidGraph, differentiable: bool) -> Step {
    let mut outputs = vec![("value".to_string(), graph.output.clone())];
    if differentiable {
        let wanted: Vec<_> = graph.parameters.iter().collect();
        let first = grad(&graph.loss, &wanted);
        let squares = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b);
        outputs.extend(first.iter().enumerate().map(|(i, g)| (format!("grad p{i}"), g.clone())));
        if let Some(squares) = squares {
            let second = grad(&squares, &wanted);
            outputs.extend(second.into_iter().enumerate().map(|(i, g)| (format!("second p{i}"), g)));
        }
    }
    Step { outputs, updates: vec![] }
}

fn every_op(device: &Device) {
    let mut failures = vec![];
    for sample in registry() {
        let graph = MidGraph::new(&sample);
        if let Err(e) = compare(device, &step(&graph, sample.differentiable), &graph.bindings, 2e-5) {
            failures.push(format!("{}: {e}", sample.name));
        }
    }
    assert!(failures.is_empty(), "{} ops fail\n{}", failures.len(), failures.join("\n\n"));
}

#[test]
fn every_op_on_the_cpu() {
    every_op(&Device::cpu(Some(2)).unwrap());
}

/// Lanes of `y` on every device, of an `x` with as many channels as there are values.
fn on_every_device(axes: &[&Axis], x: &[f32], y: impl Fn(&Tensor) -> Tensor) -> Vec<(String, Vec<f32>)> {
    let run = |device: Device| {
        let elements: usize = axes.iter().map(|a| a.size()).product();
        let input = Tensor::data("x", Shape::new(axes, x.len() / elements));
        let step = Step { outputs: vec![("y".into(), y(&input))], updates: vec![] };
        let (name, program) = (device.name(), compile(&step, &device.target()).unwrap());
        let mut session = Session::new(device).unwrap();
        let id = session.add(program).unwrap();
        session.set("x", x).unwrap();
        session.run(id).unwrap();
        (name, session.read(id, "y").unwrap())
    };
    devices().into_iter().map(run).collect()
}

/// Signs of zeros, infinities, values past half the largest, and NaN: all devices agree with the CPU, and that with the reference.
#[test]
fn functions_at_their_edges() {
    const X: [f32; 12] =
        [0.0, -0.0, 1.0, -2.5, 1e-30, -1e-30, 3e38, -3e38, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 0.3];
    let row = Axis::new("row", X.len() * X.len());
    let pair = |i: usize| (X[i / X.len()], X[i % X.len()]);
    let pairs: Vec<f32> = (0..row.size()).flat_map(|i| [pair(i).0, pair(i).1]).collect();
    type Function<'f> = (&'f str, &'f dyn Fn(&Tensor) -> Tensor, fn(f32, f32) -> f32);
    let functions: [Function; 4] = [
        ("tanh", &|x| x.ch(0).tanh(), |x, _| x.tanh()),
        ("atan2", &|x| x.ch(0).atan2(&x.ch(1)), |y, x| if (y, x) == (0.0, 0.0) { y } else { y.atan2(x) }),
        ("sin", &|x| x.ch(0).sin(), |x, _| x.sin()),
        ("cos", &|x| x.ch(0).cos(), |x, _| x.cos()),
    ];
    let mut failures = vec![];
    for (name, function, expected) in functions {
        for (device, found) in on_every_device(&[&row], &pairs, function) {
            for (i, y) in found.into_iter().enumerate() {
                let (at, expected) = (pair(i), expected(pair(i).0, pair(i).1));
                let signed = name == "tanh" || name == "atan2";
                let signs = !signed || y.is_sign_negative() == expected.is_sign_negative();
                let same = match at.0.abs() {
                    // Of sines that far out, no digit is right.
                    3e38 if !signed => y.abs() < 1.001,
                    // What is infinite counts as the largest finite number.
                    a if name == "atan2" && a.max(at.1.abs()).is_infinite() && a.min(at.1.abs()) == 3e38 => signs,
                    _ => y.is_nan() && expected.is_nan() || (y - expected).abs() < 1e-6 && signs,
                };
                if !same {
                    failures.push(format!("{device}: {name} at {at:?} is {y}, not {expected}"));
                }
            }
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn the_largest_of_nothing_but_infinities_is_one() {
    for rows in [3, 64, 5000] {
        let (frame, row) = (Axis::new("frame", 2), Axis::new("row", rows));
        let mut x = vec![f32::NEG_INFINITY; 2 * rows];
        x[rows + 1] = -4.0;
        for (device, found) in on_every_device(&[&frame, &row], &x, |x| x.max_over(&[&row])) {
            assert_eq!(found, [f32::NEG_INFINITY, -4.0], "{device}, {rows} rows");
        }
    }
}

#[test]
fn inputs_are_set_part_by_part() {
    for device in devices() {
        let place = Axis::new("place", 7);
        let n = Tensor::data("n", Shape::new(&[&place], 1).with_dtype(DType::U32));
        let outputs = vec![("y".to_string(), n.wrapping_add(&Tensor::index(&place)))];
        let program = compile(&Step { outputs, updates: vec![] }, &device.target()).unwrap();
        let mut session = Session::new(device).unwrap();
        let id = session.add(program).unwrap();
        session.set_u32("n", &[10, 20, 30, 40, 50, 60, 70]).unwrap();
        session.set_u32_from("n", 2, &[1, 2, 3]).unwrap();
        session.set_u32_from("n", 6, &[4]).unwrap();
        session.run(id).unwrap();
        assert_eq!(session.read_lanes(id, "y").unwrap(), [10, 21, 3, 5, 7, 65, 10]);
    }
}

/// Bits of whole numbers are no floats.
#[test]
fn whole_numbers_are_read_as_such() {
    let row = Axis::new("row", 3);
    let n = Tensor::data("n", Shape::new(&[&row], 1).with_dtype(DType::U32));
    let step = Step { outputs: vec![("y".into(), n.wrapping_add(&Tensor::integers(&[2])))], updates: vec![] };
    for device in devices() {
        let mut session = Session::new(device.clone()).unwrap();
        let program = session.add(compile(&step, &device.target()).unwrap()).unwrap();
        session.set_u32("n", &[1, 5, 7]).unwrap();
        session.run(program).unwrap();
        for error in [session.read(program, "y").unwrap_err(), session.get("n").unwrap_err()] {
            assert!(error.to_string().contains("[row=3] x 1 u32: read its lanes"), "{error}");
        }
        assert_eq!(session.read_lanes(program, "y").unwrap(), [3, 7, 9]);
        assert_eq!(session.get_lanes("n").unwrap(), [1, 5, 7]);
    }
}
