//! Measuring, exporting and showing a run that is there.

use crate::workplace::{Workplace, mentions, names, stderr};
use raygrad::evaluation::Mesh;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::Value;
use std::path::Path;

const STAGES: [(&str, &[&str], usize); 3] = [
    ("cameras", &["rotation_error_deg", "translation_error_x100"], 5),
    ("before", &["psnr_db", "ssim", "depth_error"], 2),
    ("after", &["psnr_db", "ssim", "depth_error"], 2),
];

#[test]
fn a_run_measured_again_gives_what_training_gave() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run"]);
    let read = |name: &str| std::fs::read(w.path(name)).unwrap();
    let (evaluation, cameras) = (read("run/evaluation.json"), read("run/cameras.svg"));
    std::fs::remove_file(w.path("run/evaluation.json")).unwrap();
    let args = ["eval", "run", "--json", "--csv", "views.csv", "--latex", "table.tex", "--threads", "2"];
    let printed: Value = serde_json::from_str(&w.succeed(&args)).unwrap();
    assert_eq!((read("run/evaluation.json"), read("run/cameras.svg")), (evaluation, cameras));
    let written = w.json("run/evaluation.json");
    for (stage, keys, views) in STAGES {
        assert_eq!(printed[stage], written[stage]);
        assert_eq!(printed[stage]["views"].as_array().unwrap().len(), views);
        for key in keys {
            assert!(printed[stage]["mean"][key].as_f64().unwrap() > 0.0, "{stage} {key}: {printed}");
        }
    }
    assert_eq!((&printed["step"], &printed["steps"]), (&Value::from(6), &Value::from(6)));
    let psnr = printed["after"]["mean"]["psnr_db"].as_f64().unwrap();
    mentions(&String::from_utf8(read("views.csv")).unwrap(), &["scene,l2g,after,mean,,,", &psnr.to_string()]);
    mentions(&String::from_utf8(read("table.tex")).unwrap(), &["\\begin{tabular}", &format!("{psnr:.2}")]);
    mentions(&w.succeed(&["eval", "run"]), &["step 6 of 6", "rotation (deg)", &format!("{psnr:.2}")]);
}

#[test]
fn a_run_keeps_the_files_it_started_from() {
    let w = Workplace::in_space();
    for (preset, key, name) in
        [("space.toml", "scene.poses=", "initial_poses.json"), ("tiny.toml", "data.perturbation=", "perturbation.json")]
    {
        let (first, second) = (format!("{preset}-1"), format!("{preset}-2"));
        w.succeed(&["train", preset, "--out", &first, "--steps", "1", "--seed", "3"]);
        std::fs::rename(w.path(&first).join(name), w.path(name)).unwrap();
        w.succeed(&["train", preset, "--out", &second, "--steps", "2", "--set", &format!("{key}{name}")]);
        std::fs::remove_file(w.path(name)).unwrap();
        let found = w.json(&format!("{second}/evaluation.json"));
        w.succeed(&["eval", &second]);
        assert_eq!(w.json(&format!("{second}/evaluation.json")), found);
    }
}

/// Weights of the right shapes that mean nothing.
fn write_weights(path: &Path) {
    let sizes = [(3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3)];
    let mut tensors: Vec<(String, Vec<usize>)> = vec![];
    for (i, (inputs, outputs, side)) in sizes.into_iter().enumerate() {
        tensors.push((format!("conv{}.weight", i + 1), vec![outputs, inputs, side, side]));
        tensors.push((format!("conv{}.bias", i + 1), vec![outputs]));
        tensors.push((format!("lin{i}.weight"), vec![1, outputs, 1, 1]));
    }
    let bytes = |(name, shape): &(String, Vec<usize>)| -> Vec<u8> {
        let value = |i: usize| if name.starts_with("lin") { 0.01 } else { (i as f32 * 12.9898).sin() * 0.05 };
        (0..shape.iter().product()).flat_map(|i| value(i).to_le_bytes()).collect()
    };
    let data: Vec<Vec<u8>> = tensors.iter().map(bytes).collect();
    let views = tensors.iter().zip(&data);
    let views = views.map(|((n, shape), data)| (n, TensorView::new(Dtype::F32, shape.clone(), data).unwrap()));
    std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
}

