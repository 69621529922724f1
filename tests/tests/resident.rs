//! Networks that stay in a workgroup of a GPU: values and gradients against the reference, and what a launch holds.
#![cfg(feature = "gpu")]

use raygrad::config::{Layered, Networks};
use raygrad::training::Learner;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::cost::Rates;
use raygrad_compiler::functions::composite::{Composite, composite_above};
use raygrad_compiler::functions::mlp::Activation;
use raygrad_compiler::functions::posenc::positional_encoding;
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::plan::region::{Grain, RegionOp};
use raygrad_compiler::reference::{Array, Bindings};
use raygrad_compiler::{Program, Step, Target, compile};
use raygrad_kernels::gpu::{GpuLaunch, Inputs, Kernel, Limits, lower};
use raygrad_runtime::{Device, Forms};
use raygrad_tests::backend::{gpus, reference, resident, run};
use raygrad_tests::check::check;
use raygrad_tests::rendering::{Rendering, Sizes};
use raygrad_tests::{Rng, seed, total};

/// Most outputs of a layer, in these tests.
const MOST: usize = 128;

fn plan(step: &Step) -> Program {
    compile(step, &Target { resident: MOST, ..Target::gpu() }).unwrap_or_else(|e| panic!("{e}"))
}

/// The kernels of resident networks.
fn networks(program: &Program, limits: &Limits) -> Vec<Kernel> {
    let lowered = lower(program, &mut Inputs::default(), limits).unwrap_or_else(|e| panic!("{e}\n{program}"));
    let resident = |i: &usize| {
        let region = &program.launches[*i].region;
        region.grain == Grain::Tile && region.body.iter().any(|i| matches!(i.op, RegionOp::Linear(_)))
    };
    let launches = lowered.launches.into_iter().enumerate().filter(|(i, _)| resident(i));
    let networks = |k: &Kernel, all: usize| all == 1 || k.name.contains("network");
    let of = |l: GpuLaunch| {
        let all = l.kernels.len();
        l.kernels.into_iter().filter(move |k| networks(k, all))
    };
    launches.flat_map(|(_, l)| of(l)).collect()
}

fn on_gpus(step: &Step, bindings: &Bindings) {
    on(&resident(MOST), step, bindings);
}

/// The same where a software driver takes half a minute to compile the kernels, which are the same for both.
fn on_one_gpu(step: &Step, bindings: &Bindings) {
    on(resident(MOST).get(..1).unwrap_or_default(), step, bindings);
}

fn on(devices: &[Device], step: &Step, bindings: &Bindings) {
    step.check().unwrap_or_else(|e| panic!("{e}"));
    check(devices, step, bindings).unwrap_or_else(|e| panic!("{e}"));
}

/// A network on `[frame, row]` with a layer that reads the encoding again.
struct Network {
    y: Tensor,
    parameters: Vec<Tensor>,
    bindings: Bindings,
}

impl Network {
    /// `own`: weights of the second layer that every frame has for itself.
    fn new((frames, rows): (usize, usize), widths: [usize; 3], own: bool) -> Network {
        let (frame, row) = (Axis::new("frame", frames), Axis::new("row", rows));
        let x = Tensor::parameter("x", Shape::new(&[&frame, &row], 2));
        let encoded = positional_encoding(&x, 3, None);
        let width = encoded.width();
        let axes: &[&Axis] = if own { &[&frame] } else { &[] };
        let p = |name: &str, axes: &[&Axis], rows: usize, columns: usize| {
            Tensor::parameter(name, Shape::new(axes, (rows, columns)))
        };
        let [a, b, c] = widths;
        let (wa, wb) = (p("wa", &[], width, a), p("wb", axes, a, b));
        let (wc, wd) = (p("wc", &[], b + width, c), p("wd", &[], c, 3));
        let (ba, bc) = (Tensor::parameter("ba", Shape::new(&[], a)), Tensor::parameter("bc", Shape::new(&[&frame], c)));
        let first = (encoded.linear(&wa) + &ba).relu();
        let second = first.linear(&wb).softplus(1.0);
        let third = (concat([&second, &encoded]).linear(&wc) + &bc).relu();
        let y = third.linear(&wd).sigmoid() * x.ch(0).sin();
        let parameters = vec![x, wa, wb, wc, wd, ba, bc];
        let mut rng = Rng(seed("resident"));
        let name = |t: &Tensor| t.input_name().unwrap_or_default().into();
        let bindings = parameters.iter().map(|t| (name(t), rng.array(t.shape(), -0.6, 0.6))).collect();
        Network { y, parameters, bindings }
    }

