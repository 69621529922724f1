//! Runs in space from start to end, on the built-in scene at a size for a test.

use raygrad::geometry::Pose;
use raygrad::run::{Entry, RunFolder};
use raygrad::training::{Training, Watch};
use raygrad::{Error, Experiment, Observer, Quiet, Trial};
use serde_json::Value;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

const STEPS: usize = 12;

/// `l2g-small` on a few views of 16 x 16 pixels, with some settings changed.
fn tiny(set: &[&str], out: &Path) -> Experiment {
    let small = [
        "scene.image_size=[16,16]",
        "scene.train_views=5",
        "scene.val_views=1",
        "scene.test_views=2",
        "train.rays=20",
        "train.samples=8",
        "train.refine_steps=3",
        "field.layers=[16,16,16]",
        "field.bands=2",
        "radiance.skip=[2]",
        "radiance.color_layers=[8]",
        "warp.code=4",
        "warp.layers=[8,8]",
        "warp.skip=[1]",
        "warp.inn.hidden=8",
        "run.device=cpu",
        "run.threads=1",
        "run.log_every=4",
        "run.picture_every=6",
        "run.checkpoint_every=5",
    ];
    let steps = format!("optim.steps={STEPS}");
    let all = small.iter().chain(set).copied().chain([steps.as_str()]);
    let experiment = all.fold(Experiment::preset("l2g-small").unwrap(), |e, text| e.set(text).unwrap());
    experiment.out(out)
}

/// Stops a run after some steps.
struct StopAt<'a> {
    at: usize,
    stop: &'a AtomicBool,
}

impl Observer for StopAt<'_> {
    fn step(&mut self, done: usize) {
        self.stop.store(done == self.at, Ordering::Relaxed);
    }
}

#[test]
fn an_interrupted_run_resumes_bit_by_bit_with_every_method() {
    let methods = [
        &["warp.method=local"][..],
        &["warp.method=global", "train.relocalise_every=3"],
        &["warp.method=none", "scene.poses=truth"],
        &["warp.method=invertible", "warp.activation=softplus", "warp.inn.anneal=point-slots"],
        &["warp.method=multi-invertible", "train.error_map=3"],
        &["warp.method=global", "train.fine_samples=6", "train.density_noise=0.5", "train.opaque_background=true"],
        &["warp.method=se3-field", "field.kind=gaussian", "field.encoding=none", "radiance.init=fan-in"],
        // Cameras that all look the same way see nothing of the scene as it is, but everything runs.
        &["train.ndc=true", "train.depth=metric", "train.range=[0.0, 1.0]", "scene.poses=identity"],
    ];
    for set in methods {
        let dir = tempfile::tempdir().unwrap();
        let (whole, parts) = (dir.path().join("whole"), dir.path().join("parts"));
        let outcome = tiny(set, &whole).train().unwrap_or_else(|e| panic!("{set:?}: {e}"));
        assert!(!outcome.interrupted && outcome.summary.contains("test PSNR"), "{set:?}: {}", outcome.summary);
        let stop = AtomicBool::new(false);
        let outcome = tiny(set, &parts).train_observed(&mut StopAt { at: 7, stop: &stop }, &stop).unwrap();
        assert!(outcome.interrupted);
        let stop = AtomicBool::new(false);
        let outcome = tiny(set, &parts).resume(true).train_observed(&mut Quiet, &stop).unwrap();
        assert!(!outcome.interrupted);
        let tensors = |run: &Path| std::fs::read(run.join(format!("checkpoint-{STEPS:07}.safetensors"))).unwrap();
        assert!(tensors(&parts) == tensors(&whole), "{set:?}");
        let evaluation = |run: &Path| std::fs::read_to_string(run.join("evaluation.json")).unwrap();
        assert_eq!(evaluation(&parts), evaluation(&whole), "{set:?}");
    }
}

