//! Properties of the invertible warp: identity at the start, exact inverse, volume, rigid special case, known values.

use raygrad::config::{Anneal, Dof, Layered, Lift, WarpSettings};
use raygrad::data::initial_values;
use raygrad::training::optimise::STEP;
use raygrad::warps::{InvertibleWarp, Points, Registration, Warp};
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::matrix::{apply_affine, invert_pose};
use raygrad_compiler::graph::{Axes, Axis, Channels, Shape, Tensor};
use raygrad_compiler::ops::random;
use raygrad_compiler::reference::Array;
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, compile};
use raygrad_runtime::{Device, Session};
use raygrad_tests::vectors::Bound;
use raygrad_tests::{Rng, seed, total, worst};

/// Settings of the full network in space, changed by `set`.
fn settings(set: &[&str]) -> WarpSettings {
    let mut layered = Layered::load("planar-inn").expect("a preset");
    for text in ["warp.code=128"].iter().chain(set) {
        layered.set(text).unwrap_or_else(|e| panic!("{e}"));
    }
    WarpSettings { dof: Dof::Pose, ..layered.settings.warp }
}

/// A small network: code of 3, hidden width 4, 2 frequencies.
fn small(set: &[&str]) -> WarpSettings {
    settings(&[&["warp.code=3", "warp.inn.hidden=4", "warp.bands=2", "warp.inn.anneal_steps=10"], set].concat())
}

/// A warp with points, a code, and numbers for everything.
struct Bench {
    warp: InvertibleWarp,
    at: Points,
    points: Tensor,
    code: Tensor,
    bound: Bound,
}

impl Bench {
    /// `points` of each of `frames`, parameters as training starts or uniform, smaller than the given size.
    fn new(settings: &WarpSettings, frames: usize, points: usize, size: Option<f64>) -> Bench {
        let warp = InvertibleWarp::new(settings, None);
        let mut bound = Bound::default();
        let mut rng = Rng(seed("invertible"));
        let (frame, point) = (Axis::new("frame", frames), Axis::new("point", points));
        let mut random = |shape: &Shape, size: f64| rng.array(shape, -size, size).f().to_vec();
        for p in warp.parameters() {
            let values = match size {
                None => initial_values(&p, 3).into_iter().map(f64::from).collect(),
                Some(size) => random(p.tensor.shape(), size),
            };
            bound
                .bindings
                .insert(p.tensor.input_name().expect("a name").into(), Array::floats(p.tensor.shape(), values));
        }
        let axes = [&frame, &point];
        let n = warp.coordinates();
        let values = random(&Shape::new(&axes, n), 1.0);
        let points = bound.data("points", &axes, n, values);
        let width = warp.code_width();
        let values = random(&Shape::new(&[&frame], width), 1.0);
        let code = bound.data("code", &[&frame], width, values);
        bound.bindings.insert(STEP.into(), Array::integers(&Shape::new(&[], 1).with_dtype(DType::U32), vec![3]));
        Bench { warp, at: Points::planar(frame, point, points.clone()), points, code, bound }
    }

    fn forward(&self) -> Tensor {
        self.warp.forward(&self.at, &self.points, &self.code)
    }
}

#[test]
fn the_map_starts_as_the_identity() {
    for settings in [settings(&[]), WarpSettings { dof: Dof::Homography, ..settings(&[]) }] {
        let bench = Bench::new(&settings, 2, 50, None);
        let found = bench.bound.run(&[bench.forward(), bench.points.clone()]);
        assert_eq!(found[0], found[1]);
    }
}

#[test]
fn sizes_are_the_published_ones() {
    let warp = InvertibleWarp::new(&settings(&[]), None);
    let parameters = warp.parameters();
    let rows = |name: &str| {
        let p = parameters.iter().find(|p| p.tensor.input_name() == Some(name)).expect("a parameter");
        match p.tensor.channels() {
            Channels::Matrix(rows, columns) => (rows, columns),
            Channels::Vector(n) => (1, n),
        }
    };
    assert_eq!(rows("warp.0.a.hidden.direction"), (154, 128));
    assert_eq!(rows("warp.0.b.hidden.direction"), (141, 128));
    let of_block = |b: usize| {
        let prefix = format!("warp.{b}.");
        let own = parameters.iter().filter(|p| p.tensor.input_name().is_some_and(|n| n.starts_with(&prefix)));
        own.map(|p| p.tensor.shape().lanes()).sum::<usize>()
    };
    assert_eq!([0, 1, 2, 3].map(of_block), [55_300, 55_300, 55_300, 0]);
}

