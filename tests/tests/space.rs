//! The graphs of registration in space, whole: every warp, first and second order, on every device.

use raygrad::config::Layered;
use raygrad::geometry::Pose;
use raygrad::radiance::RadianceModel;
use raygrad::radiance::model::{
    FIT_PIXELS, FOUND, INTRINSICS, POSES, VIEW_FIRST, VIEW_INTRINSICS, VIEW_POSE, nothing_found,
};
use raygrad::radiance::rays::ImageSize;
use raygrad::training::Rates;
use raygrad::warps;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::mlp::Init;
use raygrad_compiler::graph::{Tensor, topological};
use raygrad_compiler::ops::identity::StopGradient;
use raygrad_compiler::ops::input::{Input, Role};
#[cfg(feature = "gpu")]
use raygrad_compiler::plan::region::Grain;
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Axis, Program, Shape, Step, Target, compile};
use raygrad_runtime::{Device, Precision};
use raygrad_tests::backend::{devices, devices_for_large_programs, reference, round, run};
use raygrad_tests::check::check;
use raygrad_tests::{Rng, seed, total};
use std::collections::HashMap;

/// Most outputs of a layer of a network that stays in a workgroup.
#[cfg(feature = "gpu")]
const RESIDENT: usize = 128;
const VIEWS: usize = 3;
const SIZE: ImageSize = ImageSize { height: 6, width: 8 };

/// A preset at the size of a test, with some settings changed.
fn model(preset: &str, set: &[&str]) -> RadianceModel {
    let mut layered = Layered::load(preset).unwrap_or_else(|e| panic!("{e}"));
    let small = [
        "scene.image_size=[6,8]",
        "train.rays=12",
        "train.samples=8",
        "field.layers=[12,12,12]",
        "field.bands=2",
        "radiance.skip=[2]",
        "radiance.color_layers=[8]",
        "radiance.view_bands=1",
        "warp.code=4",
        "warp.layers=[8,8]",
        "warp.skip=[1]",
        "warp.bands=2",
        "warp.inn.hidden=8",
    ];
    for text in small.iter().chain(set) {
        layered.set(text).unwrap_or_else(|e| panic!("{preset}: {e}"));
    }
    layered.validate().unwrap_or_else(|e| panic!("{preset}: {e}"));
    let warp = warps::of_settings(&layered.settings, VIEWS);
    RadianceModel::new(&layered.settings, SIZE, VIEWS, warp).unwrap_or_else(|e| panic!("{e}"))
}

/// Cameras around the origin at a distance of 4, lenses of 10 pixels, and random values for everything else.
fn bind(model: &RadianceModel, roots: &[Tensor], rng: &mut Rng) -> Bindings {
    let poses: Vec<f64> = (0..VIEWS)
        .flat_map(|i| {
            let mut pose = Pose::exp(&[0.2, 1.3 * i as f64, -0.1, 0.0, 0.0, 0.0]);
            pose.translation = nalgebra::Vector3::new(0.1, -0.2, 4.0);
            pose.to_rows()
        })
        .collect();
    let lens = (0..VIEWS).flat_map(|_| [10.0, 11.0, 4.0, 3.0]).collect();
    let found = nothing_found(VIEWS).iter().map(|x| f64::from(*x)).collect();
    let fixed = [(POSES, poses), (INTRINSICS, lens), (FOUND, found)];
    let rates = Rates::at(&model.settings.optim, 70_000).inputs();
    let mut bound = Bindings::new();
    for t in topological(roots.iter().cloned()) {
        let Some(Input { name, role, shape }) = t.op_as::<Input>() else { continue };
        let known = fixed.iter().find(|(n, _)| n == name).map(|(_, v)| v.clone());
        let rate = rates.iter().find(|(n, _)| n == name).map(|(_, v)| vec![f64::from(*v as f32)]);
        let spread = |init: &Init| match init {
            Init::Uniform(bound) => *bound,
            Init::Normal(deviation) => *deviation,
            _ => 0.1,
        };
        let value = match known.or(rate) {
            Some(values) => Array::floats(shape, values),
            None if shape.dtype == DType::U32 => Array::integers(shape, vec![70_000; shape.lanes()]),
            None if *role == Role::Parameter => {
                let parameters = model.parameters();
                let of =
                    parameters.iter().find(|p| p.tensor.input_name() == Some(name)).map_or(0.1, |p| spread(&p.init));
                rng.array(shape, -of, of)
            }
            None if *role == Role::State => Array::zeros(shape),
            None => rng.array(shape, 0.0, 1.0),
        };
        bound.insert(name.clone(), value);
    }
    bound
}

