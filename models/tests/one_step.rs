//! Five training steps of the official code, reproduced in f64 by the reference interpreter from the same graph that
//! every backend compiles: patches, losses, gradients through Adam, fitted transforms and corner errors.

use raygrad::config::{Layered, Settings};
use raygrad::data::{Perturbation, Photo};
use raygrad::geometry::{Grid, Transform};
use raygrad::planar::{PlanarData, PlanarModel, model};
use raygrad::training::Rates;
use raygrad::warps;
use raygrad_compiler::Step;
use raygrad_compiler::graph::topological;
use raygrad_compiler::ops::input::{Input, Role};
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use serde_json::Value;
use std::collections::HashMap;

const VECTORS: &str = include_str!("vectors/planar_one_step.json");

/// The hash that the vectors' large tensors are made of.
fn hash(seed: u32, i: u32, j: u32) -> u32 {
    let mut x = seed.wrapping_mul(0x9E37_79B1).wrapping_add(i.wrapping_mul(0x85EB_CA77));
    x = x.wrapping_add(j.wrapping_mul(0xC2B2_AE3D)).wrapping_add(1);
    x = (x ^ (x >> 16)).wrapping_mul(0x7FEB_352D);
    x = (x ^ (x >> 15)).wrapping_mul(0x846C_A68B);
    x ^ (x >> 16)
}

fn numbers(v: &Value) -> Vec<f64> {
    match v {
        Value::Array(items) => items.iter().flat_map(numbers).collect(),
        other => other.as_f64().into_iter().collect(),
    }
}

fn shape(v: &Value) -> Vec<usize> {
    numbers(&v["shape"]).iter().map(|n| *n as usize).collect()
}

/// A formula tensor, transposed if it is a weight `[out, in]`: ours are `(in, out)`.
fn formula(v: &Value, transpose: bool) -> Vec<f64> {
    let (seed, scale, shape) = (v["seed"].as_u64().unwrap() as u32, v["scale"].as_f64().unwrap(), shape(v));
    let (rows, columns) = if shape.len() == 1 { (1, shape[0]) } else { (shape[0], shape[1]) };
    let value = |i: usize, j: usize| scale * (f64::from(hash(seed, i as u32, j as u32) >> 16) - 32768.0) / 32768.0;
    if transpose {
        (0..rows * columns).map(|k| value(k % rows, k / rows)).collect()
    } else {
        (0..rows * columns).map(|k| value(k / columns, k % columns)).collect()
    }
}

fn photo(v: &Value) -> Photo {
    let (seed, block, size) = (v["seed"].as_u64().unwrap() as u32, v["block"].as_u64().unwrap() as usize, shape(v));
    let (height, width) = (size[1], size[2]);
    let channel = |k: usize, c: usize| {
        let bits = hash(seed, 4096 * c as u32 + (k / width / block) as u32, (k % width / block) as u32);
        (bits >> 24) as f32 / 256.0
    };
    let rgb = (0..height * width).map(|k| std::array::from_fn(|c| channel(k, c))).collect();
    Photo { height, width, rgb }
}

fn settings(case: &Value) -> Settings {
    let input = &case["inputs"];
    let l2g = input["model"] == "l2g_planar";
    let mut layered = Layered::load(if l2g { "planar-l2g" } else { "planar-barf" }).unwrap();
    let hidden = |v: &Value| format!("{:?}", &numbers(v)[..numbers(v).len() - 1]).replace(".0", "");
    let mut set = |key: &str, value: String| layered.set(&format!("{key}={value}")).unwrap();
    set("data.patches", input["num_patches"].to_string());
    set("data.image_size", format!("[{},{}]", input["H"], input["W"]));
    set("data.patch_crop", format!("[{},{}]", input["H_crop"], input["W_crop"]));
    set("warp.dof", input["dof"].to_string());
    set("field.layers", hidden(&input["layers"]));
    set("field.bands", input["L_2D"].to_string());
    set("optim.steps", input["max_iter"].to_string());
    for key in ["lr", "lr_end", "lr_warp", "lr_warp_end"] {
        if let Some(value) = input[key].as_f64() {
            set(&format!("optim.{key}"), value.to_string());
        }
    }
    if l2g {
        set("warp.code", input["embedding_dim"].to_string());
        set("warp.layers", hidden(&input["layers_warp"]));
    }
    layered.settings
}

/// The official name of one of our parameters.
fn official(name: &str, barf: bool) -> String {
    match name {
        "warp.code" if barf => "warp_param.weight".to_string(),
        "warp.code" => "warp_embedding.weight".to_string(),
        _ => name.replace("field.", "neural_image.mlp.").replace("warp.", "warp_mlp.mlp_warp."),
    }
}

fn inputs(step: &Step) -> Vec<Input> {
    let all = topological(step.roots().into_iter().chain(step.updates.iter().map(|(t, _)| t.clone())));
    all.iter().filter_map(|t| t.op_as::<Input>().cloned()).collect()
}

/// Runs one step on the reference: outputs by name, updates written back into `bound`.
fn run(step: &Step, bound: &mut Bindings) -> HashMap<String, Vec<f64>> {
    let values = evaluate(&step.roots(), bound).unwrap_or_else(|e| panic!("{e}"));
    let (outputs, updates) = values.split_at(step.outputs.len());
    for ((target, _), value) in step.updates.iter().zip(updates) {
        let shape = target.shape();
        let whole = Array::from_fn(shape, |e, c| value.lane(shape, e, c));
        bound.insert(target.input_name().unwrap().to_string(), whole);
    }
    step.outputs.iter().zip(outputs).map(|((name, _), v)| (name.clone(), v.f().to_vec())).collect()
}

fn close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance, "{what} [{i}]: {f} instead of {e}, tolerance {tolerance}");
    }
}

