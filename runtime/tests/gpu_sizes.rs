//! The backends for GPUs at sizes that need several workgroups, chunks, ragged tiles, and many steps.
//!
//! One file above 400 lines: the list at its end runs every test on both backends.

#![cfg(feature = "gpu")]

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, compile};
use raygrad_kernels::gpu::{Half, Limits};
use raygrad_runtime::{Device, Forms, Precision, ProgramId, Session};
use raygrad_tests::backend::compare;
use raygrad_tests::{Rng, seed, total};

/// Binds every input of `step` to seeded numbers.
fn bind(step: &Step, what: &str) -> Bindings {
    let mut rng = Rng(seed(what));
    let all = raygrad_compiler::graph::topological(step.roots());
    let inputs = all.iter().filter_map(|t| t.input_name().map(|n| (n.to_string(), t.shape().clone())));
    inputs
        .map(|(name, shape)| {
            let array = match shape.dtype {
                DType::F32 => rng.array(&shape, -1.0, 1.0),
                DType::U32 => Array::integers(&shape, (0..shape.lanes()).map(|_| rng.bits() as u32 % 32).collect()),
            };
            (name, array)
        })
        .collect()
}

fn check(device: &Device, outputs: Vec<(&str, Tensor)>, tolerance: f64, what: &str) {
    let outputs = outputs.into_iter().map(|(n, t)| (n.to_string(), t)).collect();
    let step = Step { outputs, updates: vec![] };
    let bindings = bind(&step, what);
    if let Err(e) = compare(device, &step, &bindings, tolerance) {
        panic!("{what}: {e}");
    }
}

/// A layer with bias and activation, its result and all gradients.
fn layer(device: &Device, frames: usize, rows: usize, inputs: usize, outputs: usize, per_frame: bool) {
    let (outputs_of, what) = layer_outputs(frames, rows, inputs, outputs, per_frame);
    check(device, outputs_of, 2e-5, &what);
}

