//! Before it begins, a run takes a few steps to tell how long it should take. Nothing of them must remain.

use raygrad::{Estimate, Experiment, Observer};
use std::path::Path;
use std::sync::atomic::AtomicBool;

const STEPS: usize = 60;

fn planar(out: &Path) -> Experiment {
    let steps = format!("optim.steps={STEPS}");
    let small = ["data.image_size=[24,32]", "data.patch_crop=[10,12]", "field.layers=[8,8]", "warp.layers=[8,8]"];
    let rest = ["warp.skip=[]", "run.device=cpu", "run.threads=1", "run.checkpoint_every=0", steps.as_str()];
    let all = small.iter().chain(&["data.points_per_patch=8", "run.picture_every=60"]).chain(&rest);
    all.fold(Experiment::preset("planar-l2g-small").unwrap(), |e, text| e.set(text).unwrap()).out(out)
}

fn in_space(out: &Path) -> Experiment {
    let steps = format!("optim.steps={STEPS}");
    let small = ["scene.image_size=[16,16]", "scene.train_views=4", "scene.val_views=1", "scene.test_views=1"];
    let narrow = ["train.rays=8", "train.samples=4", "train.refine_steps=1", "field.layers=[8,8]", "warp.layers=[8]"];
    let rest = ["run.device=cpu", "run.threads=1", "run.checkpoint_every=0", "run.picture_every=60", steps.as_str()];
    let all = small.iter().chain(&narrow).chain(&rest);
    all.fold(Experiment::preset("l2g-small").unwrap(), |e, text| e.set(text).unwrap()).out(out)
}

#[derive(Default)]
struct Told(Option<Estimate>);

impl Observer for Told {
    fn expected(&mut self, estimate: &Estimate, device: &str) {
        assert_eq!(device, "CPU, 1 threads");
        self.0 = Some(*estimate);
    }
}

/// A run with an estimate, against its own steps taken one by one without one.
fn check(experiment: &Experiment, folder: &Path) {
    let mut told = Told::default();
    let outcome = experiment.train_observed(&mut told, &AtomicBool::new(false)).unwrap();
    let Estimate { training, evaluation } = told.0.unwrap();
    assert!([training, evaluation].iter().all(|s| *s > 0.0 && s.is_finite()), "{training} {evaluation}");
    let first = std::fs::read(folder.join("frames/0000000.png")).unwrap();

    let other = tempfile::tempdir().unwrap();
    let mut stepped = experiment.training().unwrap();
    let run = raygrad::run::RunFolder::claim(&other.path().join("run"), &experiment.layered.settings).unwrap();
    stepped.write_frame(&run).unwrap();
    assert_eq!(
        std::fs::read(run.path().join("frames/0000000.png")).unwrap(),
        first,
        "the picture before the first step"
    );
    for _ in 0..STEPS {
        stepped.step().unwrap();
    }
    let last = outcome.metrics.steps.last().unwrap();
    assert_eq!(last, &stepped.measure().unwrap());
}

#[test]
fn of_a_planar_run() {
    let dir = tempfile::tempdir().unwrap();
    check(&planar(dir.path()), dir.path());
}

#[test]
fn of_a_run_in_space() {
    let dir = tempfile::tempdir().unwrap();
    check(&in_space(dir.path()), dir.path());
}