#[test]
fn lpips_is_measured_where_weights_are_given() {
    let w = Workplace::in_space();
    write_weights(&w.path("weights.safetensors"));
    let larger = ["--set", "scene.image_size=[32,32]", "--steps", "1", "--lpips", "weights.safetensors"];
    w.succeed(&[&["train", "space.toml", "--out", "run"], &larger[..]].concat());
    let trained = w.json("run/evaluation.json");
    assert!(trained["before"]["mean"]["lpips"].as_f64().unwrap() > 0.0, "{trained}");
    let text = w.succeed(&["eval", "run", "--json", "--lpips", "weights.safetensors"]);
    let again: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(again["after"], trained["after"]);
    let without: Value = serde_json::from_str(&w.succeed(&["eval", "run", "--json"])).unwrap();
    assert!(without["after"]["mean"]["lpips"].is_null());
    // A sweep measures finished runs that lack it.
    let grid = "presets = [\"space.toml\"]\nset.optim.steps = 1\nset.scene.image_size = [32, 32]\n";
    std::fs::write(w.path("grid.toml"), grid).unwrap();
    assert!(!w.succeed(&["sweep", "grid.toml"]).contains("LPIPS"));
    let table = w.succeed(&["sweep", "grid.toml", "--lpips", "weights.safetensors"]);
    mentions(&table, &["LPIPS, before", "LPIPS, after"]);
    w.succeed(&["train", "tiny.toml", "--out", "planar", "--steps", "1"]);
    let planar = ["eval", "planar", "--lpips", "weights.safetensors"];
    mentions(&w.refuse(&planar), &["--lpips", "this one is in the plane"]);
    // Pictures too small for it, and files that are none.
    w.succeed(&["train", "space.toml", "--out", "small", "--steps", "1"]);
    mentions(&w.refuse(&["eval", "small", "--lpips", "weights.safetensors"]), &["16 x 16", "31 x 31"]);
    mentions(&w.refuse(&["eval", "run", "--lpips", "run/config.toml"]), &["not in the safetensors format"]);
    let checkpoint = "run/checkpoint-0000001.safetensors";
    mentions(&w.refuse(&["eval", "run", "--lpips", checkpoint]), &["lack the tensor `conv1.weight`"]);
    let train = |weights| w.refuse(&["train", "space.toml", "--out", "new", "--lpips", weights]);
    mentions(&train("weights.safetensors"), &["16 x 16", "31 x 31"]);
    mentions(&train("no.st"), &["no.st"]);
    assert!(!w.path("new").exists());
}

#[test]
fn a_mesh_and_its_distance_to_a_cloud() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run"]);
    let grid = ["eval", "run", "--mesh-threshold", "0.6", "--mesh-resolution", "16"];
    let eval = |more: &[&'static str]| [&grid[..], more].concat();
    mentions(&w.succeed(&eval(&["--mesh", "whole.ply"])), &["triangles in whole.ply"]);
    let mesh = Mesh::read_ply(&w.path("whole.ply")).unwrap();
    assert!(!mesh.triangles.is_empty() && mesh.vertices.as_flattened().iter().all(|x| x.abs() <= 1.2));
    // Two draws of points from one surface lie nearer to each other than the grid's points.
    let found: Value = serde_json::from_str(&w.succeed(&eval(&["--cloud", "whole.ply", "--json"]))).unwrap();
    assert_eq!(found["mesh"]["triangles"], mesh.triangles.len());
    let distance = found["mesh"]["chamfer"]["mean"].as_f64().unwrap();
    assert!(distance > 0.0 && distance < 2.4 / 16.0, "{distance}");
    // It is a number of the run like any other.
    assert_eq!(w.json("run/evaluation.json")["cameras"]["mean"]["chamfer"], distance);
    let files = ["--cloud", "whole.ply", "--csv", "views.csv", "--latex", "table.tex"];
    mentions(&w.succeed(&eval(&files)), &["Chamfer distance", &format!("{distance:.3}")]);
    mentions(&std::fs::read_to_string(w.path("table.tex")).unwrap(), &["Chamfer distance", &format!("{distance:.3}")]);
    let csv = std::fs::read_to_string(w.path("views.csv")).unwrap();
    assert!(csv.lines().any(|l| l.contains(",cameras,mean,") && l.ends_with(&format!(",{distance}"))), "{csv}");
    mentions(&stderr(&w.run(&["eval", "run"])), &["had a Chamfer distance", "--cloud"]);
    w.succeed(&eval(&["--mesh", "part.obj", "--mesh-bounds", "-1,1,-1,1,-0.5,0.5"]));
    let text = std::fs::read_to_string(w.path("part.obj")).unwrap();
    let height = |l: &str| l.strip_prefix("v ").and_then(|l| l.rsplit(' ').next()?.parse::<f64>().ok());
    assert!(text.lines().filter_map(height).all(|z| z.abs() <= 0.5) && text.starts_with("v "));
    let refuse = |args: &[&str]| w.refuse(&[&["eval", "run", "--mesh-resolution", "8"], args].concat());
    mentions(&refuse(&["--mesh", "no.ply", "--mesh-threshold", "1e6"]), &["above the threshold 1000000", "lower"]);
    mentions(&refuse(&["--mesh", "no.ply", "--mesh-bounds", "1,-1"]), &["bounds are empty"]);
    mentions(&refuse(&["--mesh", "no.ply", "--mesh-bounds", "1,2,3"]), &["--mesh-bounds", "found 3"]);
    mentions(&refuse(&["--cloud", "nowhere.ply"]), &["nowhere.ply"]);
    assert_eq!(w.run(&["eval", "run", "--mesh", "no.stl"]).status.code(), Some(2));
    for option in [["--mesh-resolution", "8"], ["--mesh-threshold", "1"], ["--mesh-bounds", "-1,1"]] {
        let output = w.run(&["eval", "run", option[0], option[1]]);
        assert_eq!(output.status.code(), Some(2), "{option:?}");
        mentions(&stderr(&output), &["required", "--mesh <FILE>", "--cloud <PLY>"]);
    }
    mentions(&w.succeed(&eval(&["--mesh", "both.ply", "--cloud", "whole.ply"])), &["both.ply", "chamfer"]);
    assert!(!w.path("no.ply").exists());
}