fn output(step: &Step, name: &str) -> Tensor {
    step.outputs.iter().find(|(n, _)| n == name).expect("an output of the step").1.clone()
}

fn check_model(preset: &str, set: &[&str]) {
    let name = format!("{preset} {}", set.join(" "));
    let model = model(preset, set);
    let mut rng = Rng(seed(&name));
    let step = model.train_step();
    let loss = output(&step, "total");
    let parameters: Vec<Tensor> = model.parameters().into_iter().map(|p| p.tensor).collect();
    let wanted: Vec<&Tensor> = parameters.iter().collect();
    let first = grad(&loss, &wanted);
    let mut bound = bind(&model, &step.roots(), &mut rng);
    // The derivative along a random direction, and its derivatives.
    let along = |g: &Tensor, p: &Tensor| {
        let direction = Tensor::data(format!("direction {}", p.input_name().unwrap_or_default()), g.shape().clone());
        total(&(g * direction))
    };
    let slope = first.iter().zip(&parameters).map(|(g, p)| along(g, p)).reduce(|a, b| a + b).expect("parameters");
    for (g, p) in first.iter().zip(&parameters) {
        let name = format!("direction {}", p.input_name().unwrap_or_default());
        bound.insert(name, rng.array(g.shape(), -1.0, 1.0));
    }
    let second = grad(&slope, &wanted);
    let (loss, slope) = (held(&loss, &mut bound), held(&slope, &mut bound));
    check_difference(&format!("{name}, first order"), &loss, &slope, &parameters, &bound);
    let turned: Tensor = {
        let pairs = second.iter().zip(&parameters);
        pairs.map(|(g, p)| along(&g.broadcast_to(p.axes()), p)).reduce(|a, b| a + b).expect("parameters")
    };
    check_difference(&format!("{name}, second order"), &slope, &turned, &parameters, &bound);
    let mut outputs = step.outputs;
    let named = |order: &'static str| move |(p, g): (&Tensor, Tensor)| (format!("{order} {p:?}"), g);
    outputs.extend(parameters.iter().zip(first.clone()).map(named("first")));
    outputs.extend(parameters.iter().zip(second).map(named("second")));
    let step = Step { outputs, updates: vec![] };
    check(&devices_for_large_programs(), &step, &bound).unwrap_or_else(|e| panic!("{name}: {e}"));
}

/// The same scalar with the depths of a fine field, which follow the coarse field's weights but carry no gradient, held at
/// their values: central differences must not move them.
fn held(scalar: &Tensor, bound: &mut Bindings) -> Tensor {
    let mut replaced: HashMap<u64, Tensor> = HashMap::new();
    for t in topological([scalar.clone()]) {
        let inputs: Vec<Tensor> = t.inputs().iter().map(|i| replaced[&i.id()].clone()).collect();
        let depths = t.op_as::<StopGradient>().is_some() && t.axes().last().is_some_and(|a| a.name() == "merged");
        let new = match (depths, t.inputs().is_empty()) {
            (true, _) => {
                let name = format!("held {}", t.id());
                let value =
                    evaluate(std::slice::from_ref(&t), bound).unwrap_or_else(|e| panic!("{name}: {e}")).remove(0);
                bound.insert(name.clone(), value);
                Tensor::data(name, t.shape().clone())
            }
            (false, true) => t.clone(),
            (false, false) => Tensor::record_arc(t.op().clone(), inputs),
        };
        replaced.insert(t.id(), new);
    }
    replaced[&scalar.id()].clone()
}

/// Compares `slope`, the derivative of `scalar` along the bound directions of all parameters, with central differences:
/// a difference across a kink is no derivative, a shorter one does not reach it.
fn check_difference(what: &str, scalar: &Tensor, slope: &Tensor, parameters: &[Tensor], bound: &Bindings) {
    let value = |t: &Tensor, bound: &Bindings| {
        evaluate(std::slice::from_ref(t), bound).unwrap_or_else(|e| panic!("{what}: {e}"))[0].f()[0]
    };
    let found = value(slope, bound);
    let expected: Vec<f64> = [1e-4, 1e-5, 1e-6]
        .iter()
        .map(|step| {
            let at = |sign: f64| {
                let mut moved = bound.clone();
                for p in parameters {
                    let name = p.input_name().unwrap_or_default();
                    let along = bound[&format!("direction {name}")].f().to_vec();
                    let array = moved.get_mut(name).expect("a bound parameter");
                    array.f_mut().iter_mut().zip(along).for_each(|(x, d)| *x += sign * step * d);
                }
                value(scalar, &moved)
            };
            (at(1.0) - at(-1.0)) / (2.0 * step)
        })
        .collect();
    let agrees = expected.iter().any(|e| (found - e).abs() <= 1e-5 * (1.0 + e.abs()));
    assert!(agrees, "{what}: the graph gives {found}, central differences give {expected:?}");
}