#[test]
fn searches_that_find_no_lost_camera_leave_a_run_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let bits = |every: usize| {
        let run = dir.path().join(every.to_string());
        let outcome = tiny(&[&format!("train.relocalise_every={every}")], &run).train().unwrap();
        assert!(outcome.metrics.steps.iter().all(|e| e.relocalised.is_empty()));
        std::fs::read(run.join(format!("checkpoint-{STEPS:07}.safetensors"))).unwrap()
    };
    assert!(bits(0) == bits(3));
}

/// What was found of the lenses is told and exported, and a resumed run goes on from it.
#[test]
fn refined_lenses_are_told_and_exported() {
    let dir = tempfile::tempdir().unwrap();
    let of = |refined: &str| {
        let run = dir.path().join(refined);
        let outcome = tiny(&[&format!("train.refine_lens={refined}"), "optim.warmup_pose=0"], &run).train().unwrap();
        let mut explorer = Experiment::of_run(&run).unwrap().restored_explorer().unwrap();
        let (found, given) = (explorer.found_lens().unwrap(), explorer.data.scene.train[0].intrinsics);
        let evaluation: Value = serde_json::from_slice(&std::fs::read(run.join("evaluation.json")).unwrap()).unwrap();
        (found, given, explorer.cameras().unwrap().remove(0), evaluation["lens"].clone(), outcome.summary)
    };
    let (found, given, exported, told, summary) = of("all");
    let found = found.unwrap();
    assert!(found.focal_scale[0] != found.focal_scale[1] && found.principal_shift[0] != 0.0, "{found:?}");
    assert_eq!(told, serde_json::to_value(found).unwrap());
    let lens = found.of(&given);
    assert_eq!((exported.focal, exported.principal), ([lens.fx, lens.fy], [lens.cx, lens.cy]));
    assert!((lens.fx / given.fx - found.focal_scale[0]).abs() < 1e-12 && lens.cy > given.cy - given.fy);
    assert!(summary.contains("lenses were refined: focal lengths x"), "{summary}");
    let report = std::fs::read_to_string(dir.path().join("all/report.html")).unwrap();
    assert!(report.contains("lenses were refined") && report.contains("PSNR (dB), test views, refined"));
    let found = of("focal").0.unwrap();
    assert!(found.focal_scale[0] == found.focal_scale[1] && found.principal_shift == [0.0; 2]);
    let (none, given, exported, told, _) = of("none");
    assert!(none.is_none() && told.is_null() && exported.focal[0] == given.fx);
}

/// Poses of the last step hang on the pixels that it drew, those of a grid do not.
#[test]
fn poses_are_fitted_on_a_grid() {
    let dir = tempfile::tempdir().unwrap();
    let of = |method: &str, side: usize| {
        let run = dir.path().join(method);
        if !run.exists() {
            tiny(&[&format!("warp.method={method}"), "train.relocalise_every=0"], &run).train().unwrap();
        }
        let experiment = Experiment::of_run(&run).unwrap().set(&format!("train.fit_grid={side}")).unwrap();
        let mut explorer = experiment.restored_explorer().unwrap();
        let poses = explorer.poses().unwrap();
        explorer.settle().unwrap();
        assert_eq!(explorer.poses().unwrap(), poses);
        poses
    };
    let apart = |a: &[Pose], b: &[Pose]| {
        let one = |(a, b): (&Pose, &Pose)| (a.rotation - b.rotation).norm() + (a.translation - b.translation).norm();
        a.iter().zip(b).map(one).fold(0.0, f64::max)
    };
    let (drawn, all, more) = (of("local", 0), of("local", 16), of("local", 99));
    assert!(apart(&drawn, &all) > 1e-6 && all == more, "{drawn:?} {all:?}");
    // A run that is to be measured so ends with the poses that it is measured by again.
    let run = dir.path().join("fitted");
    tiny(&["warp.method=local", "train.relocalise_every=0", "train.fit_grid=16"], &run).train().unwrap();
    let found: Value = serde_json::from_slice(&std::fs::read(run.join("poses.json")).unwrap()).unwrap();
    let learned: Vec<[f64; 12]> = serde_json::from_value(found["learned"].clone()).unwrap();
    assert_eq!(learned, all.iter().map(|p| p.to_rows()).collect::<Vec<_>>());
    // One motion a view is the same at all pixels; the last step's is of the step before its update.
    let (drawn, some, all) = (of("global", 0), of("global", 2), of("global", 16));
    assert!(some == all && apart(&drawn, &all) < 0.05);
}