#[test]
fn cameras_for_other_programs_are_those_found() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run"]);
    w.succeed(&["export", "run", "--out", "out/cameras"]);
    let found = w.json("run/poses.json");
    let transforms = w.json("out/cameras/transforms.json");
    let frames = transforms["frames"].as_array().unwrap();
    assert_eq!((frames.len(), &transforms["w"]), (5, &Value::from(16)));
    for (i, frame) in frames.iter().enumerate() {
        let view = found["views"][i].as_str().unwrap().trim_start_matches("./");
        assert_eq!(frame["file_path"], format!("{view}.png"));
        let aligned = |j: usize| found["aligned"][i][j].as_f64().unwrap();
        for axis in 0..3 {
            // c = -R^T t; the world of this scene's files is the one it is loaded into.
            let center = -(0..3).map(|k| aligned(4 * k + axis) * aligned(4 * k + 3)).sum::<f64>();
            assert!((frame["transform_matrix"][axis][3].as_f64().unwrap() - center).abs() < 1e-9);
        }
    }
    let images = std::fs::read_to_string(w.path("out/cameras/colmap/images.txt")).unwrap();
    assert_eq!(images.lines().filter(|l| l.contains("/r_")).count(), 5);
    let bytes = std::fs::read(w.path("out/cameras/poses_bounds.npy")).unwrap();
    assert_eq!(npyz::NpyFile::new(&bytes[..]).unwrap().shape(), [5, 17]);
    w.succeed(&["export", "run", "--out", "one", "--format", "colmap"]);
    // Squeezed for training, they are for the files all the same.
    w.succeed(&["train", "space.toml", "--out", "flat", "--steps", "1", "--set", "scene.image_size=[8,12]"]);
    w.succeed(&["export", "flat", "--out", "out/flat"]);
    let flat = w.json("out/flat/transforms.json");
    let lens = |json: &Value| ["w", "h", "fl_x", "fl_y"].map(|key| json[key].as_f64().unwrap());
    assert!(lens(&flat).iter().zip(lens(&transforms)).all(|(a, b)| (a - b).abs() < 1e-9), "{flat}");
    std::fs::remove_dir_all(w.path("flat")).unwrap();
    assert_eq!(names(&w.path("one")), ["colmap"]);
}

#[test]
fn novel_views_make_a_video() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run", "--steps", "1"]);
    let text = w.succeed(&["video", "run", "--frames", "3", "--out", "video"]);
    assert_eq!(text.lines().count(), 2);
    for line in text.lines() {
        assert!(std::fs::metadata(w.path(line)).unwrap().len() > 0, "{line}");
    }
    mentions(&w.refuse(&["video", "run", "--frames", "0"]), &["at least one frame"]);
}

