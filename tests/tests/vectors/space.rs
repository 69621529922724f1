//! Complete training steps in space: NeRF with L2G and BARF poses, forward-facing and synthetic.

use raygrad::config::Layered;
use raygrad::geometry::Pose;
use raygrad::radiance::RadianceModel;
use raygrad::radiance::model::{FOUND, INTRINSICS, POSES, nothing_found};
use raygrad::radiance::rays::ImageSize;
use raygrad::training::Rates;
use raygrad::warps;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axis, Shape, Tensor, topological};
use raygrad_compiler::ops::input::{Input, Role};
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_tests::vectors::{Case, cases, numbers, sizes, to_official, transpose};
use serde_json::{Value, json};

/// Rough poses: the identity, or the true ones turned and moved by the noise.
fn rough(case: &Case) -> Vec<Pose> {
    let truth = case.numbers("pose_gt");
    let noise = case.input("noise");
    let turned = |(i, pose): (usize, &[f64])| {
        let (w, t) = (numbers(&noise["rotvec"][i]), numbers(&noise["trans"][i]));
        let mut motion = Pose::exp(&[w[0], w[1], w[2], 0.0, 0.0, 0.0]);
        motion.translation = nalgebra::Vector3::from_column_slice(&t);
        motion.after(&Pose::from_rows(pose))
    };
    match noise.is_null() {
        true => vec![Pose::identity(); truth.len() / 12],
        false => truth.chunks(12).enumerate().map(turned).collect(),
    }
}

fn model(case: &Case, views: usize) -> RadianceModel {
    let method = if case.text("model") == "barf" { "barf" } else { "l2g" };
    let mut layered = Layered::load(&format!("{method}-{}", case.text("dataset"))).unwrap();
    let hidden = |key: &str, drop: usize| {
        let all: Vec<u64> = case.input(key).as_array().unwrap().iter().filter_map(Value::as_u64).collect();
        format!("{:?}", &all[..all.len() - drop])
    };
    let mut set = |key: &str, value: String| layered.set(&format!("{key}={value}")).unwrap();
    set("scene.image_size", format!("[{}, {}]", case.count("H"), case.count("W")));
    set("train.rays", (views * sizes(case.input("ray_idx_per_iteration"))[1]).to_string());
    set("train.samples", case.count("sample_intvs").to_string());
    set("train.stratified", "false".to_string());
    set("field.layers", hidden("layers_feat", 1));
    set("radiance.color_layers", hidden("layers_rgb", 1));
    set("radiance.skip", case.input("skip").to_string());
    set("field.bands", case.count("L_3D").to_string());
    set("radiance.view_bands", case.count("L_view").to_string());
    set("field.window", case.input("c2f").to_string());
    set("optim.steps", case.count("max_iter").to_string());
    for (key, name) in [("lr", "lr"), ("lr_end", "lr_end"), ("lr_warp", "lr_pose"), ("lr_warp_end", "lr_pose_end")] {
        set(&format!("optim.{key}"), case.number(name).to_string());
    }
    if method == "l2g" {
        set("warp.code", case.count("embedding_dim").to_string());
        set("warp.layers", hidden("layers_warp", 1));
        set("warp.skip", case.input("skip_warp").to_string());
    }
    layered.validate().unwrap();
    let size = ImageSize { height: case.count("H"), width: case.count("W") };
    RadianceModel::new(&layered.settings, size, views, warps::of_settings(&layered.settings, views)).unwrap()
}