#[test]
fn a_trial_counts_views_refinement_and_all_that_recurs() {
    let dir = tempfile::tempdir().unwrap();
    let trial = |set: &[&str]| tiny(set, &dir.path().join("run")).explorer().unwrap().trial().unwrap();
    let every = |trial: &Trial| trial.recurring.iter().map(|(every, _)| *every).collect::<Vec<_>>();
    let known = trial(&["warp.method=none", "scene.poses=truth", "train.relocalise_every=20", "run.picture_every=30"]);
    assert_eq!(every(&known), [30, 0], "known poses are not lost");
    // Two views, each a frame and its scores.
    let frame = known.recurring[0].1;
    assert!(frame > 0.0 && known.evaluation > 2.0 * frame, "{known:?}");
    let sets = ["train.relocalise_every=20", "train.validate_every=50", "run.picture_every=30"];
    let found = trial(&[&sets[..], &["run.log_every=50", "scene.val_views=1"]].concat());
    assert_eq!(every(&found), [20, 30, 50]);
    assert!(found.recurring.iter().all(|(_, seconds)| *seconds > 0.0), "{found:?}");
    // Before and after the refinement of their poses.
    assert!(found.evaluation > 4.0 * found.recurring[1].1, "{found:?}");
}

#[test]
fn an_alignment_that_cameras_do_not_determine_is_told() {
    let dir = tempfile::tempdir().unwrap();
    for (views, told) in [(2, true), (5, false)] {
        let run = dir.path().join(views.to_string());
        let outcome = tiny(&[&format!("scene.train_views={views}")], &run).train().unwrap();
        let says = |text: &str| text.contains("lie in one point or on one line");
        assert_eq!(says(&outcome.summary), told, "{}", outcome.summary);
        assert_eq!(says(&std::fs::read_to_string(run.join("report.html")).unwrap()), told);
        let evaluation = std::fs::read_to_string(run.join("evaluation.json")).unwrap();
        assert_eq!(evaluation.contains("\"undetermined\": true"), told, "{evaluation}");
    }
}

#[test]
fn a_validation_view_is_looked_at_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let run = |name: &str, every: usize| {
        let folder = dir.path().join(name);
        let outcome = tiny(&[&format!("train.validate_every={every}")], &folder).train().unwrap();
        let bits = std::fs::read(folder.join(format!("checkpoint-{STEPS:07}.safetensors"))).unwrap();
        let report = std::fs::read_to_string(folder.join("report.html")).unwrap();
        (outcome.metrics.steps, bits, report.contains("validation view"))
    };
    let (without, with) = (run("without", 0), run("with", 8));
    let seen = |steps: &[Entry]| -> Vec<bool> { steps.iter().map(|e| e.validation_psnr_db().is_some()).collect() };
    assert_eq!((seen(&without.0), without.2), (vec![false; 3], false));
    assert_eq!((seen(&with.0), with.2), (vec![false, true, false], true));
    assert!(with.1 == without.1);
    // Against the frame of the animation, which is of the same view, rounded to bytes.
    let explorer = tiny(&[], dir.path()).explorer().unwrap();
    let photo = explorer.data.scene.val[0].rgb();
    let again = tiny(&["train.validate_every=12", "run.picture_every=12"], &dir.path().join("frame")).train().unwrap();
    let frame = image::open(dir.path().join("frame/frames/0000012.png")).unwrap().to_rgb8();
    let squares = frame.as_raw().iter().zip(&photo).map(|(a, b)| (f64::from(*a) / 255.0 - f64::from(*b)).powi(2));
    let psnr = -10.0 * (squares.sum::<f64>() / photo.len() as f64).log10();
    let found = again.metrics.steps.last().unwrap().validation_psnr_db().unwrap();
    assert!((found - psnr).abs() < 0.1, "{found} {psnr}");
    let error = tiny(&["train.validate_every=6"], dir.path()).train().unwrap_err().to_string();
    assert!(error.contains("`train.validate_every`") && error.contains("multiple of `run.log_every`, 4"), "{error}");
}

