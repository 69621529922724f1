//! The command from outside: what a run leaves behind, and that it can be stopped and resumed bit by bit.

use crate::workplace::{Workplace, mentions, names, stderr};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::process::Stdio;

#[test]
fn a_run_leaves_metrics_pictures_checkpoint_and_report() {
    let w = Workplace::new();
    let output = w.succeed(&["train", "tiny.toml", "--out", "run"]);
    assert!(output.contains("corner error") && output.contains("report.html"), "{output}");
    let mut found = names(&w.path("run"));
    found.sort();
    let expected = [
        ".lock",
        "checkpoint-0000012.safetensors",
        "checkpoint.json",
        "config.toml",
        "evaluation.json",
        "frames",
        "learned.png",
        "metrics.json",
        "patches.png",
        "perturbation.json",
        "photo.png",
        "reconstruction.png",
        "report.html",
        "training.png",
        "warp_field.png",
    ];
    assert_eq!(found, expected);
    let metrics = w.json("run/metrics.json");
    let steps: Vec<u64> = metrics["steps"].as_array().unwrap().iter().map(|s| s["step"].as_u64().unwrap()).collect();
    assert_eq!(steps, [4, 8, 12]);
    for entry in metrics["steps"].as_array().unwrap().iter().chain([&metrics["final"]]) {
        assert!(entry["patch_psnr_db"].as_f64().unwrap() > 0.0);
        assert_eq!(entry["corner_error_px"]["per_patch"].as_array().unwrap().len(), 3);
        assert!(entry["corner_error_px"]["mean"].as_f64().unwrap().is_finite());
        for term in ["render", "alignment", "total"] {
            assert!(entry["loss"][term].as_f64().unwrap() >= 0.0, "{term}");
        }
    }
    assert!(metrics["final"]["seconds"].as_f64().unwrap() > 0.0);
    let report = std::fs::read_to_string(w.path("run/report.html")).unwrap();
    assert!(report.contains("<svg") && report.contains("data:image/png;base64,"));
    assert!(!report.contains("src=\"http"), "the report needs no network");
    // The resolved settings are an experiment of their own: the same run again.
    w.succeed(&["train", "run/config.toml", "--out", "again"]);
    assert_eq!(w.json("again/metrics.json")["steps"], metrics["steps"]);
}

#[test]
fn threads_do_not_change_results() {
    let w = Workplace::new();
    w.succeed(&["train", "tiny.toml", "--out", "one", "--threads", "1"]);
    w.succeed(&["train", "tiny.toml", "--out", "two", "--threads", "2"]);
    let tensors = |run: &str| std::fs::read(w.path(&format!("{run}/checkpoint-0000012.safetensors"))).unwrap();
    assert!(tensors("one") == tensors("two"));
}

#[test]
fn presets_perturbations_and_methods() {
    let w = Workplace::new();
    assert!(w.succeed(&["presets"]).contains("planar-l2g-small"));
    assert!(w.succeed(&["devices"]).contains("cpu"));
    w.succeed(&["train", "tiny.toml", "--out", "l2g"]);
    let variants: &[&[&str]] = &[
        &["warp.method=global", "loss.alignment=0"],
        &["warp.method=none"],
        &["warp.method=global", "field.encoding=full"],
        &["field.encoding=none"],
        &["warp.dof=1"],
        &["warp.dof=2"],
        &["warp.dof=3"],
        &["warp.solver=eigen"],
        &["warp.fix_first=false"],
        &["loss.alignment=0"],
        &["data.points_per_patch=all"],
    ];
    for (i, variant) in variants.iter().enumerate() {
        let out = format!("variant{i}");
        let mut args = vec!["train", "tiny.toml", "--perturbation", "l2g/perturbation.json", "--out", &out];
        args.extend(variant.iter().flat_map(|v| ["--set", v]));
        w.succeed(&args);
        let perturbation = |run: &str| w.json(&format!("{run}/perturbation.json"))["perturbation"].clone();
        assert_eq!(perturbation(&out), perturbation("l2g"));
    }
    // Known warps are exact.
    assert!(w.json("variant1/metrics.json")["final"]["corner_error_px"]["mean"].as_f64().unwrap() < 1e-3);
}