/// A value for every parameter of the model (or its gradient), in the official layout, by the official name.
fn official(model: &RadianceModel, name: &str, of: &dyn Fn(&Tensor) -> Vec<f64>) -> Vec<f64> {
    let find = |ours: &str| {
        let parameters = model.parameters();
        let p = parameters.iter().find(|p| p.tensor.input_name() == Some(ours));
        p.unwrap_or_else(|| panic!("no parameter {ours}")).tensor.clone()
    };
    let values = |ours: &str| {
        let t = find(ours);
        to_official(&t, &of(&t))
    };
    let trunk = model.settings.field.layers.len();
    let parts: Vec<&str> = name.split('.').collect();
    match parts[..] {
        ["warp_embedding" | "se3_refine", _] => values("warp.code"),
        ["warp_mlp", _, layer, what] => values(&format!("warp.{layer}.{what}")),
        ["nerf", "mlp_rgb", layer, what] => values(&format!("field.color.{layer}.{what}")),
        ["nerf", "mlp_feat", layer, what] if layer == trunk.to_string() => {
            [values(&format!("field.density.0.{what}")), values(&format!("field.feature.0.{what}"))].concat()
        }
        ["nerf", "mlp_feat", layer, what] => values(&format!("field.trunk.{layer}.{what}")),
        _ => panic!("unknown parameter {name}"),
    }
}

/// The official initial values of one of our parameters, in our layout.
fn initial(case: &Case, model: &RadianceModel, ours: &Tensor) -> Vec<f64> {
    let trunk = model.settings.field.layers.len();
    let name = ours.input_name().unwrap();
    let parts: Vec<&str> = name.split('.').collect();
    let get = |name: &str| numbers(&case.input("parameters")[name]);
    let last = |what: &str| get(&format!("nerf.mlp_feat.{trunk}.{what}"));
    let values = match parts[..] {
        ["warp", "code"] if case.text("model") == "barf" => get("se3_refine.weight"),
        ["warp", "code"] => get("warp_embedding.weight"),
        ["warp", layer, what] => get(&format!("warp_mlp.mlp_warp.{layer}.{what}")),
        ["field", "trunk", layer, what] => get(&format!("nerf.mlp_feat.{layer}.{what}")),
        ["field", "color", layer, what] => get(&format!("nerf.mlp_rgb.{layer}.{what}")),
        ["field", "density", _, what] => last(what)[..ours.shape().lanes()].to_vec(),
        ["field", "feature", _, what] => {
            let all = last(what);
            all[all.len() - ours.shape().lanes()..].to_vec()
        }
        _ => panic!("unknown parameter {name}"),
    };
    match ours.channels() {
        raygrad_compiler::Channels::Matrix(inputs, outputs) => transpose(&values, outputs, inputs),
        raygrad_compiler::Channels::Vector(_) => values,
    }
}

fn images(case: &Case) -> Vec<f64> {
    let v = case.input("images");
    let (shape, pixels) = (&v["shape"], case.count("H") * case.count("W"));
    let image = |seed: &Value| {
        let one = json!({"formula": "block_image", "seed": seed, "shape": shape, "block": v["block"]});
        let planes = numbers(&one);
        (0..pixels * 3).map(|i| planes[i % 3 * pixels + i / 3]).collect::<Vec<f64>>()
    };
    v["seeds"].as_array().unwrap().iter().flat_map(image).collect()
}

