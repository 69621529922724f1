//! Bringing back cameras that have left the scene.
//!
//! Registration by gradients moves a camera as long as its pixels change when it moves. One that has turned away from the
//! scene sees its background alone, and stays lost while the others find their places. Its photo tells: the model's picture
//! of it is far worse than of the others. Such a camera is put where another one is, at the pose from which its own photo
//! looks most like what the field shows (relocalisation, as trackers that have lost their camera do it), refined there
//! against the photo with the field as it is.
//!
//! What moves is the rough pose that the view's warp starts from, so that every warp can be moved: with the pose P = rough o
//! found that the view shall have, rough = P o found^-1. Codes and networks stay as they are.

use super::explorer::Explorer;
use crate::Error;
use crate::geometry::Pose;
use crate::report::median;
use crate::run::metrics::Relocalised;
use crate::training::Watch;

/// A camera is lost whose photo's mean squared error is so many times the median over all cameras.
const LOST: f64 = 2.5;
/// It moves where its error becomes less than this part of what it was.
const BETTER: f64 = 0.5;
/// So many of the best places are refined.
const REFINED: usize = 3;
/// Steps of a refinement, and Adam's rate: far enough for the way to the next camera.
const STEPS: usize = 100;
const RATE: f64 = 1e-2;

/// Looks for lost cameras and brings them back.
pub fn relocalise(explorer: &mut Explorer) -> Result<Vec<Relocalised>, Error> {
    let poses = explorer.poses()?;
    let mut errors = vec![];
    for (i, pose) in poses.iter().enumerate() {
        explorer.show_training_view(i)?;
        errors.push(explorer.photo_error(pose)?);
    }
    let bound = LOST * median(&errors);
    let is_lost = |i: usize| errors[i] > bound && !(i == 0 && explorer.settings.warp.fix_first);
    let lost: Vec<usize> = (0..poses.len()).filter(|i| is_lost(*i)).collect();
    let places: Vec<Pose> = (0..poses.len()).filter(|i| errors[*i] <= bound).map(|i| poses[i]).collect();
    let mut back = vec![];
    for i in lost {
        explorer.show_training_view(i)?;
        let mut tried = vec![];
        for place in places.iter().copied().chain([explorer.data.start.poses[i]]) {
            tried.push((explorer.photo_error(&place)?, place));
        }
        tried.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut best = (errors[i], poses[i]);
        for (_, place) in tried.into_iter().take(REFINED) {
            let refined = explorer.refine(&place, STEPS, RATE, Watch::none())?;
            let error = explorer.photo_error(&refined)?;
            if error < best.0 {
                best = (error, refined);
            }
        }
        if best.0 < BETTER * errors[i] {
            explorer.place(i, &best.1)?;
            let view = explorer.data.scene.train[i].name.clone();
            back.push(Relocalised { view, error_before: errors[i], error_after: best.0 });
        }
    }
    Ok(back)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::Experiment;
    use crate::run::checkpoint::Checkpoint;
    use crate::training::Training;
    use std::sync::Arc;

    /// The built-in scene, learned from true poses.
    fn learned(set: &[&str]) -> Explorer {
        let small = [
            "scene.image_size=[24,24]",
            "scene.train_views=40",
            "scene.val_views=1",
            "scene.test_views=1",
            "scene.poses=truth",
            "train.rays=240",
            "train.samples=24",
            "train.relocalise_every=1000",
            "field.layers=[32,32]",
            "field.bands=4",
            "field.encoding=full",
            "radiance.color_layers=[]",
            "optim.lr=5e-3",
            "optim.lr_end=2e-3",
            "optim.lr_warp=1e-4",
            "optim.lr_warp_end=1e-4",
            "warp.method=global",
            "run.device=cpu",
            "run.threads=1",
        ];
        let experiment =
            small.iter().chain(set).fold(Experiment::preset("barf-small").unwrap(), |e, text| e.set(text).unwrap());
        let mut explorer = experiment.explorer().unwrap();
        for _ in 0..400 {
            explorer.step().unwrap();
        }
        explorer
    }

    /// Turns a camera away from the scene and moves it off. It starts there too: the true pose is not among the places tried.
    fn lose(explorer: &mut Explorer, view: usize) {
        let away = Pose::exp(&[0.0, 0.9, 0.0, 2.0, 0.0, 0.0]).after(&explorer.poses().unwrap()[view]);
        let mut data = (*explorer.data).clone();
        data.start.poses[view] = away;
        explorer.data = Arc::new(data);
        explorer.place(view, &away).unwrap();
        let apart = explorer.poses().unwrap()[view].after(&away.inverse());
        assert!((apart.to_rows().iter().sum::<f64>() - 3.0).abs() < 1e-5, "{apart:?}");
    }

    fn displacement(explorer: &mut Explorer, view: usize) -> f64 {
        let truth = explorer.data.truth.as_ref().unwrap()[view];
        (explorer.poses().unwrap()[view].center() - truth.center()).norm()
    }

    #[test]
    fn a_lost_camera_comes_back_and_the_others_stay() {
        let mut explorer = learned(&[]);
        assert_eq!(relocalise(&mut explorer).unwrap(), [], "no camera is lost");
        lose(&mut explorer, 7);
        let before = explorer.poses().unwrap();
        let away = displacement(&mut explorer, 7);
        let back = relocalise(&mut explorer).unwrap();
        let [one] = &back[..] else { panic!("{back:?}") };
        assert_eq!(one.view, explorer.data.scene.train[7].name);
        assert!(one.error_after < BETTER * one.error_before, "{one:?}");
        // Refined: nearer to its place than to that of any other camera.
        let left = displacement(&mut explorer, 7);
        let truth = explorer.data.truth.clone().unwrap();
        let others = (0..truth.len()).filter(|i| *i != 7);
        let next = others.map(|i| (truth[i].center() - truth[7].center()).norm()).fold(f64::MAX, f64::min);
        assert!(away > 1.5 && left < 0.5 * next, "{away} before, {left} now, {next} to the next camera");
        let after = explorer.poses().unwrap();
        assert!((0..before.len()).all(|i| i == 7 || after[i] == before[i]));
        // A checkpoint holds where it is now.
        let tensors = explorer.tensors().unwrap();
        lose(&mut explorer, 7);
        explorer.relocalised = back;
        explorer.restore(&Checkpoint { step: 400, seconds: 0.0, steps: vec![], tensors }).unwrap();
        assert_eq!(explorer.poses().unwrap(), after);
        assert_eq!(explorer.relocalised, [], "what happened after it did not happen");
    }

    #[test]
    fn the_gauge_is_never_moved() {
        let mut explorer = learned(&["warp.fix_first=true"]);
        lose(&mut explorer, 0);
        assert_eq!(relocalise(&mut explorer).unwrap(), []);
    }
}
