//! Sweeps: the runs of a file, their tables, and going on where one was stopped.

use crate::workplace::{Workplace, mentions, names, stderr};
use raygrad::config::Sweep;
use raygrad::run::RunFolder;
use raygrad::{Experiment, Observer};
use std::sync::atomic::{AtomicBool, Ordering};

/// Two methods with two seeds; the second seed of the second method is the one that tests interrupt.
fn write_sweep(w: &Workplace) -> String {
    let preset = |name: &str| w.path(name).display().to_string();
    std::fs::write(w.path("slow.toml"), "base = \"planar-barf-small\"\n").unwrap();
    let text = format!(
        "presets = [\"{}\", \"{}\"]\nseeds = [0, 1]\n\
         [set]\ndata.image_size = [24, 32]\ndata.patch_crop = [10, 12]\ndata.patches = 3\ndata.points_per_patch = 40\n\
         optim.steps = 10\nfield.layers = [16, 16]\nrun.device = \"cpu\"\nrun.threads = 1\nrun.checkpoint_every = 4\n\
         [preset.slow.optim]\nlr_warp = 1e-4\n",
        preset("tiny.toml"),
        preset("slow.toml")
    );
    let path = w.path("grid.toml");
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

/// Stops a run after some steps.
struct StopAt<'a>(usize, &'a AtomicBool);

impl Observer for StopAt<'_> {
    fn step(&mut self, done: usize) {
        self.1.store(done == self.0, Ordering::Relaxed);
    }
}

#[test]
fn a_sweep_trains_all_and_goes_on_where_it_was_stopped() {
    let w = Workplace::new();
    let file = write_sweep(&w);
    let text = w.succeed(&["sweep", &file, "--out", "whole"]);
    mentions(&text, &["corner error (px)  tiny", "slow", "±", "warp error", "success", "whole/sweep.csv"]);
    let mut found = names(&w.path("whole"));
    found.sort();
    let cells = ["builtin-slow-s0", "builtin-slow-s1", "builtin-tiny-s0", "builtin-tiny-s1"];
    assert_eq!(found, [&cells[..], &["sweep.csv", "sweep.json", "sweep.tex"]].concat());
    let all = w.json("whole/sweep.json");
    let runs = all["runs"].as_array().unwrap();
    let corner = |i: usize| runs[i]["evaluation"]["cameras"]["mean"]["corner_error_px"].as_f64().unwrap();
    let csv = |sweep: &str| std::fs::read_to_string(w.path(sweep).join("sweep.csv")).unwrap();
    let mean = (corner(0) + corner(1)) / 2.0;
    mentions(&csv("whole"), &[&format!("corner_error_px,,tiny,ours,true,{mean},"), "warp_error,,tiny,ours,true,0."]);

    // One run stopped half-way, one before its first checkpoint, the others not begun.
    let sweep = Sweep::load(&w.path("grid.toml")).unwrap();
    let stop_at = |cell: usize, step: usize| {
        let (cell, stop) = (&sweep.cells[cell], AtomicBool::new(false));
        let experiment = Experiment::of(cell.layered.clone()).out(w.path("parts").join(&cell.name));
        assert!(experiment.train_observed(&mut StopAt(step, &stop), &stop).unwrap().interrupted);
    };
    stop_at(3, 6);
    stop_at(0, 2);
    std::fs::remove_file(w.path("parts/builtin-tiny-s0/checkpoint.json")).unwrap();
    w.succeed(&["sweep", &file, "--out", "parts", "--resume"]);
    assert_eq!(csv("parts"), csv("whole"));
    for cell in cells {
        let tensors =
            |sweep: &str| std::fs::read(w.path(sweep).join(cell).join("checkpoint-0000010.safetensors")).unwrap();
        assert!(tensors("parts") == tensors("whole"), "{cell}");
    }
    // Finished runs are left as they are.
    std::fs::remove_file(w.path("parts/builtin-slow-s0/report.html")).unwrap();
    w.succeed(&["sweep", &file, "--out", "parts"]);
    assert!(!w.path("parts/builtin-slow-s0/report.html").exists());
    assert_eq!(csv("parts"), csv("whole"));

    mentions(&w.refuse(&["sweep", &file, "--out", "nowhere", "--resume"]), &["nothing to resume"]);
    let text = std::fs::read_to_string(w.path("grid.toml")).unwrap();
    std::fs::write(w.path("grid.toml"), text.replace("optim.steps = 10", "optim.steps = 11")).unwrap();
    mentions(&w.refuse(&["sweep", &file, "--out", "parts"]), &["another run", "there `optim.steps` is 10, here 11"]);
    assert_eq!(csv("parts"), csv("whole"));
}

