//! What a model in space is measured by: the poses of its training views after alignment, and its pictures and depths of
//! the test views, at the poses that the alignment gives and after test-time refinement.

use super::data::SpaceDataError;
use super::explorer::{Explorer, Rendered};
use crate::Error;
use crate::config::Method;
use crate::evaluation::{
    Evaluation, Lpips, Measured, Picture, Scores, Similarity, ViewScores, depth_errors, psnr, ssim,
};
use crate::geometry::Pose;
use crate::scene::View;

/// What was found of a model.
#[derive(Clone, Debug)]
pub struct Found {
    pub evaluation: Evaluation,
    /// Of the training views, in the learned world.
    pub poses: Vec<Pose>,
    /// From the learned world to the true one.
    pub similarity: Similarity,
}

/// A test view as the model sees it from the last pose it has: the refined one, where poses are refined.
#[derive(Debug)]
pub struct Seen<'a> {
    /// Number of the view among the test views.
    pub index: usize,
    pub view: &'a View,
    pub rendered: Rendered,
    /// True units per learned unit.
    pub scale: f64,
}

/// Measures the model as it is. `show` gets every test view once, and `progress` hears how many of how many are done.
pub fn evaluate(
    explorer: &mut Explorer,
    progress: &dyn Fn(usize, usize),
    mut show: impl FnMut(&Seen) -> Result<(), Error>,
) -> Result<Found, Error> {
    let (data, lpips) = (explorer.data.clone(), explorer.lpips.clone());
    let poses = explorer.poses()?;
    let similarity = data.similarity(&poses).map_err(SpaceDataError::from)?;
    let cameras = data.pose_scores(&poses).map_err(SpaceDataError::from)?;
    let settings = &explorer.settings;
    let (scene, method) = (settings.scene_name(), settings.method_name().to_string());
    // Known poses need no refinement: they are what the field was learned with.
    let refines = settings.warp.method != Method::None && settings.train.as_ref().is_some_and(|t| t.refine_steps > 0);
    let test: Vec<(usize, &View, Pose)> =
        data.scene.test.iter().enumerate().filter_map(|(i, v)| Some((i, v, v.pose?))).collect();
    let (mut before, mut after) = (vec![], vec![]);
    for (done, (index, view, reference)) in test.iter().enumerate() {
        progress(done, test.len());
        let score = |rendered: &Rendered| -> Result<ViewScores, Error> {
            let scores = scores(rendered, view, similarity.scale, lpips.as_deref())?;
            Ok(ViewScores { view: view.name.clone(), scores })
        };
        let pose = similarity.to_learned(reference);
        let mut rendered = explorer.render(&pose, &view.intrinsics)?;
        before.push(score(&rendered)?);
        if refines {
            let refined = explorer.refined(&pose, view)?;
            rendered = explorer.render(&refined, &view.intrinsics)?;
            after.push(score(&rendered)?);
        }
        show(&Seen { index: *index, view, rendered, scale: similarity.scale })?;
    }
    let measured = |views: Vec<ViewScores>| (!views.is_empty()).then(|| Measured::new(views));
    let evaluation = Evaluation { scene, method, cameras, before: measured(before), after: measured(after) };
    Ok(Found { evaluation, poses, similarity })
}

fn scores(seen: &Rendered, view: &View, scale: f64, lpips: Option<&Lpips>) -> Result<Scores, Error> {
    let (width, height) = (view.intrinsics.width, view.intrinsics.height);
    let photo = view.rgb();
    let (a, b) = (Picture::new(width, height, &seen.rgb)?, Picture::new(width, height, &photo)?);
    Ok(Scores {
        psnr_db: Some(psnr(&a, &b)?),
        ssim: Some(ssim(&a, &b)?),
        lpips: lpips.map(|l| l.distance(&a, &b)).transpose()?,
        depth_error: depth_error(seen, view, scale)?,
        ..Scores::default()
    })
}

/// Mean absolute error of the composited depth in true units, where the view has a depth.
fn depth_error(seen: &Rendered, view: &View, scale: f64) -> Result<Option<f64>, Error> {
    let Some(truth) = &view.depth else { return Ok(None) };
    let valid: Vec<bool> = truth.iter().map(|d| *d > 0.0).collect();
    match valid.contains(&true) {
        true => Ok(Some(depth_errors(&seen.depth, truth, &valid, scale)?.abs)),
        false => Ok(None),
    }
}
