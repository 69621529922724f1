//! Planar grids, warps, patches, global alignment and complete training steps.

use super::networks::network;
use raygrad_compiler::autodiff::{grad, vjp};
use raygrad_compiler::functions::adam::{Adam, Moments, StepScalars};
use raygrad_compiler::functions::homography::{Solver, fit_homography};
use raygrad_compiler::functions::image::{ImageTable, isotropic_to_pixels};
use raygrad_compiler::functions::lie::{se2_exp, sl3_exp, so2_exp};
use raygrad_compiler::functions::loss::mean_squared_error;
use raygrad_compiler::functions::matrix::{apply, apply_affine, apply_homography};
use raygrad_compiler::functions::mlp::{Activation, MlpSpec};
use raygrad_compiler::functions::posenc::{coarse_to_fine_weights, encoded_width, positional_encoding};
use raygrad_compiler::functions::rigid_fit::{fit_rigid_2d, fit_rotation_2d, fit_translation};
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::reference::{Array, evaluate};
use raygrad_tests::vectors::{Bound, Case, cases, numbers, to_official};
use std::ops::Range;

/// Isotropic coordinates of the pixels in `rows` x `columns` of an image of height `h` and width `w`, row by row.
fn grid(h: usize, w: usize, rows: Range<usize>, columns: Range<usize>) -> Vec<f64> {
    let m = h.max(w) as f64;
    let place = |i: usize, size: usize| ((i as f64 + 0.5) / size as f64 * 2.0 - 1.0) * size as f64 / m;
    let columns = &columns;
    rows.flat_map(|i| columns.clone().flat_map(move |j| [place(j, w), place(i, h)])).collect()
}

/// The central part of `0..size` of length `crop`, rounded down to even.
fn centre(size: usize, crop: usize) -> Range<usize> {
    size / 2 - crop / 2..size / 2 + crop / 2
}

fn crop_grid(case: &Case) -> Vec<f64> {
    let (h, w) = (case.count("H"), case.count("W"));
    grid(h, w, centre(h, case.count("H_crop")), centre(w, case.count("W_crop")))
}

/// Corners of the crop, ends one past the last pixel: (x0, y0), (x0, y1), (x1, y1), (x1, y0).
fn corners(case: &Case) -> Vec<f64> {
    let (h, w) = (case.count("H"), case.count("W"));
    let (rows, columns) = (centre(h, case.count("H_crop")), centre(w, case.count("W_crop")));
    let at = |i: usize, j: usize| grid(h, w, i..i + 1, j..j + 1);
    let places =
        [(rows.start, columns.start), (rows.end, columns.start), (rows.end, columns.end), (rows.start, columns.end)];
    places.iter().flat_map(|(i, j)| at(*i, *j)).collect()
}

/// Points moved by a warp of a type: translation, rotation, rigid or homography.
fn warp(kind: &str, parameter: &Tensor, points: &Tensor) -> Tensor {
    match kind {
        "translation" => points + parameter,
        "rotation" => apply(&so2_exp(parameter), points),
        "rigid" => apply_affine(&se2_exp(parameter), points),
        _ => apply_homography(&sl3_exp(parameter), points),
    }
}

/// Points moved by the perturbation of a case: homography, then rotation, then translation.
fn perturb(case: &Case, bound: &mut Bound, frame: &Axis, points: &Tensor) -> Tensor {
    let mut moved = points.clone();
    for (kind, key) in [("homography", "homo_pert"), ("rotation", "rot_pert"), ("translation", "trans_pert")] {
        let parameter = bound.data(key, &[frame], case.sizes(key)[1], case.numbers(key));
        moved = warp(kind, &parameter, &moved);
    }
    moved
}

/// The patches of a case, `[frame, point] x 3`: its image under the perturbed grid.
fn patches(case: &Case, bound: &mut Bound, frame: &Axis, points: &Tensor) -> Tensor {
    let (h, w) = (case.count("H"), case.count("W"));
    let texel = Axis::new("texel", h * w);
    let planes = case.numbers("image");
    let pixels = (0..h * w * 3).map(|i| planes[i % 3 * h * w + i / 3]).collect();
    let pixels = bound.data("image", &[&texel], 3, pixels);
    let table = ImageTable { pixels, texel, width: w, height: h };
    let moved = perturb(case, bound, frame, points);
    table.bilinear(&isotropic_to_pixels(&moved, w, h))
}