fn check(case: &Case) {
    let rough = rough(case);
    let views = rough.len();
    let model = model(case, views);
    let index: Vec<Vec<f64>> = case.input("ray_idx_per_iteration").as_array().unwrap().iter().map(numbers).collect();
    let ray = Axis::new("ray", index[0].len());
    let draw = Tensor::data("draw", Shape::new(&[&ray], 1).with_dtype(DType::U32));
    let pixel = Axis::new("pixel", case.count("H") * case.count("W"));
    let frame = model.frame();
    let pictures = Tensor::data("pictures", Shape::new(&[frame, &pixel], 3));
    let step = model.step_at(&ray, &draw, &pictures.take(&draw, &pixel));
    let output = |name: &str| step.outputs.iter().find(|(n, _)| n == name).map(|(_, t)| t.clone());
    let total = output("total").unwrap();
    let parameters: Vec<Tensor> = model.parameters().into_iter().map(|p| p.tensor).collect();
    let slopes = grad(&total, &parameters.iter().collect::<Vec<_>>());

    let mut bound = Bindings::new();
    let k = case.numbers("intr");
    let lens: Vec<f64> = (0..views)
        .flat_map(|v| {
            let k = &k[if k.len() > 9 { 9 * v } else { 0 }..];
            [k[0], k[4], k[2], k[5]]
        })
        .collect();
    let known: Vec<(&str, Vec<f64>)> = vec![
        ("pictures", images(case)),
        (INTRINSICS, lens),
        (POSES, rough.iter().flat_map(|p| p.to_rows()).collect()),
        (FOUND, nothing_found(views).iter().map(|x| f64::from(*x)).collect()),
    ];
    for t in topological(step.roots().into_iter().chain(slopes.clone())) {
        let Some(Input { name, role, shape }) = t.op_as::<Input>() else { continue };
        let values = match known.iter().find(|(n, _)| n == name) {
            Some((_, values)) => values.clone(),
            None if *role == Role::Parameter => initial(case, &model, &t),
            None => vec![0.0; shape.lanes()],
        };
        let array = if shape.dtype == DType::U32 {
            Array::integers(shape, vec![0; shape.lanes()])
        } else {
            Array::floats(shape, values)
        };
        bound.insert(name.clone(), array);
    }
    let losses = case.output("losses").as_array().unwrap().clone();
    for (it, index) in index.iter().enumerate() {
        bound.insert("draw".into(), Array::integers(draw.shape(), index.iter().map(|i| *i as u32).collect()));
        let mut rates = Rates::at(&model.settings.optim, it);
        if it == 0 {
            rates.progress = case.number("progress_first_iteration");
        }
        for (name, value) in rates.inputs() {
            bound.insert(name.to_string(), Array::floats(&Shape::new(&[], 1), vec![value]));
        }
        let roots: Vec<Tensor> = step.roots().into_iter().chain(slopes.clone()).collect();
        let values = evaluate(&roots, &bound).unwrap_or_else(|e| panic!("{}: {e}", case.name));
        let (outputs, rest) = values.split_at(step.outputs.len());
        let (updates, gradients) = rest.split_at(step.updates.len());
        let named =
            |name: &str| step.outputs.iter().zip(outputs).find(|((n, _), _)| n == name).map(|(_, v)| v.f().to_vec());
        let expected = numbers(&losses[it]);
        let found = [named("render").unwrap()[0], named("alignment").map_or(0.0, |a| a[0]), named("total").unwrap()[0]];
        for (found, expected) in found.iter().zip(&expected) {
            let off = (found - expected).abs();
            assert!(off <= 1e-8 * (1.0 + expected.abs()), "{}: step {it}: {found} instead of {expected}", case.name);
        }
        if it == 0 {
            let found: Vec<f64> = named("found").unwrap();
            let stored = rough.iter().zip(found.chunks(12)).flat_map(|(r, f)| r.after(&Pose::from_rows(f)).to_rows());
            case.check_within("stored_poses", &stored.collect::<Vec<_>>(), 1e-9);
            let slope = |t: &Tensor| {
                let at = parameters.iter().position(|p| p.id() == t.id() || p.input_name() == t.input_name());
                gradients[at.unwrap()].f().to_vec()
            };
            let after = |t: &Tensor| {
                let at = step.updates.iter().position(|(input, _)| input.input_name() == t.input_name());
                updates[at.unwrap()].f().to_vec()
            };
            for name in case.input("parameters").as_object().unwrap().keys() {
                case.check_within(&format!("param_grads/{name}"), &official(&model, name, &slope), 1e-9);
                case.check_within(&format!("after_step1/{name}"), &official(&model, name, &after), 1e-7);
            }
        }
        for ((input, _), value) in step.updates.iter().zip(updates) {
            bound.insert(input.input_name().unwrap().to_string(), value.clone());
        }
    }
}

#[test]
fn training_steps_of_the_official_code() {
    for case in cases("one_step").iter().filter(|c| c.name.starts_with("nerf")) {
        check(case);
    }
}