#[test]
fn known_and_global_poses() {
    check_model("nerf-blender", &[]);
    check_model("barf-blender", &["train.opaque_background=true", "radiance.density=relu"]);
    check_model("barf-llff", &["warp.origin=[0.1,-0.2,2.0]"]);
}

#[test]
fn local_motions() {
    check_model("l2g-blender", &[]);
    check_model(
        "l2g-llff",
        &["radiance.view_dependent=false", "warp.output_scale=[0.25,1.5]", "warp.origin=[0.1,-0.2,2.0]"],
    );
}

#[test]
fn refined_lenses() {
    check_model("l2g-llff", &["train.refine_lens=all"]);
    check_model("nerf-blender", &["train.refine_lens=focal", "train.fine_samples=4"]);
    check_model(
        "barf-llff",
        &["train.refine_lens=all", "train.ndc=true", "train.depth=metric", "train.range=[0.0, 1.0]"],
    );
}

/// The step that fits poses once more, on every device.
#[test]
fn poses_fitted_once_more() {
    let turned = ["train.shear=true", "warp.origin=[0.1,-0.2,2.0]"];
    for (preset, set) in
        [("l2g-blender", &["train.refine_lens=focal"][..]), ("inn-llff", &turned), ("barf-blender", &[])]
    {
        let model = model(preset, set);
        let step = model.fit(9);
        let mut bound = bind(&model, &step.roots(), &mut Rng(seed(preset)));
        if let Some(pixels) = bound.get_mut(FIT_PIXELS) {
            *pixels = Array::integers(&pixels.shape, SIZE.grid(3));
        }
        check(&devices(), &step, &bound).unwrap_or_else(|e| panic!("{preset}: {e}"));
    }
}

/// What a step compares with photos is what views from the poses that it finds show.
#[test]
fn a_step_sees_what_its_poses_say() {
    let set = ["train.stratified=false", "train.shear=true", "warp.origin=[0.1,-0.2,2.0]"];
    let model = model("barf-llff", &set);
    let (ray, frame) = (Axis::new("ray", 4), model.frame().clone());
    let index = Tensor::data("index", Shape::new(&[&ray], 1).with_dtype(DType::U32));
    let step = model.step_at(&ray, &index, &Tensor::data("colors", Shape::new(&[&frame, &ray], 3)));
    let (render, found) = (output(&step, "render"), output(&step, "found"));
    let pixels = [3u32, 12, 29, 47];
    let mut bound = bind(&model, &step.roots(), &mut Rng(seed("a step")));
    bound.insert("index".into(), Array::integers(index.shape(), pixels.to_vec()));
    bound.get_mut("colors").expect("an input").f_mut().fill(0.0);
    let values = evaluate(&[render, found], &bound).expect("is evaluated");
    let (seen, found) = (values[0].f()[0], values[1].f().to_vec());
    let color = output(&model.view(SIZE.pixels()), "color");
    let squares: f64 = found
        .chunks(12)
        .zip(bound[POSES].f().to_vec().chunks(12))
        .map(|(found, rough)| {
            let pose = Pose::from_rows(rough).after(&Pose::from_rows(found));
            let mut bound = bound.clone();
            let floats = |values: &[f64], width: usize| Array::floats(&Shape::new(&[], width), values.to_vec());
            let placed = Array::floats(&Shape::new(&[], (3, 4)), pose.to_rows().to_vec());
            bound.insert(VIEW_POSE.into(), placed);
            bound.insert(VIEW_INTRINSICS.into(), floats(&[10.0, 11.0, 4.0, 3.0], 4));
            bound.insert(VIEW_FIRST.into(), Array::integers(&Shape::new(&[], 1).with_dtype(DType::U32), vec![0]));
            let shown = evaluate(std::slice::from_ref(&color), &bound).expect("is evaluated").remove(0);
            let of = |pixel: &u32| shown.f()[3 * *pixel as usize..][..3].iter().map(|c| c * c).sum::<f64>();
            pixels.iter().map(of).sum::<f64>()
        })
        .sum();
    let shown = squares / (3 * pixels.len() * VIEWS) as f64;
    assert!((seen - shown).abs() < 1e-9 * shown && shown > 0.01, "{seen} in the step, {shown} in views");
}