/// `[frame, point, channel]` in the official order `[frame, channel, point]`.
fn planes(values: &[f64], points: usize) -> Vec<f64> {
    values.chunks(3 * points).flat_map(|f| (0..3 * points).map(|i| f[i % points * 3 + i / points])).collect()
}

#[test]
fn grids_and_corners() {
    for case in cases("planar_grid") {
        let (h, w) = match case.input("H").as_u64() {
            Some(_) => (case.count("H"), case.count("W")),
            None => continue,
        };
        if case.function == "get_normalized_pixel_grid" {
            case.check("grid", &grid(h, w, 0..h, 0..w));
        } else if case.function == "get_normalized_pixel_grid_crop" {
            case.check("grid", &crop_grid(&case));
        } else if case.name.starts_with("corners") {
            let mut bound = Bound::default();
            let (frame, corner) = (Axis::new("frame", case.sizes("homo_pert")[0]), Axis::new("corner", 4));
            let points = bound.data("points", &[&corner], 2, corners(&case));
            let moved = perturb(&case, &mut bound, &frame, &points);
            let found = bound.run(&[moved.clone(), isotropic_to_pixels(&moved, w, h)]);
            case.check("corners", &found[0]);
            case.check("corners_px", &found[1]);
            let crop = crop_grid(&case);
            case.check("crop_first", &crop[..2]);
            case.check("crop_last", &crop[crop.len() - 2..]);
            case.check("crop_count", &[crop.len() as f64 / 2.0]);
        }
    }
}

#[test]
fn warps() {
    for case in cases("planar_grid").iter().filter(|c| c.name.starts_with("warp")) {
        let mut bound = Bound::default();
        let size = case.sizes("points");
        let (frame, point, corner) = (Axis::new("frame", size[0]), Axis::new("point", size[1]), Axis::new("corner", 4));
        let parameter = bound.data("param", &[&frame], case.sizes("param")[1], case.numbers("param"));
        let points = bound.data("points", &[&frame, &point], 2, case.numbers("points"));
        let g = bound.data("g", &[&frame, &point], 2, case.numbers("g"));
        let ends = bound.data("corners", &[&corner], 2, corners(case));
        let y = warp(case.text("type"), &parameter, &points);
        let slopes = vjp(&y, &g, &[&parameter, &points]);
        let moved = warp(case.text("type"), &parameter, &ends);
        let found = bound.run(&[y, slopes[0].clone(), slopes[1].clone(), moved]);
        for (output, value) in ["y", "grad_param", "grad_points", "corners"].iter().zip(&found) {
            case.check(output, value);
        }
    }
}

#[test]
fn sampled_patches() {
    for case in cases("planar_grid").iter().filter(|c| c.name.starts_with("patches")) {
        let mut bound = Bound::default();
        let points = crop_grid(case);
        let (frame, point) = (Axis::new("frame", case.sizes("homo_pert")[0]), Axis::new("point", points.len() / 2));
        let points = bound.data("points", &[&point], 2, points);
        let patches = patches(case, &mut bound, &frame, &points);
        case.check("patches", &planes(&bound.run(&[patches])[0], point.size()));
    }
}

/// Local warps registered to one global warp a frame.
struct Alignment {
    local: Tensor,
    matrix: Tensor,
    global: Tensor,
    loss: Tensor,
}

/// The L2G alignment of `points` under one warp `parameter` a point; `fix_first` holds frame 0 at the identity.
fn align(kind: &str, parameter: &Tensor, points: &Tensor, frame: &Axis, point: &Axis, fix_first: bool) -> Alignment {
    let over = Axes::new([point.clone()]);
    let first = Tensor::index(frame).equal(&Tensor::integers(&[0]));
    let held = if fix_first { first.select(&Tensor::scalar(0.0), parameter) } else { parameter.clone() };
    // The local warp of a homography is rigid.
    let local = warp(if kind == "homography" { "rigid" } else { kind }, &held, points);
    let degenerate = fix_first.then_some(&first);
    let (matrix, global) = match kind {
        "rotation" => {
            let fit = fit_rotation_2d(points, &local, &over);
            (fit.clone(), apply(&fit, points))
        }
        "translation" => {
            let fit = fit_translation(points, &local, &over);
            (fit.clone(), points + &fit)
        }
        "rigid" => {
            let fit = fit_rigid_2d(points, &local, &over);
            (fit.clone(), apply_affine(&fit, points))
        }
        _ => {
            let fit = fit_homography(points, &local, &over, Solver::InverseIteration, degenerate);
            (fit.clone(), apply_homography(&fit, points))
        }
    };
    let loss = mean_squared_error(&local, &global);
    Alignment { local, matrix, global, loss }
}