#[test]
fn default_folders_are_numbered() {
    let w = Workplace::new();
    for _ in 0..2 {
        w.succeed(&["train", "tiny.toml", "--steps", "1"]);
    }
    let mut runs = names(&w.path("runs"));
    runs.sort();
    assert_eq!(runs, ["tiny", "tiny-2"]);
}

/// Ctrl-C.
#[cfg(unix)]
fn interrupt(child: &std::process::Child) {
    let kill = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(kill.success());
}

/// Stops a run by Ctrl-C, resumes it, and compares it with one that was never stopped.
#[cfg(unix)]
#[test]
fn an_interrupted_run_resumes_bit_by_bit() {
    let w = Workplace::new();
    let long = ["--steps", "400", "--set", "run.log_every=1", "--set", "run.picture_every=100"];
    let args = |out: &'static str| [&["train", "tiny.toml", "--out", out], &long[..]].concat();
    w.succeed(&args("whole"));
    let mut child = w.command(&args("parts")).stderr(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    // The first measurement is printed after the first step.
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.by_ref().map_while(Result::ok).any(|l| l.starts_with("step ")));
    interrupt(&child);
    lines.for_each(drop);
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let done = w.json("parts/checkpoint.json")["step"].as_u64().unwrap();
    assert!(done > 0 && done < 400, "stopped at {done}");
    assert!(w.json("parts/metrics.json")["final"].is_null());
    let mut resumed = args("parts");
    resumed.push("--resume");
    let output = w.run(&resumed);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(w.json("parts/metrics.json")["steps"], w.json("whole/metrics.json")["steps"]);
    let tensors = |run: &str| std::fs::read(w.path(&format!("{run}/checkpoint-0000400.safetensors"))).unwrap();
    assert!(tensors("parts") == tensors("whole"));
    let animation = |run: &str| std::fs::read(w.path(&format!("{run}/training.png"))).unwrap();
    assert!(animation("parts") == animation("whole"));
}

/// Stops the measuring of a run by Ctrl-C, which would last for hours.
#[cfg(unix)]
#[test]
fn the_measuring_of_a_run_is_interrupted_too() {
    let w = Workplace::in_space();
    let args = ["train", "space.toml", "--out", "run", "--set", "train.refine_steps=100000000"];
    let mut child = w.command(&args).stderr(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.by_ref().map_while(Result::ok).any(|l| l.starts_with("training done")));
    interrupt(&child);
    lines.for_each(drop);
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    mentions(&String::from_utf8_lossy(&output.stdout), &["`raygrad eval run`", "`--out run --resume`"]);
    assert_eq!(w.json("run/checkpoint.json")["step"], 6);
    assert!(w.json("run/metrics.json")["final"].is_null());
}