    fn values(&self) -> Step {
        Step { outputs: vec![("y".into(), self.y.clone())], updates: vec![] }
    }

    fn gradients(&self) -> Step {
        let loss = total(&(&self.y * &self.y));
        let wanted: Vec<&Tensor> = self.parameters.iter().collect();
        let gradients = grad(&loss, &wanted);
        let name = |t: &Tensor| format!("d {}", t.input_name().unwrap_or_default());
        let mut outputs = vec![("loss".to_string(), loss)];
        outputs.extend(self.parameters.iter().map(name).zip(gradients));
        Step { outputs, updates: vec![] }
    }
}

#[test]
fn a_network_is_one_kernel() {
    for (rows, widths, own) in [(64, [64, 64, 64], false), (77, [128, 96, 33], false), (12, [17, 5, 8], true)] {
        let network = Network::new((3, rows), widths, own);
        let program = plan(&network.values());
        assert_eq!(networks(&program, &Limits::default()).len(), 1, "{program}");
        assert_eq!(program.launches.len(), 1, "{program}");
        on_gpus(&network.values(), &network.bindings);
    }
}

#[test]
fn gradients() {
    for (rows, widths, own) in [(64, [40, 36, 20], false), (77, [72, 20, 33], true)] {
        let network = Network::new((2, rows), widths, own);
        on_one_gpu(&network.gradients(), &network.bindings);
    }
}

/// What a run asks for, else what should be faster by the device's rates; and that a CPU has no such forms.
#[test]
fn a_setting_decides() {
    let network = Network::new((3, 64), [100, 100, 100], false);
    let mut settings = Layered::load("planar-barf").unwrap_or_else(|e| panic!("{e}")).settings;
    let mut found = |device: &Device, networks: Networks| {
        settings.run.networks = networks;
        let (learner, program) =
            Learner::new(device.clone(), &settings, &network.values()).unwrap_or_else(|e| panic!("{e}"));
        learner.program(program).launches.iter().any(|l| l.region.grain == Grain::Tile)
    };
    let all = [Networks::Auto, Networks::Layered, Networks::Resident];
    assert_eq!(all.map(|n| found(&Device::cpu(Some(1)).unwrap(), n)), [false; 3]);
    for device in gpus() {
        // Where launches cost next to nothing, layers of their own reach more of the device.
        for (launch_ns, auto) in [(3_000, true), (1, false)] {
            let rates = Rates { launch_ns, ..Rates::GPU };
            let device = device.clone().with_forms(Forms { rates, ..device.forms() });
            assert_eq!(all.map(|n| found(&device, n)), [auto, false, true], "{} at {launch_ns} ns", device.name());
        }
        let device = device.clone().with_forms(Forms { rates: Rates::SOFTWARE, ..device.forms() });
        assert!(!found(&device, Networks::Auto), "{} with the rates of software", device.name());
    }
}

const RAYS: Sizes = Sizes { frames: 2, rays: 3, samples: 8, width: 17, hidden: Activation::Relu, warped: true };

/// Rendered rays: from the encoding to the sums along a ray in one kernel.
#[test]
fn a_ray_is_rendered_by_one_kernel() {
    for sizes in [RAYS, Sizes { samples: 70, width: 40, warped: false, ..RAYS }] {
        let scene = Rendering::new(sizes);
        let values = [("rgb", &scene.rgb), ("depth", &scene.depth), ("opacity", &scene.opacity)];
        let step = Step { outputs: values.map(|(n, t)| (n.to_string(), t.clone())).into(), updates: vec![] };
        let program = plan(&step);
        let samples =
            |region: &raygrad_compiler::plan::region::Region| region.domain.iter().any(|a| a.name() == "sample");
        assert_eq!(program.launches.iter().filter(|l| samples(&l.region)).count(), 1, "{program}");
        on_gpus(&step, &scene.bindings);
    }
}

#[test]
fn second_derivatives() {
    let scene = Rendering::new(Sizes { width: 9, hidden: Activation::Tanh, ..RAYS });
    let (step, bindings) = scene.second_order();
    assert!(!networks(&plan(&step), &Limits::default()).is_empty());
    on_one_gpu(&step, &bindings);
}

#[test]
fn a_step_of_rendering() {
    let scene = Rendering::new(Sizes { samples: 20, ..RAYS });
    on_one_gpu(&scene.step(), &scene.bindings);
}

/// Rays of which some meet something opaque, at given depths.
struct Rays {
    seen: Composite,
    /// What the network gives.
    y: Tensor,
    bindings: Bindings,
    depths: Axis,
}