#[test]
fn runs_that_another_process_trains_are_left_alone() {
    let w = Workplace::new();
    let file = write_sweep(&w);
    w.succeed(&["sweep", &file, "--out", "out"]);
    let sweep = Sweep::load(&w.path("grid.toml")).unwrap();
    let held = |cell: usize| {
        let folder = w.path("out").join(&sweep.cells[cell].name);
        RunFolder::reopen(&folder, &sweep.cells[cell].layered.settings).unwrap()
    };
    // One goes on from its checkpoint elsewhere, one has none yet, one is to be done.
    let (begun, first) = (held(3), held(0));
    for run in [begun.path(), first.path(), &w.path("out/builtin-tiny-s1")] {
        std::fs::remove_file(run.join("metrics.json")).unwrap();
    }
    for file in ["checkpoint.json", "checkpoint-0000010.safetensors"] {
        std::fs::remove_file(first.path().join(file)).unwrap();
    }
    let output = w.run(&["sweep", &file, "--out", "out"]);
    assert_eq!(output.status.code(), Some(1));
    let expected = "out/builtin-tiny-s0 is being trained by another process";
    mentions(&stderr(&output), &[expected, "2 of 4 runs failed: builtin-tiny-s0, builtin-slow-s1"]);
    assert!(first.path().join("config.toml").exists() && !begun.path().join("metrics.json").exists());
    assert!(w.path("out/builtin-tiny-s1/metrics.json").exists());
    let train = ["train", "out/builtin-slow-s1/config.toml", "--out", "out/builtin-slow-s1"];
    mentions(&w.refuse(&[&train[..], &["--resume"]].concat()), &["is being trained by another process"]);
    w.succeed(&["eval", "out/builtin-slow-s1"]);
    drop((begun, first));
    w.succeed(&["sweep", &file, "--out", "out"]);
    assert!(w.path("out/builtin-slow-s1/metrics.json").exists());
}

#[test]
fn a_run_that_diverges_leaves_the_others() {
    let w = Workplace::new();
    let file = write_sweep(&w);
    let text = std::fs::read_to_string(w.path("grid.toml")).unwrap();
    std::fs::write(w.path("grid.toml"), text.replace("lr_warp = 1e-4", "lr_warp = 1e-4\nlr = 1e38")).unwrap();
    let output = w.run(&["sweep", &file, "--out", "out"]);
    assert_eq!(output.status.code(), Some(1));
    mentions(&stderr(&output), &["2 of 4 runs failed: builtin-slow-s0, builtin-slow-s1", "not finite"]);
    let csv = std::fs::read_to_string(w.path("out/sweep.csv")).unwrap();
    assert!(csv.contains(",tiny,ours,") && !csv.contains(",slow,"), "{csv}");
}

#[test]
fn scenes_are_columns() {
    let w = Workplace::in_space();
    std::fs::rename(w.path("scene"), w.path("lego")).unwrap();
    let text = "presets = [\"space.toml\"]\nscenes = [\"builtin\", \"lego\"]\nset.optim.steps = 2\n\
                set.noise.kind = \"barf\"\nset.noise.rotation = 0.15\nset.warp.method = \"global\"\n";
    std::fs::write(w.path("grid.toml"), text).unwrap();
    let table = w.succeed(&["sweep", "grid.toml"]);
    mentions(&table, &["builtin", "lego", "barf [BARF, Table 2]", "PSNR (dB), after", "runs/grid/sweep.csv"]);
    assert!(w.path("runs/grid/lego-space-s0/cameras.svg").exists());
}