type Outputs = Vec<(&'static str, Tensor)>;

fn layer_outputs(frames: usize, rows: usize, inputs: usize, outputs: usize, per_frame: bool) -> (Outputs, String) {
    let (frame, row) = (Axis::new("frame", frames), Axis::new("row", rows));
    let own: &[&Axis] = if per_frame { &[&frame] } else { &[] };
    let x = Tensor::data("x", Shape::new(&[&frame, &row], inputs));
    let w = Tensor::parameter("w", Shape::new(own, (inputs, outputs)));
    let b = Tensor::parameter("b", Shape::new(own, outputs));
    let y = (x.linear(&w) + &b).softplus(1.0);
    let up = Tensor::data("up", y.shape().clone());
    let loss = total(&(&y * up));
    let gradients = grad(&loss, &[&x, &w, &b]);
    let outputs_of =
        vec![("y", y), ("dx", gradients[0].clone()), ("dw", gradients[1].clone()), ("db", gradients[2].clone())];
    (outputs_of, format!("layer {frames}x{rows}, {inputs} to {outputs}, per frame: {per_frame}"))
}

fn layers_of_all_widths(device: &Device) {
    for (inputs, outputs) in [(2, 1), (3, 4), (5, 7), (16, 12), (34, 64), (64, 64), (64, 3), (70, 33), (130, 66)] {
        layer(device, 2, 333, inputs, outputs, false);
    }
    layer(device, 3, 100, 20, 40, true);
    layer(device, 1, 4096, 8, 8, false);
    layer(device, 5, 1, 64, 128, true);
    // The largest tiles, and a column that they leave over: as one of many, and where rows are many, in a kernel of its own.
    layer(device, 2, 4100, 40, 257, false);
    layer(device, 1, 8205, 130, 40, false);
    layer(device, 1, 40_000, 36, 65, false);
    layer(device, 1, 40_004, 65, 36, false);
}

/// What a layer's kernel combines over all rows itself, of a value that it writes and of one that it does not.
fn layer_totals(rows: usize, inputs: usize, outputs: usize) -> Outputs {
    let row = Axis::new("row", rows);
    let x = Tensor::data("x", Shape::new(&[&row], inputs));
    let w = Tensor::parameter("w", Shape::new(&[], (inputs, outputs)));
    let b = Tensor::parameter("b", Shape::new(&[], outputs));
    let y = x.linear(&w) * (1.0 / inputs as f64) + &b;
    let wave = y.sin();
    let mean = wave.sum(&[&row]) * (1.0 / rows as f64);
    vec![("mean", mean), ("largest", y.max_over(&[&row])), ("wave", wave)]
}

fn totals_of_layers(device: &Device) {
    // Narrow layers are summed by kernels of their own, and so are columns that a kernel of their own computes (the last).
    for (rows, inputs, outputs) in
        [(333, 34, 192), (1027, 20, 100), (4099, 70, 128), (5, 3, 66), (999, 30, 130), (50, 6, 3), (12_000, 300, 65)]
    {
        check(device, layer_totals(rows, inputs, outputs), 2e-5, &format!("totals of {rows}, {inputs} to {outputs}"));
    }
}

/// A network's result and all gradients, so that what lies between layers is stored.
fn network_outputs(rows: usize, widths: [usize; 4]) -> Outputs {
    let row = Axis::new("row", rows);
    let x = Tensor::parameter("x", Shape::new(&[&row], widths[0]));
    let weight = |i: usize| Tensor::parameter(format!("w{i}"), Shape::new(&[], (widths[i], widths[i + 1])));
    let bias = |i: usize| Tensor::parameter(format!("b{i}"), Shape::new(&[], widths[i + 1]));
    let parameters = [x.clone(), weight(0), bias(0), weight(1), bias(1), weight(2)];
    let [_, w0, b0, w1, b1, w2] = &parameters;
    let hidden = (x.linear(w0) + b0).softplus(1.0).linear(w1) * 0.1 + b1;
    let y = hidden.sin().linear(w2);
    let up = Tensor::data("up", y.shape().clone());
    let gradients = grad(&total(&(&y * up)), &parameters.iter().collect::<Vec<_>>());
    let names = ["dx", "dw0", "db0", "dw1", "db1", "dw2"];
    [vec![("y", y)], names.into_iter().zip(gradients).collect()].concat()
}

/// So many elements that an invocation takes four: channels by number and by index, values that broadcast, integers, and an
/// update in place.
fn elements_four_at_a_time(device: &Device) {
    // Four neighbours are in one row of a frame, or not.
    for (frames, rows) in [(4, 16_501), (3, 22_000)] {
        let (frame, row) = (Axis::new("frame", frames), Axis::new("row", rows));
        let x = Tensor::parameter("x", Shape::new(&[&frame, &row], 2));
        let code = Tensor::parameter("code", Shape::new(&[&frame], 90));
        let y = Tensor::data("y", Shape::new(&[&row], 1));
        let wide = concat([&x, &code, &y]).sin();
        let mask = x.less_than(&y);
        let number = Tensor::index(&row).wrapping_add(&Tensor::index(&frame));
        let outputs =
            vec![("wide", wide), ("mask", mask.clone()), ("chosen", mask.select(&x, &(&x * &y))), ("number", number)];
        check(device, outputs, 1e-5, &format!("{frames} by {rows}, four elements at a time"));
    }
    let (frame, row) = (Axis::new("frame", 3), Axis::new("row", 22_000));
    let (x, y) = (Tensor::parameter("x", Shape::new(&[&frame, &row], 2)), Tensor::data("y", Shape::new(&[&row], 1)));
    let double = Step { outputs: vec![], updates: vec![(x.clone(), &x * 2.0 + &y)] };
    let mut session = Session::new(device.clone()).unwrap();
    let id = session.add(compile(&double, &device.target()).unwrap()).unwrap();
    let values: Vec<f32> = (0..2 * 66000).map(|i| i as f32).collect();
    session.set("x", &values).unwrap();
    session.set("y", &vec![1.0; 22000]).unwrap();
    session.run(id).unwrap();
    assert!(session.get("x").unwrap() == values.iter().map(|v| 2.0 * v + 1.0).collect::<Vec<_>>());
}

/// A layer whose values and their neighbours in a concatenation go to memory for the next layer.
fn concatenations_of_layers(device: &Device) {
    for (rows, hidden, inputs, relu) in
        [(400, 64, 7, false), (333, 68, 5, false), (333, 68, 5, true), (333, 65, 5, true)]
    {
        let row = Axis::new("row", rows);
        let x = Tensor::parameter("x", Shape::new(&[&row], inputs));
        let w = Tensor::parameter("w", Shape::new(&[], (inputs, hidden)));
        let v = Tensor::parameter("v", Shape::new(&[], (hidden + inputs, 9)));
        let layer = x.linear(&w);
        // What the gradient of a rectifier needs is read back from the concatenation.
        let both = if relu { concat([&x, &layer.relu()]) } else { concat([&layer.softplus(1.0), &x]) };
        let y = both.linear(&v).sin();
        let up = Tensor::data("up", y.shape().clone());
        let gradients = grad(&total(&(&y * up)), &[&x, &w, &v]);
        let outputs = [vec![("y", y)], ["dx", "dw", "dv"].into_iter().zip(gradients).collect()].concat();
        check(device, outputs, 2e-5, &format!("{inputs} and {hidden} channels of {rows} rows, relu: {relu}"));
    }
}

/// Tiles for drivers in software in all places of a layer, whole and ragged; with `RAYGRAD_NIGHTLY=1` in all of the other tests,
/// whose kernels take such a driver minutes to compile.
fn tiles_of_software(device: &Device) {
    if raygrad_tests::backend::nightly() {
        [layers_of_all_widths, totals_of_layers, concatenations_of_layers, halves].iter().for_each(|test| test(device));
    }
    layer(device, 2, 333, 34, 64, false);
    layer(device, 3, 40, 21, 50, true);
    // More rows than a workgroup has, and so few that it has more columns than invocations.
    for rows in [300, 100, 30] {
        check(device, layer_totals(rows, 34, 100), 2e-5, &format!("totals of {rows}, 34 to 100"));
    }
    if device.has_half().is_some() {
        let device = device.clone().with_half(Some(Half { matrices: None }));
        check(&device, layer_outputs(1, 200, 20, 36, false).0, 3e-3, "halves");
    } else {
        println!("halves skipped: {} has no half precision", device.name());
    }
}

/// Everything that mixed precision has here: storing halves, and multiplying matrices of them. The drivers that distributions
/// install have no matrices; newer ones (Mesa 26) and GPUs have.
fn halves(device: &Device) {
    let Some(half) = device.has_half() else {
        // Nothing requires halves of a device; those that tests run on anywhere store them.
        println!("skipped: {} has no half precision", device.name());
        return;
    };
    let mut variants = vec![Half { matrices: None }];
    if half.matrices.is_some() {
        let mixed = device.clone().with_precision(Precision::Mixed).unwrap();
        assert_eq!(mixed.half(), Some(half), "cooperative matrices fail their test");
        variants.push(half);
    }
    for half in variants {
        println!("{}: {half:?}", device.name());
        let device = device.clone().with_half(Some(half));
        // Halves have 11 bits; of hundreds of products, some errors add up.
        let all =
            [(2, 333, 34, 64, false), (2, 4100, 72, 257, false), (3, 100, 70, 40, true), (1, 1027, 257, 65, false)];
        // With matrices weights of many rows are made halves first, the tiles are the largest, and the gradient of weights counts
        // inputs along m where that pads less.
        let many = half.matrices.map_or(vec![], |_| vec![(1, 16388, 36, 136, false), (1, 4100, 290, 200, false)]);
        for (frames, rows, inputs, outputs, per_frame) in all.into_iter().chain(many) {
            let (outputs, what) = layer_outputs(frames, rows, inputs, outputs, per_frame);
            check(&device, outputs, 3e-3, &format!("{what}, {half:?}"));
        }
        for (rows, inputs, outputs) in [(1027, 34, 128), (1600, 40, 300)] {
            let what = format!("totals of {rows}, {inputs} to {outputs}, {half:?}");
            check(&device, layer_totals(rows, inputs, outputs), 3e-3, &what);
        }
        for (rows, widths) in [(333, [20, 40, 70, 3]), (4400, [63, 256, 128, 4])] {
            check(&device, network_outputs(rows, widths), 6e-3, &format!("network {widths:?} of {rows}, {half:?}"));
        }
    }
}

fn reductions_of_all_sizes(device: &Device) {
    for (a, b) in [(1, 5000), (3, 70000), (5000, 7), (300, 300), (1, 1), (20000, 2)] {
        let (outer, inner) = (Axis::new("outer", a), Axis::new("inner", b));
        let x = Tensor::data("x", Shape::new(&[&outer, &inner], 3));
        let y = x.sin();
        let mean = |t: Tensor, n: usize| t * (1.0 / n as f64);
        let outputs = vec![
            ("inner", mean(y.sum(&[&inner]), b)),
            ("outer", mean(y.sum(&[&outer]), a)),
            ("all", mean(total(&y), a * b)),
            ("max", y.max_over(&[&outer, &inner])),
            ("max of channels", y.max_channels().max_over(&[&inner])),
        ];
        check(device, outputs, 2e-5, &format!("reductions of {a} by {b}"));
    }
    let row = Axis::new("row", 3000);
    let wide = Tensor::data("x", Shape::new(&[&row], 100));
    let outputs = vec![("wide", wide.sin().sum(&[&row]) * (1.0 / 3000.0)), ("channels", wide.cos().sum_channels())];
    check(device, outputs, 2e-5, "reductions of 100 channels");
}

fn gathers_and_scatters(device: &Device) {
    for (slots, rows, channels) in [(5, 3000, 1), (32, 40000, 3), (4, 700, 20), (2000, 5000, 2)] {
        let (slot, row) = (Axis::new("slot", slots), Axis::new("row", rows));
        let table = Tensor::parameter("table", Shape::new(&[&slot], channels));
        let index = Tensor::data("index", Shape::new(&[&row], 1).with_dtype(DType::U32));
        let y = table.take(&index, &slot).sin();
        let up = Tensor::data("up", y.shape().clone());
        let g = grad(&total(&(&y * up)), &[&table]);
        check(device, vec![("y", y), ("dt", g[0].clone())], 2e-5, &format!("{rows} rows of {slots} x {channels}"));
    }
}

/// Entries of a few units in the fifth place turn eigenvectors far where eigenvalues lie as close.
fn eigenvectors_of_close_eigenvalues(device: &Device) {
    let row = Axis::new("row", 40);
    let small = Tensor::data("small", Shape::new(&[&row], 16)) * 2e-5;
    let mut diagonal = [0.0; 16];
    (diagonal[0], diagonal[5], diagonal[10], diagonal[15]) = (1.0, 1.0001, 2.0, 3.0);
    let (values, vectors) = (small + Tensor::constant(&diagonal)).reshape((4, 4)).sym_eig();
    check(device, vec![("values", values), ("vectors", vectors)], 5e-3, "close eigenvalues");
}

fn compositing(device: &Device) {
    let (ray, sample) = (Axis::new("ray", 500), Axis::new("sample", 40));
    let density = Tensor::parameter("density", Shape::new(&[&ray, &sample], 1));
    let colour = Tensor::parameter("colour", Shape::new(&[&ray, &sample], 3));
    let optical = density.softplus(1.0) * 0.1;
    let transmittance = (-optical.cumsum(&sample)).exp();
    let weights = transmittance * (1.0 - (-&optical).exp());
    let pixel = (&weights * colour.sigmoid()).sum(&[&sample]);
    let opacity = weights.sum(&[&sample]);
    let target = Tensor::data("target", Shape::new(&[&ray], 3));
    let difference = &pixel - target;
    let smooth = &weights - weights.shift(&sample, 1);
    let loss = (&difference * &difference).mean_all() + (&smooth * &smooth).mean_all();
    let g = grad(&loss, &[&density, &colour]);
    let outputs = vec![
        ("pixel", pixel),
        ("opacity", opacity),
        ("weights", weights),
        ("loss", loss),
        ("d density", g[0].clone()),
        ("d colour", g[1].clone()),
    ];
    check(device, outputs, 2e-5, "compositing");
}

/// A network of three layers that learns a function by Adam: one step as a graph.
struct Training {
    step: Step,
    initial: Bindings,
    adam: Adam,
}

impl Training {
    fn new() -> Training {
        let row = Axis::new("row", 1000);
        let x = Tensor::data("x", Shape::new(&[&row], 2));
        let target = Tensor::data("target", Shape::new(&[&row], 3));
        let widths = [2, 64, 64, 3];
        let (mut h, mut parameters) = (x.clone(), vec![]);
        for i in 0..3 {
            let w = Tensor::parameter(format!("w{i}"), Shape::new(&[], (widths[i], widths[i + 1])));
            let b = Tensor::parameter(format!("b{i}"), Shape::new(&[], widths[i + 1]));
            h = h.linear(&w) + &b;
            h = if i < 2 { h.relu() } else { h.sigmoid() };
            parameters.extend([w, b]);
        }
        let difference = &h - target;
        let loss = (&difference * &difference).mean_all();
        let gradients = grad(&loss, &parameters.iter().collect::<Vec<_>>());
        let scalar = |name: &str| Tensor::per_step(name, Shape::new(&[], 1));
        let scalars = StepScalars { lr: scalar("lr"), bias1: scalar("bias1"), bias2: scalar("bias2") };
        let adam = Adam::default();
        let mut updates = vec![];
        for (p, g) in parameters.iter().zip(&gradients) {
            let old = Moments::of(p);
            let (new, moments) = adam.update(p, g, &old, &scalars);
            updates.extend([(p.clone(), new), (old.m, moments.m), (old.v, moments.v)]);
        }
        let step = Step { outputs: vec![("loss".into(), loss)], updates };
        let mut initial = bind(&step, "training");
        for (name, array) in &mut initial {
            if name.starts_with("adam") {
                array.f_mut().fill(0.0);
            } else if name.starts_with('w') {
                let wide = if name == "w0" { 1.0 } else { 0.2 };
                array.f_mut().iter_mut().for_each(|x| *x = (*x * wide) as f32 as f64);
            } else {
                array.f_mut().iter_mut().for_each(|x| *x = *x as f32 as f64);
            }
        }
        Training { step, initial, adam }
    }

    fn scalars(&self, t: u64) -> [(&'static str, f64); 3] {
        let (bias1, bias2) = self.adam.bias_corrections(t);
        [("lr", 3e-3), ("bias1", bias1), ("bias2", bias2)]
    }

    fn on(&self, device: &Device) -> (Session, ProgramId) {
        let program = compile(&self.step, &device.target()).unwrap();
        let mut session = Session::new(device.clone()).unwrap();
        let id = session.add(program).unwrap();
        for (name, array) in &self.initial {
            session.set(name, &array.f().iter().map(|x| *x as f32).collect::<Vec<_>>()).unwrap();
        }
        (session, id)
    }

    /// Losses of some steps on a device, and the parameters after.
    fn train(&self, device: &Device, steps: u64) -> (Vec<f32>, Vec<u32>) {
        let (mut session, id) = self.on(device);
        let mut losses = vec![];
        for t in 1..=steps {
            for (name, value) in self.scalars(t) {
                session.set(name, &[value as f32]).unwrap();
            }
            session.run(id).unwrap();
            losses.extend(session.read(id, "loss").unwrap());
        }
        let names: Vec<String> = session.inputs().filter(|i| i.1.role == Role::Parameter).map(|i| i.0.into()).collect();
        (losses, names.iter().flat_map(|n| session.get_lanes(n).unwrap()).collect())
    }

    /// The same in f64.
    fn reference(&self, steps: u64) -> Vec<f64> {
        let mut bindings = self.initial.clone();
        let mut losses = vec![];
        for t in 1..=steps {
            for (name, value) in self.scalars(t) {
                bindings.insert(name.into(), Array::floats(&Shape::of(Axes::none(), 1, DType::F32), vec![value]));
            }
            let values = evaluate(&self.step.roots(), &bindings).unwrap();
            losses.push(values[0].f()[0]);
            for ((input, _), value) in self.step.updates.iter().zip(&values[1..]) {
                bindings.insert(input.input_name().unwrap().into(), value.clone());
            }
        }
        losses
    }
}

fn training_follows_the_reference_and_repeats_bit_by_bit(device: &Device) {
    let training = Training::new();
    let (losses, parameters) = training.train(device, 20);
    let expected = training.reference(20);
    for (t, (found, expected)) in losses.iter().zip(&expected).enumerate() {
        let error = (*found as f64 - expected).abs() / expected;
        assert!(error < 1e-4, "step {t}: {found} instead of {expected}\n{losses:?}\n{expected:?}");
    }
    assert!(losses[19] < 0.9 * losses[0], "{losses:?}");
    let (again, parameters_again) = training.train(device, 20);
    assert_eq!(losses, again);
    assert!(parameters == parameters_again, "the parameters differ in some bits");
}

fn two_programs_share_their_inputs(device: &Device) {
    let row = Axis::new("row", 10);
    let x = Tensor::parameter("x", Shape::new(&[&row], 2));
    let extra = Tensor::data("extra", Shape::new(&[&row], 1));
    let first = Step { outputs: vec![], updates: vec![(x.clone(), &x * 2.0)] };
    let second = Step { outputs: vec![("sum".into(), (&x + extra).sum(&[&row]))], updates: vec![] };
    let mut session = Session::new(device.clone()).unwrap();
    let first = session.add(compile(&first, &device.target()).unwrap()).unwrap();
    session.set("x", &[1.0; 20]).unwrap();
    let second = session.add(compile(&second, &device.target()).unwrap()).unwrap();
    session.set("extra", &[0.5; 10]).unwrap();
    session.run(first).unwrap();
    session.run(first).unwrap();
    session.run(second).unwrap();
    assert_eq!(session.read(second, "sum").unwrap(), [45.0, 45.0]);
    assert_eq!(session.get("x").unwrap(), [4.0; 20]);
}

/// The same adapter as if it could do no more.
fn within(device: &Device, most: Limits) -> Device {
    match device {
        Device::Cpu { .. } => device.clone(),
        #[cfg(feature = "wgpu")]
        Device::Wgpu { .. } => {
            let gpu = raygrad_runtime::wgpu::Gpu::open(None).unwrap().within(most);
            Device::Wgpu { gpu: gpu.into(), forms: device.forms() }
        }
        #[cfg(feature = "vulkan")]
        Device::Vulkan { .. } => {
            let gpu = raygrad_runtime::vulkan::Gpu::open(None).unwrap().within(most);
            Device::Vulkan { gpu: gpu.into(), forms: device.forms() }
        }
    }
}

/// A program that binds more buffers than the device has leaves nothing in its session: another one may have its inputs.
fn a_program_that_does_not_fit_leaves_nothing(device: &Device) {
    let device = within(device, Limits { max_buffers: 1, max_binding: u64::MAX, ..Limits::default() });
    let row = Axis::new("row", 10);
    let x = Tensor::parameter("x", Shape::new(&[&row], 2));
    let rate = Tensor::per_step("rate", Shape::new(&[], 1));
    let compiled = |step: &Step| compile(step, &device.target()).unwrap();
    let large = compiled(&Step { outputs: vec![("y".into(), &x * &rate)], updates: vec![] });
    let mut session = Session::new(device.clone()).unwrap();
    assert!(session.add(large).is_err());
    assert_eq!(session.inputs().count(), 0);
    assert!(session.set("x", &[1.0; 20]).is_err() && session.get("x").is_err() && session.set("rate", &[1.0]).is_err());
    let small = session.add(compiled(&Step { outputs: vec![], updates: vec![(x.clone(), &x * 2.0)] })).unwrap();
    session.set("x", &[1.5; 20]).unwrap();
    session.run(small).unwrap();
    assert_eq!(session.get("x").unwrap(), [3.0; 20]);
}

/// What is longer than is read at a time arrives whole.
fn long_inputs_are_read_back(device: &Device) {
    let x = Tensor::data("x", Shape::new(&[&Axis::new("row", (8 << 20) + 5)], 1));
    let step = Step { outputs: vec![("sum".into(), x.sum_over(x.axes()))], updates: vec![] };
    let mut session = Session::new(device.clone()).unwrap();
    session.add(compile(&step, &device.target()).unwrap()).unwrap();
    let values: Vec<f32> = (0..x.shape().lanes()).map(|i| i as f32).collect();
    session.set("x", &values).unwrap();
    assert!(session.get("x").unwrap() == values);
}

/// Inputs, temporaries, scratch memory and outputs of several parts, in every kind of kernel.
fn buffers_beyond_the_binding_limit(device: &Device) {
    let most = Limits { max_binding: 48 << 10, max_buffers: u32::MAX, ..Limits::default() };
    let device = &within(device, most);
    layer(device, 2, 320, 24, 40, false);
    let (frame, row, slot) = (Axis::new("frame", 3), Axis::new("row", 3000), Axis::new("slot", 32));
    let x = Tensor::parameter("x", Shape::new(&[&frame, &row], 4));
    let at = Tensor::data("at", Shape::new(&[&frame, &row], 1).with_dtype(DType::U32));
    let from = Tensor::data("from", Shape::new(&[&frame, &Axis::new("place", 3500)], 1).with_dtype(DType::U32));
    let summed = (x.sin() * &x).cumsum(&row);
    let outputs = vec![
        ("taken", x.take(&from, &row)),
        ("scattered", x.scatter(&at, &slot, &Axes::new([frame.clone()]))),
        ("summed", summed.clone()),
        ("sum", summed.mean(&[&row])),
        ("gradient", grad(&total(&(&summed * &summed * 1e-6)), &[&x]).remove(0)),
    ];
    check(device, outputs, 3e-5, "parts");
    // An update in place, twice, set and read back through the session.
    let double = Step { outputs: vec![], updates: vec![(x.clone(), &x * 2.0)] };
    let mut session = Session::new(device.clone()).unwrap();
    let id = session.add(compile(&double, &device.target()).unwrap()).unwrap();
    let values: Vec<f32> = (0..4 * 9000).map(|i| i as f32).collect();
    session.set("x", &values).unwrap();
    session.run(id).unwrap();
    session.run(id).unwrap();
    assert!(session.get("x").unwrap() == values.iter().map(|v| 4.0 * v).collect::<Vec<_>>());
}

/// Networks whose rows stay in a workgroup: where all they keep fits, where some of it or nothing does, and of halves in memory.
fn networks_in_workgroups(device: &Device) {
    let device = device.clone().with_forms(Forms { resident: 128, ..device.forms() });
    // Whole tiles, and ragged ones that do not even end with four rows.
    for (rows, own, sizes) in [(128, false, &[16 << 10][..]), (203, true, &[48 << 10, 3 << 10, 256])] {
        let (frame, row) = (Axis::new("frame", 2), Axis::new("row", rows));
        let p = |name: &str, axes: &[&Axis], size: (usize, usize)| Tensor::parameter(name, Shape::new(axes, size));
        let frames = [&frame];
        let x = Tensor::parameter("x", Shape::new(&[&frame, &row], 17));
        let (a, b) = (p("a", &[], (17, 24)), p("b", if own { &frames } else { &[] }, (24, 36)));
        let (c, d) = (p("c", &[], (53, 20)), p("d", &[], (20, 2)));
        let bias = Tensor::parameter("bias", Shape::new(&[], 24));
        let first = (x.linear(&a) * 0.1 + &bias).relu();
        let second = first.linear(&b).sin();
        let y = (concat([&second, &x]).linear(&c) * 0.1).softplus(1.0).linear(&d);
        let loss = (&y * &y).mean_all();
        let parameters = [&x, &a, &b, &c, &d, &bias];
        let gradients = grad(&loss, &parameters);
        let named = ["dx", "da", "db", "dc", "dd", "dbias"].into_iter().zip(gradients);
        let outputs: Outputs = [("y", y), ("loss", loss)].into_iter().chain(named).collect();
        for bytes in sizes {
            let most = Limits { max_workgroup_bytes: *bytes, max_binding: u64::MAX, ..Limits::default() };
            check(&within(&device, most), outputs.clone(), 3e-5, &format!("{rows} rows in {bytes} bytes"));
        }
        if device.has_half().is_none() {
            println!("halves skipped: {} stores none", device.name());
        } else if own {
            let halves = device.clone().with_half(Some(Half { matrices: None }));
            check(&halves, outputs, 1e-2, &format!("{rows} rows of halves"));
        }
    }
}

/// Every test on the best adapter of every backend.
macro_rules! on_every_backend {
    ($($name:ident),* $(,)?) => {
        mod wgpu {
            $(#[test]
            fn $name() {
                raygrad_tests::backend::wgpu().iter().for_each(super::$name);
            })*
        }
        mod vulkan {
            $(#[test]
            fn $name() {
                raygrad_tests::backend::vulkan().iter().for_each(super::$name);
            })*
        }
    };
}
on_every_backend!(
    layers_of_all_widths,
    halves,
    eigenvectors_of_close_eigenvalues,
    elements_four_at_a_time,
    totals_of_layers,
    concatenations_of_layers,
    reductions_of_all_sizes,
    gathers_and_scatters,
    compositing,
    training_follows_the_reference_and_repeats_bit_by_bit,
    two_programs_share_their_inputs,
    a_program_that_does_not_fit_leaves_nothing,
    long_inputs_are_read_back,
    buffers_beyond_the_binding_limit,
    networks_in_workgroups,
);

/// The same with tiles for drivers in software, which the tests above leave to users of such drivers.
mod software {
    macro_rules! tests {
        ($($name:ident),*) => {
            $(#[test]
            fn $name() {
                raygrad_tests::backend::software().iter().for_each(super::$name);
            })*
        };
    }
    tests!(tiles_of_software, training_follows_the_reference_and_repeats_bit_by_bit, buffers_beyond_the_binding_limit);
}