#[test]
fn a_planar_run_is_measured_by_its_corners() {
    let w = Workplace::new();
    w.succeed(&["train", "tiny.toml", "--out", "run"]);
    let last = w.json("run/metrics.json")["final"].clone();
    let found: Value = serde_json::from_str(&w.succeed(&["eval", "run", "--json"])).unwrap();
    let mean = &found["cameras"]["mean"];
    assert_eq!(mean["patch_psnr_db"], last["patch_psnr_db"]);
    let (ours, theirs) = (mean["corner_error_px"].as_f64().unwrap(), &last["corner_error_px"]);
    assert!((ours - theirs["mean"].as_f64().unwrap()).abs() < 1e-9);
    assert_eq!(mean["success"].as_f64().unwrap(), f64::from(u8::from(ours < 5.0 * 16.0 / 480.0)));
    for (i, patch) in found["cameras"]["views"].as_array().unwrap().iter().enumerate() {
        assert_eq!(patch["corner_error_px"], theirs["per_patch"][i]);
    }
    mentions(&w.succeed(&["eval", "run"]), &["corner error (px)", "patch PSNR", "success", "patches (px)"]);
    for command in [&["export", "run", "--out", "x"][..], &["video", "run"], &["eval", "run", "--mesh", "m.ply"]] {
        mentions(&w.refuse(command), &["one of the plane, without cameras"]);
    }
    mentions(&w.refuse(&["eval", "run", "--fit-grid", "3"]), &["in the plane"]);
    mentions(&w.refuse(&["eval", "run", "--data", "x"]), &["in the plane", "`--image`"]);
    mentions(&w.refuse(&["eval", "run", "--image", "x.png"]), &["there is no x.png", "`--image`"]);
}

#[test]
fn runs_that_are_none() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run", "--steps", "1"]);
    std::fs::create_dir(w.path("empty")).unwrap();
    for command in [&["eval"][..], &["video"], &["export", "--out", "x"]] {
        let refuse = |run: &'static str| w.refuse(&[command, &[run]].concat());
        mentions(&refuse("nowhere"), &["no run in nowhere", "no such folder"]);
        mentions(&refuse("empty"), &["no run in empty", "config.toml"]);
        mentions(&refuse("tiny.toml"), &["tiny.toml is not a folder"]);
    }
    // The same folder, seen from elsewhere.
    let here = w.path("scene").display().to_string();
    w.succeed(&["train", "space.toml", "--out", "run", "--steps", "1", "--resume", "--data", &here]);
    // A scene that has moved is found again by hand.
    std::fs::rename(w.path("scene"), w.path("moved")).unwrap();
    mentions(&w.refuse(&["eval", "run"]), &["there is no scene", "`--data`"]);
    w.succeed(&["eval", "run", "--data", "moved"]);
    assert_eq!(w.json("run/evaluation.json")["scene"], "scene", "it is the same one");
    mentions(&w.refuse(&["eval", "run", "--data", "moved", "--image", "x.png"]), &["in space", "`--data`"]);
    mentions(&w.refuse(&["eval", "run", "--data", "moved", "--fit-grid", "999"]), &["`train.fit_grid`", "at most 128"]);
    w.succeed(&["eval", "run", "--data", "moved", "--fit-grid", "3"]);
    for (option, file) in [("--csv", "none/x.csv"), ("--latex", "empty"), ("--mesh", "none/x.ply")] {
        mentions(&w.refuse(&["eval", "run", "--data", "moved", option, file]), &["cannot write", file]);
    }
    mentions(
        &w.refuse(&["train", "space.toml", "--out", "x", "--data", "moved", "--set", "scene.poses=thruth"]),
        &["`scene.poses`", "\"truth\"", "thruth"],
    );
    mentions(&w.refuse(&["eval", "run", "--data", "empty"]), &["empty is not a scene"]);
    mentions(&w.refuse(&["eval", "run", "--data", "moved", "--device", "gpu"]), &["`raygrad devices`"]);
    std::fs::remove_file(w.path("run/checkpoint.json")).unwrap();
    mentions(&w.refuse(&["eval", "run"]), &["no run in run", "no checkpoint yet"]);
    assert_eq!(w.left_behind(), ["empty", "moved", "run"]);
}

#[test]
fn views_that_validate_and_test_are_counted_once() {
    let w = Workplace::new();
    w.succeed(&["make-scene", "scene", "--views", "12", "--size", "8"]);
    std::fs::rename(w.path("scene/transforms_train.json"), w.path("scene/transforms.json")).unwrap();
    let text = w.succeed(&["data", "scene", "--layout", "transforms"]);
    let line = |name: &str| text.lines().find_map(|l| l.strip_prefix(name)).unwrap().trim().to_string();
    let views = line("views");
    assert!(views.ends_with("(the same)"), "{text}");
    let counts: Vec<usize> = views.split(' ').filter_map(|w| w.parse().ok()).collect();
    let all = counts[0] + counts[2];
    assert!(all > counts[0], "{text}");
    assert_eq!(line("poses"), format!("{all} of {all} views"));
}