const SAMPLES: usize = 200;

impl Rays {
    fn new(least: f64) -> Rays {
        let (ray, sample) = (Axis::new("ray", 6), Axis::new("sample", SAMPLES));
        let depth = Tensor::data("depth", Shape::new(&[&sample], 1));
        let thick = Tensor::data("thick", Shape::new(&[&ray], 1));
        let p = |name: &str, rows: usize, columns: usize| Tensor::parameter(name, Shape::new(&[], (rows, columns)));
        let (a, b, c) = (p("a", 2, 24), p("b", 24, 20), p("c", 20, 4));
        let y = concat([&depth, &thick]).linear(&a).sin().linear(&b).sin().linear(&c);
        let density = y.ch(0).softplus(1.0) * &thick;
        let seen = composite_above(least, &y.slice(1..4).sigmoid(), &density, &depth, &Tensor::scalar(1.0), &sample);
        let mut rng = Rng(seed("rays"));
        let mut bindings: Bindings =
            [&a, &b, &c].map(|t| (t.input_name().unwrap_or_default().into(), rng.array(t.shape(), -0.8, 0.8))).into();
        let depths = (0..SAMPLES).map(|i| 0.05 * i as f64).collect();
        bindings.insert("depth".into(), Array::floats(depth.shape(), depths));
        bindings.insert("thick".into(), Array::floats(thick.shape(), vec![9.0, 0.01, 30.0, 0.4, 3.0, 0.0]));
        Rays { seen, y, bindings, depths: sample }
    }

    fn step(&self) -> Step {
        let Composite { color, depth, opacity, .. } = &self.seen;
        let outputs = [("color", color), ("depth", depth), ("opacity", opacity)];
        Step { outputs: outputs.map(|(n, t)| (n.to_string(), t.clone())).into(), updates: vec![] }
    }
}

fn leaves_rays(step: &Step) -> bool {
    let kernels = networks(&plan(step), &Limits::default());
    assert_eq!(kernels.len(), 1);
    kernels[0].wgsl().unwrap_or_else(|e| panic!("{e}")).contains("workgroupUniformLoad")
}

#[test]
fn rays_end_where_they_are_dark() {
    let rays = Rays::new(1e-3);
    assert!(leaves_rays(&rays.step()));
    on_gpus(&rays.step(), &rays.bindings);
    check(&[Device::cpu(Some(2)).unwrap()], &rays.step(), &rays.bindings).unwrap_or_else(|e| panic!("{e}"));
    // Nowhere dark, nothing to leave out.
    let whole = Rays::new(0.0);
    assert!(!leaves_rays(&whole.step()));
    // Somebody wants to know all weights.
    let mut with_weights = rays.step();
    with_weights.outputs.push(("weights".into(), rays.seen.weights.clone()));
    assert!(!leaves_rays(&with_weights));
    on_gpus(&with_weights, &rays.bindings);
    // What is no count may fall again.
    let falls = rays.y.ch(1).cumsum(&rays.depths);
    let weights = Tensor::scalar(0.0).less_than(&falls).select(&Tensor::scalar(0.0), &rays.y.ch(2).exp());
    let not_counted = Step { outputs: vec![("sum".into(), weights.sum(&[&rays.depths]))], updates: vec![] };
    assert!(!leaves_rays(&not_counted));
    on_gpus(&not_counted, &rays.bindings);
}

/// Samples that nothing can be computed from do not matter where they are left out, and only there.
#[test]
fn what_lies_in_the_dark_is_not_computed() {
    let rays = Rays::new(1e-3);
    let mut blind = rays.bindings.clone();
    let mut depths: Vec<f64> = (0..SAMPLES).map(|i| 0.05 * i as f64).collect();
    depths[128..].fill(f64::NAN);
    blind.insert("depth".into(), Array::floats(&Shape::new(&[&rays.depths], 1), depths));
    let expected = reference(&rays.step(), &rays.bindings);
    for device in resident(MOST) {
        let found = run(&device, &rays.step(), &blind);
        // Of the first and the third ray nothing is left after a few samples.
        for (found, expected) in found.iter().zip(&expected) {
            let channels = found.len() / 6;
            for ray in [0, 2] {
                for c in 0..channels {
                    let (a, b) = (found[ray * channels + c], expected[ray * channels + c]);
                    assert!((a - b).abs() < 1e-4, "ray {ray}, channel {c}: {a}, not {b}");
                }
            }
            assert!(found[channels].is_nan(), "the second ray sees all samples");
        }
    }
}