/// Stops a run once all steps are taken.
struct StopAtEnd<'a>(&'a AtomicBool);

impl Observer for StopAtEnd<'_> {
    fn finishing(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_run_that_is_stopped_while_it_is_measured_goes_on_from_there() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let stop = AtomicBool::new(false);
    let outcome = tiny(&[], &run).train_observed(&mut StopAtEnd(&stop), &stop).unwrap();
    assert!(outcome.interrupted && outcome.trained && outcome.metrics.last.is_none());
    assert!(run.join("metrics.json").exists() && !run.join("evaluation.json").exists());
    let mut explorer = Experiment::of_run(&run).unwrap().restored_explorer().unwrap();
    let folder = RunFolder::open(&run).unwrap();
    // Between two views.
    let stop = AtomicBool::new(false);
    let after_one = |done, _| stop.store(done == 1, Ordering::Relaxed);
    let stopped = explorer.write_evaluation(&folder, Watch::new(&after_one, &stop));
    assert!(matches!(stopped, Err(Error::Stopped)), "{stopped:?}");
    assert!(run.join("test/000.png").exists() && !run.join("test/001.png").exists());
    assert!(!run.join("evaluation.json").exists());
    // Within one.
    let view = explorer.data.scene.test[0].clone();
    let watch = Watch::new(&|_, _| {}, &stop);
    let pose = view.pose.unwrap();
    assert!(matches!(explorer.render(&pose, &view.intrinsics, watch), Err(Error::Stopped)));
    assert!(matches!(explorer.refined(&pose, &view, 3, watch), Err(Error::Stopped)));
    let measured = explorer.write_evaluation(&folder, Watch::none()).unwrap();
    let outcome = tiny(&[], &run).resume(true).train().unwrap();
    assert!(!outcome.interrupted && run.join("report.html").exists());
    let written = std::fs::read_to_string(run.join("evaluation.json")).unwrap();
    assert_eq!(written, measured.to_json());
}

#[test]
fn a_finished_run_that_is_resumed_keeps_its_numbers() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let last = |resume| tiny(&[], &run).resume(resume).train().unwrap().metrics.last.unwrap().entry;
    let first = last(false);
    assert!(first.loss["render"] > 0.0);
    assert_eq!(last(true), first);
}