#[test]
fn invertible_warps() {
    // With the paper's weight, 1e4, second derivatives are differences of numbers too large for the tolerances. All
    // derivatives are linear in the weight, so what holds at 100 holds there.
    check_model("inn-llff", &["loss.alignment=100.0"]);
    check_model("inn-blender", &["warp.method=multi-invertible"]);
}

#[test]
fn plain_networks() {
    check_model("inn-blender", &["warp.method=mlp"]);
    check_model("inn-blender", &["warp.method=implicit-mlp"]);
    check_model("inn-blender", &["warp.method=se3-field", "warp.output_scale=[0.5,2.0]"]);
}

/// Whole steps with products of bfloat16 on the CPU: the loss, and gradients of first and second order. Operands have 8 bits, and
/// a rectifier near its kink opens or shuts.
#[test]
fn mixed_precision_on_the_cpu() {
    let mixed = Device::cpu(Some(2)).and_then(|d| d.with_precision(Precision::Mixed)).unwrap_or_else(|e| panic!("{e}"));
    for preset in ["nerf-blender", "l2g-blender", "inn-llff", "garf-llff"] {
        let model = model(preset, &["train.rays=48", "train.samples=16", "loss.alignment=100.0"]);
        let loss = output(&model.train_step(), "total");
        let parameters: Vec<Tensor> = model.parameters().into_iter().map(|p| p.tensor).collect();
        let wanted: Vec<&Tensor> = parameters.iter().collect();
        let first = grad(&loss, &wanted);
        let squares = first.iter().map(|g| total(&(g * g))).reduce(|a, b| a + b).expect("parameters");
        let second = grad(&squares, &wanted);
        for (what, values, tolerance) in [("loss", vec![loss], 1e-3), ("first", first, 0.05), ("second", second, 0.1)] {
            let outputs = (0..).map(|i: usize| format!("{i}")).zip(values).collect();
            let step = Step { outputs, updates: vec![] };
            let bound = round(&bind(&model, &step.roots(), &mut Rng(seed(preset))));
            let (expected, found) = (reference(&step, &bound), run(&mixed, &step, &bound));
            let length = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
            let largest = expected.iter().map(|v| length(v)).fold(0.0, f64::max);
            for (i, (expected, found)) in expected.iter().zip(&found).enumerate() {
                let difference: Vec<f64> = expected.iter().zip(found).map(|(e, f)| e - f).collect();
                let (error, size) = (length(&difference), length(expected));
                // Gradients that nearly cancel keep the errors of what they are sums of.
                assert!(
                    error <= tolerance * (size + 0.1 * largest),
                    "{preset}, {what}, parameter {i}: off by {error:.1e} of {size:.1e}; the largest is {largest:.1e}"
                );
            }
        }
    }
}

/// Two fields, the second at depths that the first one's weights give.
#[test]
fn fine_fields() {
    check_model("nerf-blender", &["train.fine_samples=5"]);
    check_model("nerf-blender-repr", &["train.samples=4", "train.fine_samples=6", "train.density_noise=0.5"]);
    check_model("barf-llff", &["train.fine_samples=7"]);
    check_model("l2g-blender", &["train.fine_samples=4", "warp.layers=[8]"]);
}

#[test]
fn device_coordinates() {
    let ndc = ["train.ndc=true", "train.depth=metric", "train.range=[0.0, 1.0]"];
    check_model("barf-llff", &ndc);
    check_model("nerf-llff-repr", &["train.fine_samples=6"]);
    check_model("inn-llff", &ndc);
}

#[test]
fn gaussian_and_sine_fields() {
    let wider = "field.sigma=0.5";
    check_model("garf-llff", &["radiance.skip=[2]", wider]);
    check_model("garf-llff-se3", &[wider]);
    check_model("garf-llff", &["radiance.view_dependent=false", "field.encoding=windowed", wider]);
    let siren = ["field.kind=siren", "field.encoding=none", "field.omega=3.0"];
    check_model("barf-llff", &siren);
    check_model("nerf-blender", &[&siren[..], &["radiance.init=fan-in", "train.fine_samples=4"]].concat());
}