#[test]
fn the_inverse_is_exact() {
    for anneal in [Anneal::None, Anneal::Channels, Anneal::PointSlots] {
        for (dof, lift) in [(Dof::Pose, Lift::Plane), (Dof::Homography, Lift::Plane), (Dof::Rigid, Lift::Homogeneous)] {
            let mut settings = WarpSettings { dof, ..small(&["warp.inn.blocks=7"]) };
            (settings.inn.anneal, settings.inn.lift) = (anneal, lift);
            let bench = Bench::new(&settings, 2, 30, Some(0.7));
            let y = bench.forward();
            let back = bench.warp.inverse(&bench.at, &y, &bench.code);
            let found = bench.bound.run(&[y, bench.points.clone(), back]);
            assert!(worst(&found[0], &found[1], 1.0) > 0.1, "{anneal:?} {lift:?}: nothing moves");
            assert!(worst(&found[2], &found[1], 1.0) < 1e-12, "{anneal:?} {lift:?}");
        }
    }
}

/// In single precision, at the published size, with weights of the size that training leaves.
#[test]
fn the_inverse_of_a_million_points() {
    const POINTS: usize = 50_000;
    let settings = settings(&["warp.inn.anneal=channels", "warp.inn.anneal_steps=10"]);
    let warp = InvertibleWarp::new(&settings, None);
    let (frame, point) = (Axis::new("frame", 2), Axis::new("point", POINTS));
    let axes = Axes::new([frame.clone(), point.clone()]);
    let run = Tensor::per_step("run", Shape::new(&[], 1).with_dtype(DType::U32));
    let x = random::uniform(&axes, 3, 1, &run) * 4.0 - 2.0;
    let code = Tensor::data("code", Shape::new(&[&frame], 128));
    let at = Points::planar(frame, point, x.clone());
    let y = warp.forward(&at, &x, &code);
    let largest = |t: &Tensor| t.abs().max_channels().max_over(&axes.iter().collect::<Vec<_>>());
    let outputs = [("moved", largest(&(&y - &x))), ("off", largest(&(warp.inverse(&at, &y, &code) - &x)))];
    let step = Step { outputs: outputs.map(|(name, t)| (name.to_string(), t)).to_vec(), updates: vec![] };
    let device = Device::cpu(Some(2)).expect("starts threads");
    let program = compile(&step, &device.target()).unwrap_or_else(|e| panic!("{e}"));
    let mut session = Session::new(device).expect("opens");
    let id = session.add(program).expect("loads");
    let mut rng = Rng(seed("a million points"));
    let mut draw = |n: usize, size: f64| (0..n).map(|_| rng.uniform(-size, size) as f32).collect::<Vec<_>>();
    for p in warp.parameters() {
        let (name, start) = (p.tensor.input_name().expect("a name"), initial_values(&p, 3));
        let moved = draw(start.len(), 0.1);
        let values: Vec<f32> = start.iter().zip(moved).map(|(a, b)| a + b).collect();
        session.set(name, &values).unwrap_or_else(|e| panic!("{e}"));
    }
    session.set("code", &draw(2 * 128, 1.0)).expect("sets");
    for i in 0..10 {
        session.set_u32("run", &[i]).expect("sets");
        session.set_u32(STEP, &[i]).expect("sets");
        session.run(id).unwrap_or_else(|e| panic!("{e}"));
        let [moved, off] = ["moved", "off"].map(|name| session.read(id, name).unwrap_or_else(|e| panic!("{e}"))[0]);
        assert!(moved > 0.1 && moved.is_finite(), "run {i}: the largest move is {moved}");
        assert!(off <= 1e-5, "run {i}: off by {off}");
    }
}

#[test]
fn volumes_stay() {
    let bench = Bench::new(&small(&["warp.inn.blocks=4"]), 1, 5, Some(0.7));
    let y = bench.forward();
    let slopes: Vec<Tensor> = (0..3).map(|c| grad(&total(&y.ch(c)), &[&bench.points]).remove(0)).collect();
    let rows = bench.bound.run(&slopes);
    for i in 0..5 {
        let [a, b, c] = [0, 1, 2].map(|r| &rows[r][3 * i..3 * i + 3]);
        let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
        let volume: f64 = a.iter().zip(cross).map(|(x, y)| x * y).sum();
        assert!((volume - 1.0).abs() < 1e-10, "{volume}");
    }
}