#[test]
fn a_run_leaves_poses_views_and_scores() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    tiny(&[], &run).train().unwrap();
    let json = |name: &str| -> Value { serde_json::from_slice(&std::fs::read(run.join(name)).unwrap()).unwrap() };
    let scores = json("evaluation.json");
    assert_eq!((&scores["scene"], &scores["method"]), (&Value::from("builtin"), &Value::from("l2g")));
    for (part, keys, views) in [
        ("cameras", &["rotation_error_deg", "translation_error_x100"][..], 5),
        ("before", &["psnr_db", "ssim", "depth_error"], 2),
        ("after", &["psnr_db", "ssim", "depth_error"], 2),
    ] {
        let all = scores[part]["views"].as_array().unwrap();
        assert_eq!(all.len(), views, "{part}");
        for key in keys {
            let mean = all.iter().map(|v| v[key].as_f64().unwrap()).sum::<f64>() / views as f64;
            let found = scores[part]["mean"][key].as_f64().unwrap();
            assert!((found - mean).abs() < 1e-9 && found > 0.0, "{part} {key}: {scores}");
        }
    }
    assert_eq!(json("poses.json")["aligned"].as_array().unwrap().len(), 5);
    let metrics = json("metrics.json");
    assert_eq!(metrics["steps"].as_array().unwrap().len(), 3);
    assert_eq!(metrics["final"]["rotation_error_deg"], scores["cameras"]["mean"]["rotation_error_deg"]);
    // What cameras share of their errors is no more than the largest of them.
    let errors =
        scores["cameras"]["views"].as_array().unwrap().iter().map(|v| v["rotation_error_deg"].as_f64().unwrap());
    let shared = scores["common_turn_deg"].as_f64().unwrap();
    assert!(shared > 0.0 && shared <= errors.fold(0.0, f64::max), "{shared} of {scores}");
    let plot = std::fs::read_to_string(run.join("cameras.svg")).unwrap();
    // Before and after: a frustum of eight lines for either pose of five cameras, and a line between the two.
    assert_eq!(plot.matches("<polyline").count(), 2 * 5 * (2 * 8 + 1));
    assert!(std::fs::read_to_string(run.join("report.html")).unwrap().contains(&plot));
    for name in
        ["initial_poses.json", "report.html", "test/000.png", "test/001_depth.png", "test_views.png", "training.png"]
    {
        assert!(run.join(name).exists(), "{name} is missing");
    }
    // The poses that the run started from are a start for another one.
    let again = dir.path().join("again");
    let poses = format!("scene.poses={}", run.join("initial_poses.json").display());
    tiny(&[&poses], &again).train().unwrap();
    let first = |run: &Path| std::fs::read(run.join(format!("checkpoint-{STEPS:07}.safetensors"))).unwrap();
    assert!(first(&run) == first(&again), "the same start gives the same run");
}

#[test]
fn bad_scenes_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |set: &str| {
        let out = dir.path().join("run");
        let error = tiny(&[set], &out).train().unwrap_err();
        assert!(error.is_bad_input(), "{error}");
        assert!(!out.exists(), "nothing is written");
        error.to_string()
    };
    let message = refused("scene.path=/nowhere/at/all");
    assert!(message.contains("/nowhere/at/all"), "{message}");
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    let message = refused(&format!("scene.path={}", empty.display()));
    assert!(message.contains("is not a scene"), "{message}");
    let message = refused("scene.poses=nowhere.json");
    assert!(message.contains("nowhere.json"), "{message}");
}

#[test]
fn settings_that_do_not_fit_are_refused() {
    for (set, expected) in [
        (&["train.depth=metric", "train.range=[6.0, 2.0]"][..], ["`train.range`", "near < far"]),
        (&["warp.dof=8"], ["`warp.dof`", "found 8"]),
        (&["scene.focal=-1.0"], ["`scene.focal`", "found -1"]),
        (&["train.fine_samples=1000"], ["`train.fine_samples`", "found 48 and 1000 more"]),
        (&["train.ndc=true", "train.depth=inverse", "train.range=[1.0, 0.0]"], ["`train.depth`", "\"metric\""]),
        (&["train.ndc=true", "train.depth=metric"], ["`train.range`", "found [2, 6]"]),
        (
            &["train.ndc=true", "train.depth=metric", "train.range=[0.0, 1.0]", "scene.train_views=9"],
            ["`train.ndc`", "of the 9 poses"],
        ),
        (&["field.kind=gaussian", "field.sigma=0.0"], ["`field.sigma`", "above 0"]),
        (&["radiance.init=zero"], ["`radiance.init`", "expected"]),
        (&["warp.output_scale=[0.0, 1.0]"], ["`warp.output_scale`", "two factors above 0"]),
        (&["train.shear=true"], ["`train.relocalise_every`", "expected 0, found 1000"]),
        (&["warp.origin=[0.0, nan, 2.0]"], ["`warp.origin`", "expected a point"]),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let experiment = set.iter().try_fold(Experiment::preset("l2g-small").unwrap(), |e, text| e.set(text));
        let Err(error) = experiment.and_then(|e| e.out(dir.path().join("run")).train()) else {
            panic!("{set:?} is not refused");
        };
        let message = error.to_string();
        assert!(expected.iter().all(|part| message.contains(part)), "{set:?}: {message}");
    }
}
