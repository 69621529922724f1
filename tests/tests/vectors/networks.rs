//! Radiance field, neural image and warp network, values and all gradients.

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::mlp::{Activation, Mlp, MlpSpec};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, positional_encoding};
use raygrad_compiler::graph::{Axis, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_tests::total;
use raygrad_tests::vectors::{Bound, Case, cases, numbers, to_official};
use serde_json::Value;

/// The network `prefix` of a case, filled with its parameters.
pub fn network(case: &Case, bound: &mut Bound, spec: MlpSpec) -> Mlp {
    let mlp = Mlp::new(spec);
    for p in &mlp.parameters {
        let official = &case.input("parameters")[p.tensor.input_name().expect("a parameter has a name")];
        bound.fill(&p.tensor, &numbers(official));
    }
    mlp
}

fn skip(case: &Case, key: &str) -> Vec<usize> {
    case.numbers(key).iter().map(|n| *n as usize).collect()
}

/// The encoding of a case: raw where it has no bands.
fn encode(case: &Case, bound: &mut Bound, x: &Tensor, bands: &Value) -> Tensor {
    let Some(bands) = bands.as_u64() else { return x.clone() };
    let window = case.input("c2f");
    if window.is_null() {
        return positional_encoding(x, bands as usize, None);
    }
    let (window, progress) = (numbers(window), bound.data("progress", &[], 1, vec![case.number("progress")]));
    let weights = coarse_to_fine_weights(&progress, bands as usize, window[0], window[1]);
    positional_encoding(x, bands as usize, Some(&weights))
}

/// Compares the gradients of `scalar` for every parameter.
fn check_gradients(case: &Case, bound: &Bound, scalar: &Tensor, networks: &[&Mlp]) {
    let parameters: Vec<&Tensor> = networks.iter().flat_map(|n| &n.parameters).map(|p| &p.tensor).collect();
    let count: usize = parameters.iter().map(|p| p.shape().lanes()).sum();
    assert_eq!(count as f64, case.output("num_parameters").as_f64().expect("a count"), "{}", case.name);
    for (p, g) in parameters.iter().zip(bound.run(&grad(scalar, &parameters))) {
        let name = p.input_name().expect("a parameter has a name");
        case.check(&format!("param_grads/{name}"), &to_official(p, &g));
    }
}

#[test]
fn radiance_fields() {
    for case in cases("mlp").iter().filter(|c| c.function == "NeRF.forward") {
        let mut bound = Bound::default();
        let row = Axis::new("row", case.sizes("points")[0]);
        let points = bound.data("points", &[&row], 3, case.numbers("points"));
        let encoded = encode(case, &mut bound, &points, &case.input("posenc")["L_3D"]);
        let spec = MlpSpec::new("mlp_feat", &case.widths("layers_feat", encoded.width())).skip(&skip(case, "skip"));
        // The last feature layer has one output more: the density.
        let mut spec = spec;
        *spec.widths.last_mut().expect("layers") += 1;
        let feature_net = network(case, &mut bound, spec);
        let raw = feature_net.apply(&encoded);
        let density = match case.text("density_activ") {
            "relu" => raw.ch(0).relu(),
            _ => raw.ch(0).softplus(1.0),
        };
        let mut feature = raw.slice(1..raw.width()).relu();
        let directions = (!case.input("ray_unit").is_null()).then(|| {
            let directions = bound.data("ray_unit", &[&row], 3, case.numbers("ray_unit"));
            let encoded = encode(case, &mut bound, &directions, &case.input("posenc")["L_view"]);
            feature = concat([&feature, &encoded]);
            directions
        });
        let spec = MlpSpec::new("mlp_rgb", &case.widths("layers_rgb", feature.width())).output(Activation::Sigmoid);
        let colour_net = network(case, &mut bound, spec);
        let rgb = colour_net.apply(&feature);
        let g_rgb = bound.data("g_rgb", &[&row], 3, case.numbers("g_rgb"));
        let g_density = bound.data("g_density", &[&row], 1, case.numbers("g_density"));
        let scalar = total(&(&rgb * g_rgb)) + total(&(&density * g_density));
        let found = bound.run(&[rgb, density, scalar.clone()]);
        case.check("rgb", &found[0]);
        case.check("density", &found[1]);
        case.check("scalar", &found[2]);
        case.check("grad_points", &bound.run(&grad(&scalar, &[&points]))[0]);
        if let Some(d) = directions {
            case.check("grad_ray_unit", &bound.run(&grad(&scalar, &[&d]))[0]);
        }
        check_gradients(case, &bound, &scalar, &[&feature_net, &colour_net]);
    }
}

#[test]
fn neural_images() {
    for case in cases("mlp").iter().filter(|c| c.function == "NeuralImageFunction.forward") {
        let mut bound = Bound::default();
        let row = Axis::new("row", case.sizes("points")[0]);
        let points = bound.data("points", &[&row], 2, case.numbers("points"));
        let encoded = encode(case, &mut bound, &points, case.input("L"));
        let spec = MlpSpec::new("mlp", &case.widths("layers", encoded.width())).skip(&skip(case, "skip"));
        let mlp = network(case, &mut bound, spec.output(Activation::Sigmoid));
        let rgb = mlp.apply(&encoded);
        let g = bound.data("g_rgb", &[&row], 3, case.numbers("g_rgb"));
        let scalar = total(&(&rgb * g));
        let found = bound.run(&[rgb, scalar.clone(), grad(&scalar, &[&points]).remove(0)]);
        case.check("rgb", &found[0]);
        case.check("scalar", &found[1]);
        case.check("grad_points", &found[2]);
        check_gradients(case, &bound, &scalar, &[&mlp]);
    }
}

#[test]
fn warp_networks() {
    for case in cases("mlp").iter().filter(|c| c.function == "localWarp.forward") {
        let mut bound = Bound::default();
        let size = case.sizes("inputs");
        let row = Axis::new("row", size[0]);
        let inputs = bound.data("inputs", &[&row], size[1], case.numbers("inputs"));
        let spec = MlpSpec::new("mlp_warp", &case.widths("layers_warp", size[1])).skip(&skip(case, "skip_warp"));
        let mlp = network(case, &mut bound, spec);
        let out = mlp.apply(&inputs);
        let g = bound.data("g_out", &[&row], out.width(), case.numbers("g_out"));
        let scalar = total(&(&out * g));
        let found = bound.run(&[out, scalar.clone(), grad(&scalar, &[&inputs]).remove(0)]);
        case.check("out", &found[0]);
        case.check("scalar", &found[1]);
        case.check("grad_inputs", &found[2]);
        check_gradients(case, &bound, &scalar, &[&mlp]);
    }
}