fn check(case: &Value) {
    let (input, output) = (&case["inputs"], &case["outputs"]);
    let name = case["name"].as_str().unwrap();
    // The official code adds 1e-8 to the denominator before rotating and shifting, this one after: 1e-8 of a coordinate.
    let tolerance = |key: &str| case["tolerance_abs"][key]["f64"].as_f64().unwrap().max(2e-8);
    let settings = settings(case);
    let grid = Grid {
        height: input["H"].as_u64().unwrap() as usize,
        width: input["W"].as_u64().unwrap() as usize,
        crop: settings.data.patch_crop,
    };
    let rows = |key: &str| input[key].as_array().unwrap().iter().map(numbers).collect::<Vec<_>>();
    let perturbation = Perturbation {
        order: String::new(),
        homography: rows("homo_pert").iter().map(|r| std::array::from_fn(|i| r[i])).collect(),
        rotation: rows("rot_pert").iter().map(|r| [r[0]]).collect(),
        translation: rows("trans_pert").iter().map(|r| [r[0], r[1]]).collect(),
    };
    let truth = perturbation.transforms();
    let data = PlanarData { photo: photo(&input["image"]), grid, perturbation, truth };
    let targets = data.targets();

    // The official layout is [patch, channel, row, column].
    let pixels = grid.crop_pixels();
    let patches: Vec<f64> =
        (0..targets.len() * 3).map(|k| targets[k / (3 * pixels) * pixels + k % pixels][k / pixels % 3]).collect();
    close(&format!("{name}: patches"), &patches, &numbers(&output["patches"]), tolerance("patches"));

    let model = PlanarModel::new(&settings, grid, warps::of_settings(&settings, settings.data.patches));
    let step = model.train_step();
    let barf = input["model"] == "planar";
    let mut bound = Bindings::new();
    for i in inputs(&step) {
        let values = match i.role {
            Role::Parameter => formula(&input["parameters"][official(&i.name, barf)], i.name.ends_with("weight")),
            Role::State => vec![0.0; i.shape.lanes()],
            Role::Data if i.name == model::GRID => grid.crop_points().concat(),
            Role::Data => targets.concat(),
            Role::PerStep => continue,
        };
        bound.insert(i.name.clone(), Array::floats(&i.shape, values));
    }
    let losses = output["losses"].as_array().unwrap();
    for (it, expected) in losses.iter().enumerate() {
        let mut rates = Rates::at(&settings.optim, it);
        let lr = numbers(&output["lr_per_iteration"][it]);
        close(&format!("{name}: rates"), &[rates.lr_field, rates.lr_warp], &lr[..2], tolerance("lr_per_iteration"));
        if it == 0 {
            rates.progress = input["progress_first_iteration"].as_f64().unwrap();
        }
        for (key, value) in rates.inputs() {
            let shape = raygrad_compiler::Shape::new(&[], 1);
            bound.insert(key.to_string(), Array::floats(&shape, vec![value]));
        }
        let found = run(&step, &mut bound);
        let expected = numbers(expected);
        let terms = ["render", "alignment", "total"].map(|key| found.get(key).map_or(0.0, |v| v[0]));
        close(&format!("{name}: losses of step {it}"), &terms, &expected, tolerance("losses"));
        // BARF measures its parameters after the update, L2G the fit of the forward pass.
        if it == usize::from(barf) {
            let estimated = found["transform"]
                .chunks(9)
                .map(|m| Transform(nalgebra::Matrix3::from_row_iterator(m.iter().copied())));
            let errors: Vec<f64> = estimated.zip(&data.truth).map(|(e, t)| grid.corner_error(&e, t)).collect();
            let mean = errors.iter().sum::<f64>() / errors.len() as f64;
            let expected = output["corner_error_px"].as_f64().unwrap();
            close(&format!("{name}: corner error"), &[mean], &[expected], 20.0 * tolerance("corner_error_px"));
        }
        if it > 0 {
            continue;
        }
        if !output["global_matrix"].is_null() {
            let mut matrices = numbers(&output["global_matrix"]);
            if matrices.len() == 6 * settings.data.patches {
                matrices = matrices.chunks(6).flat_map(|m| [m, &[0.0, 0.0, 1.0]].concat()).collect();
            }
            // The official code leaves the first patch to a singular system.
            close(&format!("{name}: transforms"), &found["transform"], &matrices, tolerance("global_matrix"));
        }
        for (key, expected) in output["after_step1"].as_object().unwrap() {
            let i = inputs(&step).into_iter().find(|i| i.role == Role::Parameter && official(&i.name, barf) == *key);
            let i = i.unwrap_or_else(|| panic!("{name}: no parameter {key}"));
            let values = bound[&i.name].f();
            let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
            let first = numbers(&expected["first"]);
            // The transpose of our first entries, for weights.
            let columns = values.len() / shape(&input["parameters"][key])[0];
            let outs = shape(&input["parameters"][key])[0];
            let ours: Vec<f64> = (0..first.len())
                .map(|k| {
                    if key.ends_with("weight") && i.name != "warp.code" {
                        values[k % columns * outs + k / columns]
                    } else {
                        values[k]
                    }
                })
                .collect();
            let tolerance = tolerance(&format!("after_step1/{key}"));
            close(&format!("{name}: {key} after a step"), &ours, &first, tolerance);
            let norm_tolerance = tolerance * (values.len() as f64).sqrt();
            close(&format!("{name}: norm of {key}"), &[norm], &[expected["norm"].as_f64().unwrap()], norm_tolerance);
        }
    }
}

#[test]
fn five_steps_of_the_official_code() {
    let vectors: Value = serde_json::from_str(VECTORS).unwrap();
    let cases = vectors["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 4);
    cases.iter().for_each(check);
}