#[test]
fn bad_sweeps_are_refused_before_anything_runs() {
    let w = Workplace::new();
    write_sweep(&w);
    let text = std::fs::read_to_string(w.path("grid.toml")).unwrap();
    for (from, to, expected) in [
        ("optim.steps", "optim.stpes", &["bad.toml:8", "unknown key `optim.stpes`", "did you mean `optim.steps`?"][..]),
        ("seeds", "sedes", &["bad.toml:2", "unknown key `sedes`", "did you mean `seeds`?"]),
        ("preset.slow", "preset.slwo", &["bad.toml:14", "did you mean `preset.slow`?"]),
        ("[0, 1]", "[0, 1.5]", &["bad.toml:2", "`seeds`", "whole numbers"]),
        ("presets = [", "presets = [\"planar-brf\", ", &["bad.toml:1", "`presets`", "did you mean `planar-barf`?"]),
        ("seeds", "scenes = [\"no.png\"]\nseeds", &["bad.toml:2", "`data.image`", "no.png"]),
        ("[24, 32]", "[24]", &["bad.toml:4", "data.image_size"]),
    ] {
        assert!(text.contains(from));
        std::fs::write(w.path("bad.toml"), text.replacen(from, to, 1)).unwrap();
        mentions(&w.refuse(&["sweep", "bad.toml", "--out", "out"]), expected);
    }
    mentions(&w.refuse(&["sweep", "none.toml"]), &["none.toml"]);
    mentions(&w.refuse(&["sweep", "grid.toml", "--out", "out", "--lpips", "no.st"]), &["no.st"]);
    std::fs::create_dir_all(w.path("thesis/builtin-tiny-s0")).unwrap();
    std::fs::write(w.path("thesis/builtin-tiny-s0/chapter.tex"), "text").unwrap();
    mentions(&w.refuse(&["sweep", "grid.toml", "--out", "thesis"]), &["not empty and holds no raygrad run"]);
    assert!(!w.path("out").exists() && !w.path("runs").exists());
    w.succeed(&["train", "tiny.toml", "--out", "run"]);
    let files = names(&w.path("run"));
    mentions(&w.refuse(&["sweep", "grid.toml", "--out", "run"]), &["run is the folder of a run"]);
    assert_eq!(names(&w.path("run")), files);
}

/// A sweep with a reference of a scene has its distances in the tables, also of runs that were trained before.
#[test]
fn distances_to_references_are_measured() {
    let w = Workplace::in_space();
    w.succeed(&["train", "space.toml", "--out", "run"]);
    let (threshold, resolution) = (["--mesh-threshold", "0.6"], ["--mesh-resolution", "16"]);
    w.succeed(&[&["eval", "run", "--mesh", "whole.ply"][..], &threshold, &resolution].concat());
    let file = |clouds: &str| {
        let text = format!("presets = [\"space.toml\"]\nscenes = [\"scene\"]\nseeds = [0]\n{clouds}");
        std::fs::write(w.path("grid.toml"), text).unwrap();
    };
    let distance = || w.json("grid/sweep.json")["runs"][0]["evaluation"]["cameras"]["mean"]["chamfer"].as_f64();
    file("");
    w.succeed(&["sweep", "grid.toml", "--out", "grid"]);
    assert_eq!(distance(), None);
    let clouds = "[clouds]\nscene = \"whole.ply\"\n[mesh]\nresolution = 16\n";
    file(&format!("{clouds}threshold = 1e6\n"));
    let output = w.run(&["sweep", "grid.toml", "--out", "grid"]);
    mentions(&stderr(&output), &["stays without a Chamfer distance", "above the threshold 1000000"]);
    assert!(output.status.success() && distance().is_none());
    file(&format!("{clouds}threshold = 0.6\n"));
    mentions(&w.succeed(&["sweep", "grid.toml", "--out", "grid"]), &["Chamfer distance"]);
    let found = distance().unwrap();
    assert!(found > 0.0 && found < 2.4 / 16.0, "{found}");
    let run = &w.json("grid/scene-space-s0/evaluation.json")["cameras"]["mean"]["chamfer"];
    assert_eq!(run.as_f64(), Some(found));
    file("[clouds]\nscene = \"no.ply\"\n");
    mentions(&w.refuse(&["sweep", "grid.toml", "--out", "grid"]), &["no.ply"]);
}