/// With a fine field too, either network runs once forwards and once backwards.
#[test]
fn both_networks_run_once() {
    let mut layered = Layered::load("nerf-blender-repr").unwrap_or_else(|e| panic!("{e}"));
    layered.set("train.rays=200").unwrap_or_else(|e| panic!("{e}"));
    let size = ImageSize { height: 20, width: 20 };
    let model = RadianceModel::new(&layered.settings, size, 100, warps::of_settings(&layered.settings, 100));
    let model = model.unwrap_or_else(|e| panic!("{e}"));
    let program: Program = compile(&model.train_step(), &Target::cpu()).unwrap_or_else(|e| panic!("{e}"));
    let excess = program.flops() as f64 / model.flops();
    assert!(excess < 1.1, "{excess:.3} times the operations of one pass:\n{program}");
}

/// The kernels of the new pieces are modules that naga finds valid, whole steps and views.
#[cfg(feature = "gpu")]
#[test]
fn a_gpu_can_run_every_kind_of_field() {
    use raygrad_kernels::gpu::{Inputs, Limits, lower};
    for (preset, set) in [("nerf-blender-repr", &[][..]), ("nerf-llff-repr", &[]), ("garf-llff-se3", &[])] {
        let model = model(preset, set);
        for step in [model.train_step(), model.view(16), model.refinement(), model.density(16), model.fit(16)] {
            let program = compile(&step, &Target::gpu()).unwrap_or_else(|e| panic!("{preset}: {e}"));
            let lowered = lower(&program, &mut Inputs::default(), &Limits::default());
            let lowered = lowered.unwrap_or_else(|e| panic!("{preset}: {e}\n{program}"));
            for kernel in lowered.launches.iter().flat_map(|l| &l.kernels) {
                kernel.wgsl().unwrap_or_else(|e| panic!("{preset}: {e}"));
            }
        }
    }
}

/// Rendered views and steps that update a pose alone, where networks stay in a workgroup: with a fine field, normalised device
/// coordinates, and rays that end in the dark.
#[cfg(feature = "gpu")]
#[test]
fn views_in_workgroups() {
    use raygrad_kernels::gpu::{Inputs, Kernel, Limits, lower};
    let dark: &[&str] = &["radiance.stop_below=0.3"];
    for (preset, set) in [("l2g-blender", dark), ("barf-llff", &[]), ("nerf-llff-repr", dark), ("garf-llff", dark)] {
        let model = model(preset, set);
        let view = model.view(16);
        let bound = bind(&model, &view.roots(), &mut Rng(seed(preset)));
        let devices: Vec<Device> = raygrad_tests::backend::resident(RESIDENT).into_iter().take(1).collect();
        let program = compile(&view, &Target { resident: RESIDENT, ..Target::gpu() }).unwrap_or_else(|e| panic!("{e}"));
        let over_samples = |l: &&raygrad_compiler::plan::Launch| {
            l.region.grain == Grain::Tile && l.region.domain.iter().any(|a| ["sample", "merged"].contains(&a.name()))
        };
        let fields = if preset == "nerf-llff-repr" { 2 } else { 1 };
        assert_eq!(program.launches.iter().filter(over_samples).count(), fields, "{preset}: {program}");
        let lowered = lower(&program, &mut Inputs::default(), &Limits::default());
        let lowered = lowered.unwrap_or_else(|e| panic!("{preset}: {e}"));
        let text = |k: &Kernel| k.wgsl().unwrap_or_else(|e| panic!("{preset}: {e}"));
        let leaves = |k: &Kernel| text(k).contains("workgroupUniformLoad");
        assert_eq!(lowered.launches.iter().flat_map(|l| &l.kernels).any(leaves), set == dark, "{preset}");
        check(&devices, &view, &bound).unwrap_or_else(|e| panic!("{preset}: {e}"));
    }
}

/// On a CPU the network of a step runs once forwards and once backwards, in one launch.
#[test]
fn the_network_runs_once() {
    let mut layered = Layered::load("l2g-blender").unwrap_or_else(|e| panic!("{e}"));
    layered.set("train.rays=200").unwrap_or_else(|e| panic!("{e}"));
    let size = ImageSize { height: 20, width: 20 };
    let warp = warps::of_settings(&layered.settings, 100);
    let model = RadianceModel::new(&layered.settings, size, 100, warp).unwrap_or_else(|e| panic!("{e}"));
    let program: Program = compile(&model.train_step(), &Target::cpu()).unwrap_or_else(|e| panic!("{e}"));
    let excess = program.flops() as f64 / model.flops();
    assert!(excess < 1.05, "{excess:.3} times the operations of one pass:\n{program}");
}