/// Networks that put out constants move space rigidly: Rx(-theta2) Ry(theta1) Rz(-theta0), and the fit finds its inverse.
#[test]
fn constant_networks_are_rigid() {
    let mut bench = Bench::new(&small(&[]), 1, 40, Some(0.7));
    let mut angles = [0.0; 3];
    for p in bench.warp.parameters() {
        let name = p.tensor.input_name().expect("a name").to_string();
        let values = bench.bound.bindings.get_mut(&name).expect("a value").f_mut();
        if name.ends_with("out.weight") {
            values.fill(0.0);
        }
        if let Some(block) = name.strip_suffix(".b.out.bias").and_then(|n| n.strip_prefix("warp.")) {
            angles[block.parse::<usize>().expect("a number")] = values[0];
        }
    }
    let found = Registration::new(&bench.warp, &bench.at, None, &bench.code, false);
    let residual = found.residual.expect("a fitted warp has a residual");
    let world = apply_affine(&invert_pose(&found.transform), &bench.points);
    let values = bench.bound.run(&[residual, found.local, world, invert_pose(&found.transform)]);
    assert!(values[0][0] < 1e-10, "{}", values[0][0]);
    assert!(worst(&values[1], &values[2], 1.0) < 1e-9);
    let turn = |axis: usize, angle: f64| {
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut m = [[0.0; 3]; 3];
        (m[axis][axis], m[i][i], m[j][j]) = (1.0, angle.cos(), angle.cos());
        (m[i][j], m[j][i]) = (-angle.sin(), angle.sin());
        m
    };
    let product = |a: [[f64; 3]; 3], b: [[f64; 3]; 3]| {
        [0, 1, 2].map(|i| [0, 1, 2].map(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum::<f64>()))
    };
    let expected = product(turn(0, -angles[2]), product(turn(1, angles[1]), turn(2, -angles[0])));
    let rows: Vec<f64> = values[3].chunks(4).flat_map(|r| r[..3].to_vec()).collect();
    assert!(worst(&rows, &expected.concat(), 1.0) < 1e-9, "{rows:?}, not {expected:?}");
}

/// The prior's gradient leaves the fit out, because the fit minimises the prior: the whole gradient is the same.
#[test]
fn the_gradient_through_the_fit_is_zero() {
    let bench = Bench::new(&small(&[]), 2, 20, Some(0.5));
    let found = Registration::new(&bench.warp, &bench.at, None, &bench.code, false);
    let composed = mean_squared_error(&found.local, &found.global);
    let parameters: Vec<Tensor> = bench.warp.parameters().into_iter().map(|p| p.tensor).collect();
    let wanted: Vec<&Tensor> = parameters.iter().collect();
    let residual = found.residual.expect("a fitted warp has a residual");
    let short = bench.bound.run(&grad(&residual, &wanted));
    let whole = bench.bound.run(&grad(&composed, &wanted));
    for (p, (short, whole)) in parameters.iter().zip(short.iter().zip(&whole)) {
        assert!(worst(short, whole, 1e-6) < 1e-9, "{:?}", p.input_name());
    }
}

/// The specification's known values: weights by sines and cosines, lengths those of the directions.
#[test]
fn known_values() {
    let fill = |rows: usize, columns: usize, c: f64, s: f64| -> Vec<f64> {
        // `[out, in]`, as the rule counts.
        (0..rows * columns).map(|n| s * (0.7 * n as f64 + c).sin()).collect()
    };
    let expected = [
        ("none", [-0.6608778682, 0.5763468092, 0.2788638855, 0.0577217613, 1.0424933440, 1.1743754702]),
        ("channels", [-0.5242700445, 0.5543544683, 0.2986064046, 0.1214643425, 0.4954845225, 1.3905002788]),
    ];
    for (anneal, expected) in expected {
        let anneal = format!("warp.inn.anneal={anneal}");
        let mut bench = Bench::new(&small(&[&anneal]), 1, 2, Some(0.5));
        for p in bench.warp.parameters() {
            let name = p.tensor.input_name().expect("a name").to_string();
            let parts: Vec<&str> = name.split('.').collect();
            let block: f64 = parts[1].parse().expect("a number");
            let (shift, scale) = match (parts[2], parts[3]) {
                ("code", _) => (1.0, 0.1),
                ("a", "hidden") => (2.0, 0.3),
                ("a", _) => (3.0, 0.3),
                (_, "hidden") => (4.0, 0.3),
                _ => (5.0, 0.3),
            };
            let c = block + shift;
            let inputs = if parts[2] == "a" { 13 } else { 8 };
            let values = match (p.tensor.channels(), *parts.last().expect("a name")) {
                (Channels::Matrix(i, o), _) => fill(o, i, c, scale),
                (_, "length") => {
                    let matrix = fill(4, inputs, c, scale);
                    matrix.chunks(inputs).map(|r| r.iter().map(|v| v * v).sum::<f64>().sqrt()).collect()
                }
                (Channels::Vector(n), _) => (0..n).map(|i| scale * (0.9 * i as f64 + c).cos()).collect(),
            };
            bench.bound.fill(&p.tensor, &values);
        }
        bench.bound.fill(&bench.points, &[0.0, 0.0, 0.0, 0.3, -0.2, 1.0]);
        bench.bound.fill(&bench.code, &[0.5, -0.25, 1.0]);
        let found = bench.bound.run(&[bench.forward()]);
        assert!(worst(&found[0], &expected, 1.0) < 1e-9, "{anneal}: {:?}", found[0]);
    }
}