#[test]
fn bench_prints_the_numbers_of_a_step() {
    let w = Workplace::new();
    let text = w.succeed(&["bench", "tiny.toml", "--steps", "3", "--json"]);
    let bench: Value = serde_json::from_str(&text).unwrap();
    for key in ["seconds_per_step", "gflop_per_step", "gflops", "peak_gflops", "peak_rss_mb"] {
        assert!(bench[key].as_f64().unwrap() > 0.0, "{key}: {text}");
    }
    // Rows x weights x 6: the field 14-16-16-3 and the warp 8-16-(16+8)-16-3.
    let weights = (14 * 16 + 16 * 16 + 16 * 3) + (8 * 16 + 24 * 16 + 16 * 3);
    let expected = 6.0 * 3.0 * 40.0 * f64::from(weights) / 1e9;
    assert!((bench["gflop_per_step"].as_f64().unwrap() / expected - 1.0).abs() < 1e-9, "{text}");
    assert!(bench.get("per_launch").is_none());
    // Products of pairs on the CPU.
    let text = w.succeed(&["bench", "tiny.toml", "--steps", "1", "--device", "cpu", "--precision", "mixed"]);
    assert!(text.contains("bf16 products"), "{text}");
    // They need no scaled loss; f16 on a GPU does.
    for (target, scaled) in [("cpu", false), ("gpu", true)] {
        let text = w.succeed(&["explain", "tiny.toml", "--precision", "mixed", "--target", target]);
        assert_eq!(text.contains("loss_scale"), scaled, "{text}");
    }
    // Launch by launch, for scripts, for people and for Perfetto.
    let text = w.succeed(&["bench", "tiny.toml", "--steps", "1", "--json", "--launches", "--trace", "trace.json"]);
    let bench: Value = serde_json::from_str(&text).unwrap();
    let launches = bench["per_launch"].as_array().unwrap();
    assert_eq!(launches.len() as u64, bench["launches"].as_u64().unwrap());
    assert!(launches.iter().any(|l| l["seconds"].as_f64().unwrap() > 0.0 && l["gflop"].as_f64().unwrap() > 0.0));
    let events = w.json("trace.json")["traceEvents"].as_array().unwrap().clone();
    let of_launches = events.iter().filter(|e| e["args"]["MFLOP"].is_number()).count();
    assert!(of_launches > launches.len() && of_launches.is_multiple_of(launches.len()), "{events:?}");
    let text = w.succeed(&["bench", "tiny.toml", "--steps", "1", "--launches"]);
    assert!(launches.iter().all(|l| text.contains(l["name"].as_str().unwrap())) && text.contains("at best"), "{text}");
    let refused = w.run(&["bench", "tiny.toml", "--trace", "nowhere/trace.json"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
}

#[cfg(feature = "gpu")]
#[test]
fn explain_prints_the_plan_and_writes_artefacts() {
    let w = Workplace::new();
    assert!(!w.succeed(&["explain", "tiny.toml"]).is_empty());
    assert!(w.succeed(&["explain", "tiny.toml", "--timing"]).contains("fuse"));
    let graph = w.succeed(&["explain", "tiny.toml", "--emit", "graph"]);
    assert!(graph.contains("output render") && graph.contains("update warp.code"));
    w.succeed(&["explain", "tiny.toml", "--emit", "plan", "--out", "artefacts"]);
    assert_eq!(names(&w.path("artefacts")), ["plan.txt"]);
    assert_eq!(w.run(&["explain", "tiny.toml", "--emit", "spirv"]).status.code(), Some(2));
    for (emit, ending) in [("wgsl", ".wgsl"), ("spirv", ".spv")] {
        w.succeed(&["explain", "tiny.toml", "--emit", emit, "--out", emit]);
        let files = names(&w.path(emit));
        assert!(files.len() > 3 && files.iter().all(|f| f.ends_with(ending)), "{files:?}");
    }
    // Of other kernels that were there before nothing stays; of halves they say so.
    std::fs::write(w.path("wgsl").join("999_other.wgsl"), "").unwrap();
    std::fs::write(w.path("wgsl").join("notes.wgsl"), "").unwrap();
    let emit = ["explain", "tiny.toml", "--emit", "wgsl", "--precision", "mixed", "--set", "field.layers=[32,32]"];
    w.succeed(&[&emit[..], &["--out", "wgsl"]].concat());
    let files = names(&w.path("wgsl"));
    assert!(!files.contains(&"999_other.wgsl".into()) && files.contains(&"notes.wgsl".into()), "{files:?}");
    let text = |f: &String| std::fs::read_to_string(w.path("wgsl").join(f)).unwrap();
    assert!(files.iter().any(|f| text(f).contains("enable f16;")), "{files:?}");
    // A device that is named is asked what every launch takes.
    let page = w.succeed(&["explain", "tiny.toml", "--device", "cpu"]);
    let launches = page.matches(" us predicted").count();
    assert!(launches > 0 && page.matches(" us measured, ").count() == launches && page.contains("at best"), "{page}");
    assert_eq!(w.run(&["explain", "tiny.toml", "--device", "cpu", "--target", "gpu"]).status.code(), Some(2));
    mentions(&w.refuse(&["explain", "tiny.toml", "--device", "cpu", "--emit", "wgsl"]), &["CPU", "--device"]);
}

/// A run goes on where nobody hears of it, and ends as one that somebody watched.
#[cfg(target_os = "linux")]
#[test]
fn progress_that_cannot_be_written_stops_nothing() {
    let w = Workplace::new();
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let args = ["train", "tiny.toml", "--out", "run"];
    let output = w.command(&args).stderr(Stdio::from(full)).output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    assert!(w.json("run/metrics.json")["final"].is_object());
}

/// What a run learns from stays what it was, or it is not gone on with and not measured.
#[test]
fn data_that_changed_under_a_run_are_refused() {
    let w = Workplace::new();
    let picture = |level: u8| {
        let shade = |x: u32, y: u32| image::Rgb([(7 * x) as u8, (9 * y) as u8, level]);
        image::RgbImage::from_fn(32, 24, shade).save(w.path("photo.png")).unwrap();
    };
    picture(10);
    w.succeed(&["train", "tiny.toml", "--out", "drawn"]);
    std::fs::copy(w.path("drawn/perturbation.json"), w.path("moved.json")).unwrap();
    let begun = ["train", "tiny.toml", "--image", "photo.png", "--perturbation", "moved.json", "--out", "run"];
    w.succeed(&begun);
    let resumed = [&begun[..], &["--resume"]].concat();
    w.succeed(&resumed);
    picture(11);
    mentions(&w.refuse(&resumed), &["run/perturbation.json", "other pictures than photo.png gives now"]);
    mentions(&w.refuse(&["eval", "run"]), &["other pictures than photo.png"]);
    picture(10);
    let mut moved = w.json("moved.json");
    let number = moved["perturbation"]["rotation"][1][0].as_f64().unwrap();
    moved["perturbation"]["rotation"][1][0] = Value::from(number + 1e-3);
    std::fs::write(w.path("moved.json"), moved.to_string()).unwrap();
    mentions(&w.refuse(&resumed), &["other perturbations than moved.json gives now"]);
    std::fs::write(w.path("drawn/perturbation.json"), "{\"image_size_hw\": [24").unwrap();
    mentions(&w.refuse(&["eval", "drawn"]), &["drawn/perturbation.json: not a perturbation file"]);
    // What has no place is refused before anything is looked at.
    std::fs::remove_file(w.path("drawn/evaluation.json")).unwrap();
    std::fs::create_dir(w.path("drawn/evaluation.json")).unwrap();
    mentions(&w.refuse(&["eval", "drawn"]), &["cannot write drawn/evaluation.json"]);
    // The run has a copy of what it began with.
    w.succeed(&["eval", "run"]);
    std::fs::write(w.path("run/perturbation.json"), "{\"image_size_hw\": [24").unwrap();
    mentions(&w.refuse(&["eval", "run"]), &["run/perturbation.json: not a perturbation file"]);
}

/// A run that keeps averages ends with them, whether it was stopped or not, and is measured by them afterwards.
#[test]
fn runs_end_with_averages() {
    for (file, w) in [("tiny.toml", Workplace::new()), ("space.toml", Workplace::in_space())] {
        let train = |out: &str, average: &str, more: &[&str]| {
            let printed = w.succeed(&[&["train", file, "--set", average, "--out", out], more].concat());
            let evaluation = w.json(&format!("{out}/evaluation.json"));
            // What is printed is what was evaluated, and not the last step.
            if let Some(r) = evaluation["cameras"]["mean"]["rotation_error_deg"].as_f64() {
                mentions(&printed, &[&format!("rotation error     {r:.3} deg")]);
            }
            evaluation
        };
        let plain = train("plain", "optim.average=0", &[]);
        let averaged = train("averaged", "optim.average=4", &[]);
        assert_ne!(plain, averaged, "{file}");
        assert_eq!(w.json("plain/metrics.json")["steps"], w.json("averaged/metrics.json")["steps"]);
        w.succeed(&["eval", "averaged"]);
        assert_eq!(w.json("averaged/evaluation.json"), averaged, "{file}");
        assert_eq!(train("averaged", "optim.average=4", &["--resume"]), averaged, "{file}");
        // One that follows at once is the value itself; its poses are fitted on a grid.
        let last = train("last", "optim.average=1", &[]);
        let grid = ["--set", "train.fit_grid=24"];
        assert_eq!(last, if file == "tiny.toml" { plain } else { train("fitted", "optim.average=0", &grid) });
    }
}