#[test]
fn global_alignment_of_warps() {
    for case in cases("global_alignment").iter().filter(|c| c.name.starts_with("planar")) {
        let mut bound = Bound::default();
        let (points, size) = (crop_grid(case), case.sizes("warp_param"));
        let (frame, point) = (Axis::new("frame", size[0]), Axis::new("point", size[1]));
        let points = bound.data("points", &[&point], 2, points);
        let parameter = bound.data("warp_param", &[&frame, &point], size[2], case.numbers("warp_param"));
        let fix_first = case.input("fix_first").as_bool().expect("a flag");
        let a = align(case.text("type"), &parameter, &points, &frame, &point, fix_first);
        let slope = grad(&a.loss, &[&parameter]).remove(0);
        let found = bound.run(&[a.loss, slope, a.local, a.global, a.matrix]);
        let outputs = ["loss", "grad_warp_param", "local_points", "global_points", "global_matrix"];
        for (output, value) in outputs.iter().zip(&found) {
            case.check(output, value);
        }
    }
}

/// One parameter in training: its gradient, its update and its learning rate.
struct Trained {
    parameter: Tensor,
    moments: Moments,
    gradient: Tensor,
    updated: (Tensor, Moments),
}

#[test]
fn training_steps() {
    for case in cases("one_step").iter().filter(|c| c.name.starts_with("planar")) {
        let mut bound = Bound::default();
        let points = crop_grid(case);
        let (frame, point) = (Axis::new("frame", case.count("num_patches")), Axis::new("point", points.len() / 2));
        let points = bound.data("points", &[&point], 2, points);
        let target = patches(case, &mut bound, &frame, &points);

        let (bands, window) = (case.count("L_2D"), case.numbers("c2f"));
        let progress = Tensor::per_step("progress", Shape::new(&[], 1));
        let weights = coarse_to_fine_weights(&progress, bands, window[0], window[1]);
        let widths = case.widths("layers", encoded_width(2, bands));
        let spec = MlpSpec::new("neural_image.mlp", &widths).output(Activation::Sigmoid);
        let image = network(case, &mut bound, spec);
        let mut parameters: Vec<Tensor> = image.parameters.iter().map(|p| p.tensor.clone()).collect();
        let image_parameters = parameters.len();

        let (kind, l2g) = (case.text("type"), case.text("model") == "l2g_planar");
        let fix_first = case.input("fix_first").as_bool().expect("a flag");
        let mut alignment = None;
        let local = if l2g {
            let embedding = case.count("embedding_dim");
            let code = Tensor::parameter("warp_embedding.weight", Shape::new(&[&frame], embedding));
            bound.fill(&code, &numbers(&case.input("parameters")["warp_embedding.weight"]));
            let skip: Vec<usize> = case.numbers("skip_warp").iter().map(|n| *n as usize).collect();
            let spec = MlpSpec::new("warp_mlp.mlp_warp", &case.widths("layers_warp", 2 + embedding)).skip(&skip);
            let mlp = network(case, &mut bound, spec);
            let out = mlp.apply(&concat([&points, &code]));
            parameters.push(code);
            parameters.extend(mlp.parameters.iter().map(|p| p.tensor.clone()));
            alignment.insert(align(kind, &out, &points, &frame, &point, fix_first)).local.clone()
        } else {
            let size = case.input("dof").as_u64().expect("degrees of freedom") as usize;
            let parameter = Tensor::parameter("warp_param.weight", Shape::new(&[&frame], size));
            bound.fill(&parameter, &numbers(&case.input("parameters")["warp_param.weight"]));
            parameters.push(parameter.clone());
            warp(kind, &parameter, &points)
        };
        let rgb = image.apply(&positional_encoding(&local, bands, Some(&weights)));
        let render = mean_squared_error(&rgb, &target);
        let global = alignment.as_ref().map_or(Tensor::scalar(0.0), |a| a.loss.clone());
        let exponent = case.input("loss_weight")["global_alignment"].as_f64();
        let loss = &render + &global * exponent.map_or(0.0, |w| 10f64.powf(w));

        let adam = Adam::default();
        let scalar = |name: &str| Tensor::per_step(name, Shape::new(&[], 1));
        let step = |lr: &str| StepScalars { lr: scalar(lr), bias1: scalar("bias1"), bias2: scalar("bias2") };
        let gradients = grad(&loss, &parameters.iter().collect::<Vec<_>>());
        let trained: Vec<Trained> = parameters
            .into_iter()
            .zip(gradients)
            .enumerate()
            .map(|(i, (parameter, gradient))| {
                let moments = Moments::of(&parameter);
                let lr = step(if i < image_parameters { "lr" } else { "lr_warp" });
                let updated = adam.update(&parameter, &gradient, &moments, &lr);
                for m in [&moments.m, &moments.v] {
                    bound.bindings.insert(m.input_name().expect("a state").into(), Array::zeros(m.shape()));
                }
                Trained { parameter, moments, gradient, updated }
            })
            .collect();

        let mut first = vec![target, rgb];
        first.extend(alignment.map(|a| a.matrix));
        set(&mut bound, "progress", case.number("progress_first_iteration"));
        let found = bound.run(&first);
        case.check("patches", &planes(&found[0], point.size()));
        let colours: Vec<f64> = found[1].chunks(3 * point.size()).flat_map(|f| f[..9].to_vec()).collect();
        case.check("rgb_first_pixels", &colours);
        if let Some(matrix) = found.get(2) {
            case.check("global_matrix", matrix);
        }
        train(case, &mut bound, &adam, &[render, global, loss], &trained, !l2g && fix_first);
    }
}

