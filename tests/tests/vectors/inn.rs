//! The invertible warp: encoding, map, inverse, gradients, annealing, activations, rigidity prior.

use raygrad::config::{Anneal, Dof, InnSettings, Layered, WarpSettings};
use raygrad::training::optimise::STEP;
use raygrad::warps::{InvertibleWarp, Points, Registration, Warp};
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, frequency_encoding};
use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::reference::Array;
use raygrad_compiler::scalar::DType;
use raygrad_tests::total;
use raygrad_tests::vectors::{Bound, Case, cases, numbers, to_official};

/// Steps until all frequencies are open: annealing states are given in thousandths of them.
const ANNEAL_STEPS: usize = 1000;

#[test]
fn encodings() {
    for case in cases("inn").iter().filter(|c| c.name.starts_with("embedder")) {
        let mut bound = Bound::default();
        let size = case.sizes("x");
        let x = bound.data("x", &[&Axis::new("point", size[0])], size[1], case.numbers("x"));
        let alpha = bound.data("alpha", &[], 1, vec![case.number("alpha")]);
        let bands = case.count("multires");
        let encoded = frequency_encoding(&x, bands, Some(&coarse_to_fine_weights(&alpha, bands, 0.0, 1.0)));
        case.check("encoding", &bound.run(&[encoded])[0]);
    }
}

fn settings(case: &Case) -> WarpSettings {
    let mut layered = Layered::load("planar-inn").expect("a preset");
    layered.set(&format!("warp.activation={}", case.text("activation"))).expect("an activation");
    let warp = layered.settings.warp;
    let anneal = match case.text("annealing") {
        "channels" => Anneal::Channels,
        _ => Anneal::PointSlots,
    };
    let (blocks, hidden) = (case.count("n_blocks"), case.count("d_hidden"));
    let inn = InnSettings { blocks, hidden, anneal, anneal_steps: ANNEAL_STEPS, ..warp.inn };
    WarpSettings { dof: Dof::Pose, code: case.count("d_feature"), bands: case.count("multires"), inn, ..warp }
}

/// The published code's name of a parameter.
fn official(name: &str) -> String {
    let parts: Vec<&str> = name.split('.').collect();
    match parts[..] {
        [_, block, "code", what] => format!("lin{block}_c.{what}"),
        [_, block, net, "hidden", "direction"] => format!("lin{block}_{net}_0.weight_v"),
        [_, block, net, "hidden", "length"] => format!("lin{block}_{net}_0.weight_g"),
        [_, block, net, "hidden", what] => format!("lin{block}_{net}_0.{what}"),
        [_, block, net, _, what] => format!("lin{block}_{net}_1.{what}"),
        _ => panic!("{name} is no parameter of an invertible network"),
    }
}

#[test]
fn networks() {
    for case in cases("inn").iter().filter(|c| c.function == "DeformNetwork.forward / inverse") {
        let mut bound = Bound::default();
        let warp = InvertibleWarp::new(&settings(case), None);
        for p in warp.parameters() {
            let values = &case.input("parameters")[official(p.tensor.input_name().expect("a parameter has a name"))];
            bound.fill(&p.tensor, &numbers(values));
        }
        let step = (case.number("alpha") * ANNEAL_STEPS as f64).round() as u32;
        let shape = Shape::new(&[], 1).with_dtype(DType::U32);
        bound.bindings.insert(STEP.into(), Array::integers(&shape, vec![step]));
        let size = case.sizes("points");
        let (frame, point) = (Axis::new("frame", size[0]), Axis::new("point", size[1]));
        let points = bound.data("points", &[&frame, &point], 3, case.numbers("points"));
        let code = bound.data("code", &[&frame], case.sizes("code")[1], case.numbers("code"));
        let g = bound.data("g", &[&frame, &point], 3, case.numbers("g"));
        let at = Points::planar(frame, point, points.clone());
        let y = warp.forward(&at, &points, &code);
        let scalar = total(&(&y * g));
        let back = warp.inverse(&at, &y, &code);
        let slopes = grad(&scalar, &[&points, &code]);
        let found = bound.run(&[y, scalar.clone(), slopes[0].clone(), slopes[1].clone(), back]);
        for (output, value) in ["y", "scalar", "grad_points", "grad_code", "inverse_of_y"].iter().zip(&found) {
            case.check(output, value);
        }
        let parameters: Vec<Tensor> = warp.parameters().into_iter().map(|p| p.tensor).collect();
        let count: usize = parameters.iter().map(|p| p.shape().lanes()).sum();
        assert_eq!(count as f64, case.output("num_parameters").as_f64().expect("a count"), "{}", case.name);
        for (p, g) in parameters.iter().zip(bound.run(&grad(&scalar, &parameters.iter().collect::<Vec<_>>()))) {
            let name = official(p.input_name().expect("a parameter has a name"));
            case.check(&format!("param_grads/{name}"), &to_official(p, &g));
        }
    }
}

/// Points as they are.
#[derive(Debug)]
struct Given(Tensor);

impl Warp for Given {
    fn map(&self, _: &Points, _: &Tensor) -> Tensor {
        self.0.clone()
    }
    fn dof(&self) -> Dof {
        Dof::Pose
    }
}

#[test]
fn rigidity_prior() {
    for case in cases("inn").iter().filter(|c| c.name == "rigid_prior") {
        let mut bound = Bound::default();
        let size = case.sizes("source");
        let (frame, point) = (Axis::new("frame", size[0]), Axis::new("point", size[1]));
        let source = bound.data("source", &[&frame, &point], 3, case.numbers("source"));
        let warped = bound.data("warped", &[&frame, &point], 3, case.numbers("warped"));
        let at = Points::planar(frame, point, source);
        let found = Registration::new(&Given(warped.clone()), &at, None, &Tensor::scalar(0.0), false);
        let loss = found.residual.expect("a fitted warp has a residual");
        let slope = grad(&loss, &[&warped]).remove(0);
        let values = bound.run(&[loss, slope, found.transform]);
        for (output, value) in ["loss", "grad_warped", "pose"].iter().zip(&values) {
            case.check(output, value);
        }
    }
}