fn set(bound: &mut Bound, name: &str, value: f64) {
    bound.bindings.insert(name.into(), Array::floats(&Shape::new(&[], 1), vec![value]));
}

/// Five iterations; `reset_first` zeroes the parameters of frame 0 (those without layers) after each.
fn train(case: &Case, bound: &mut Bound, adam: &Adam, losses: &[Tensor; 3], trained: &[Trained], reset_first: bool) {
    let iterations = case.count("max_iter") as f64;
    let rate = |key: &str, it: usize| {
        let start = case.number(key);
        let end = case.input(&format!("{key}_end")).as_f64().unwrap_or(start);
        start * (end / start).powf(it as f64 / iterations)
    };
    let (mut found_losses, mut rates) = (vec![], vec![]);
    for it in 0..5 {
        if it > 0 {
            set(bound, "progress", it as f64 / iterations);
        }
        let (lr, lr_warp) = (rate("lr", it), rate("lr_warp", it));
        set(bound, "lr", lr);
        set(bound, "lr_warp", lr_warp);
        rates.push(lr);
        // The official optimiser of the L2G warp has two groups: embedding and network.
        rates.extend(vec![lr_warp; if reset_first { 1 } else { 2 }]);
        let (bias1, bias2) = adam.bias_corrections(it as u64 + 1);
        set(bound, "bias1", bias1);
        set(bound, "bias2", bias2);
        let mut roots = losses.to_vec();
        for t in trained {
            roots.extend([t.gradient.clone(), t.updated.0.clone(), t.updated.1.m.clone(), t.updated.1.v.clone()]);
        }
        let values = evaluate(&roots, &bound.bindings).unwrap_or_else(|e| panic!("{e}"));
        found_losses.extend(values[..3].iter().map(|v| v.f()[0]));
        for (t, new) in trained.iter().zip(values[3..].chunks(4)) {
            let name = t.parameter.input_name().expect("a parameter has a name");
            let mut updated = new[1].clone();
            if reset_first && name == "warp_param.weight" {
                updated.f_mut()[..t.parameter.width()].fill(0.0);
            }
            if it == 0 {
                case.check(&format!("param_grads/{name}"), &to_official(&t.parameter, new[0].f()));
                case.check(&format!("after_step1/{name}"), &to_official(&t.parameter, updated.f()));
            }
            bound.bindings.insert(name.into(), updated);
            for (state, value) in [(&t.moments.m, &new[2]), (&t.moments.v, &new[3])] {
                bound.bindings.insert(state.input_name().expect("a state").into(), value.clone());
            }
        }
    }
    case.check("losses", &found_losses);
    case.check("lr_per_iteration", &rates);
}
