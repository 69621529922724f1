//! What a model in space is measured by: the poses of its training views after alignment, and its pictures and depths of
//! the test views, at the poses that the alignment gives and after test-time refinement.

use super::data::{SpaceData, SpaceDataError};
use super::explorer::{Explorer, Rendered, relocalise_every, validate_every};
use crate::Error;
use crate::config::{Method, Settings};
use crate::estimate::{Trial, timed};
use crate::evaluation::{
    Evaluation, Lpips, Measured, Picture, Scores, Similarity, ViewScores, common_turn, depth_errors, psnr, ssim,
};
use crate::geometry::Pose;
use crate::scene::View;
use crate::training::Watch;

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

/// Measures the model as it is. `show` gets every test view once, and `watch` hears how many of how many are done.
pub fn evaluate(
    explorer: &mut Explorer,
    watch: Watch,
    mut show: impl FnMut(&Seen) -> Result<(), Error>,
) -> Result<Found, Error> {
    let (data, lpips) = (explorer.data.clone(), explorer.lpips.clone());
    let (poses, lens) = (explorer.poses()?, explorer.found_lens()?);
    let similarity = data.similarity(&poses).map_err(SpaceDataError::from)?;
    let cameras = data.pose_scores(&poses).map_err(SpaceDataError::from)?;
    let truth = data.truth.as_ref().filter(|t| t.len() > 1);
    let turn = truth.map(|truth| common_turn(&similarity.align(&poses), truth)).transpose();
    let common_turn_deg = turn.map_err(SpaceDataError::from)?.map(f64::to_degrees);
    let settings = &explorer.settings;
    let (scene, method) = (settings.scene_name(), settings.method_name().to_string());
    let steps = refine_steps(settings);
    let test = tested(&data);
    let (mut before, mut after) = (vec![], vec![]);
    for (done, (index, view, reference)) in test.iter().enumerate() {
        watch.done(done, test.len());
        let score = |rendered: &Rendered| -> Result<ViewScores, Error> {
            let scores = scores(rendered, view, similarity.scale, lpips.as_deref())?;
            Ok(ViewScores { view: view.name.clone(), scores })
        };
        let pose = similarity.to_learned(reference);
        let mut rendered = explorer.render(&pose, &view.intrinsics, watch)?;
        before.push(score(&rendered)?);
        if steps > 0 {
            let refined = explorer.refined(&pose, view, steps, watch)?;
            rendered = explorer.render(&refined, &view.intrinsics, watch)?;
            after.push(score(&rendered)?);
        }
        show(&Seen { index: *index, view, rendered, scale: similarity.scale })?;
    }
    let measured = |views: Vec<ViewScores>| (!views.is_empty()).then(|| Measured::new(views));
    let (before, after, undetermined) = (measured(before), measured(after), similarity.is_ill_conditioned());
    let evaluation = Evaluation { scene, method, cameras, before, after, undetermined, common_turn_deg, lens };
    Ok(Found { evaluation, poses, similarity })
}

/// Steps of the refinement of a test pose. Known poses need none: they are what the field was learned with.
fn refine_steps(settings: &Settings) -> usize {
    let steps = settings.train.as_ref().map_or(0, |t| t.refine_steps);
    if settings.warp.method == Method::None { 0 } else { steps }
}

/// The test views that are measured, with their numbers and true poses.
fn tested(data: &SpaceData) -> Vec<(usize, &View, Pose)> {
    data.scene.test.iter().enumerate().filter_map(|(i, v)| Some((i, v, v.pose?))).collect()
}

/// PSNR of the first validation view, seen from its true pose as test views are; nothing where that is not known.
pub fn validate(explorer: &mut Explorer) -> Result<Option<f64>, Error> {
    let data = explorer.data.clone();
    let Some((view, truth)) = data.scene.val.first().and_then(|v| Some((v, v.pose?))) else { return Ok(None) };
    let pose = explorer.learned_pose(&truth)?;
    let seen = explorer.render(&pose, &view.intrinsics, Watch::none())?;
    let (width, height, photo) = (view.intrinsics.width, view.intrinsics.height, view.rgb());
    Ok(Some(psnr(&Picture::new(width, height, &seen.rgb)?, &Picture::new(width, height, &photo)?)?))
}

/// Times a part of a view, a step of the refinement of a pose, the scores of a view and a look for a lost camera, for all that
/// there are.
pub fn trial(explorer: &mut Explorer) -> Result<Trial, Error> {
    let (data, lpips) = (explorer.data.clone(), explorer.lpips.clone());
    let (search_every, mut recurring) = (relocalise_every(&explorer.settings), vec![]);
    if search_every > 0 {
        explorer.show_training_view(0)?;
        let mut compare = || timed(|| explorer.photo_error(&data.start.poses[0]).map(drop));
        compare()?;
        recurring.push((search_every, compare()? * data.scene.train.len() as f64));
    }
    let (pose, view) = (data.start.poses[0], data.scene.test.first().or(data.scene.val.first()));
    let Some(view) = view else { return Ok(Trial { recurring, evaluation: 0.0 }) };
    explorer.look(&pose, &view.intrinsics)?;
    let mut part = || {
        let mut seen = Rendered { rgb: vec![], depth: vec![], opacity: vec![] };
        timed(|| explorer.render_part(0, &mut seen))
    };
    // The first one warms up.
    part()?;
    let frame = part()? * explorer.parts().len() as f64;
    recurring.extend([(explorer.settings.run.picture_every, frame), (validate_every(&explorer.settings), frame)]);
    // Scores take the same whatever is seen.
    let pixels = view.pixels.len();
    let seen = Rendered { rgb: view.rgb(), depth: vec![1.0; pixels], opacity: vec![1.0; pixels] };
    let measured = frame + timed(|| scores(&seen, view, 1.0, lpips.as_deref()).map(drop))?;
    let mut evaluation = measured;
    let steps = refine_steps(&explorer.settings);
    if steps > 0 {
        let mut refine = |steps| timed(|| explorer.refined(&pose, view, steps, Watch::none()).map(drop));
        refine(1)?;
        evaluation += refine(1)? * steps as f64 + measured;
    }
    Ok(Trial { recurring, evaluation: evaluation * tested(&data).len() as f64 })
}

fn scores(seen: &Rendered, view: &View, scale: f64, lpips: Option<&Lpips>) -> Result<Scores, Error> {
    let pair = |seen: &[f32], photo: &[f32]| -> Result<(f64, f64, Option<f64>), Error> {
        let (width, height) = (view.intrinsics.width, view.intrinsics.height);
        let (a, b) = (Picture::new(width, height, seen)?, Picture::new(width, height, photo)?);
        Ok((psnr(&a, &b)?, ssim(&a, &b)?, lpips.map(|l| l.distance(&a, &b)).transpose()?))
    };
    let photo = view.rgb();
    let whole = pair(&seen.rgb, &photo)?;
    let masked = match &view.mask {
        Some(mask) => Some(pair(&on_white(&seen.rgb, mask), &on_white(&photo, mask))?),
        None => None,
    };
    Ok(Scores {
        psnr_db: Some(whole.0),
        ssim: Some(whole.1),
        lpips: whole.2,
        masked_psnr_db: masked.map(|m| m.0),
        masked_ssim: masked.map(|m| m.1),
        masked_lpips: masked.and_then(|m| m.2),
        depth_error: depth_error(seen, view, scale)?,
        ..Scores::default()
    })
}

/// White where the mask of a picture says background.
fn on_white(rgb: &[f32], mask: &[bool]) -> Vec<f32> {
    rgb.chunks(3).zip(mask).flat_map(|(c, m)| if *m { [c[0], c[1], c[2]] } else { [1.0; 3] }).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;

    #[test]
    fn what_lies_outside_a_mask_counts_in_the_whole_picture_alone() {
        let (height, width) = (12, 16);
        let n = height * width;
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 8.0, cy: 6.0, height, width, distortion: None };
        let inside = |i: usize| i % width < 4;
        let mask = Some((0..n).map(inside).collect());
        let mut view = View {
            name: "v".into(),
            file: "v.png".into(),
            file_size: [1, 1],
            removed_distortion: None,
            pixels: vec![[51, 102, 204, 255]; n],
            transparent: false,
            intrinsics,
            pose: None,
            mask,
            depth: None,
        };
        // Off by 0.1 on the object, by 0.2 around it.
        let rgb: Vec<f32> =
            (0..n).flat_map(|i| [0.2, 0.4, 0.8].map(|c| c - if inside(i) { 0.1 } else { 0.2 })).collect();
        let seen = Rendered { rgb, depth: vec![1.0; n], opacity: vec![1.0; n] };
        let found = scores(&seen, &view, 1.0, None).unwrap();
        let near = |found: Option<f64>, mse: f64| (found.unwrap() + 10.0 * mse.log10()).abs() < 1e-4;
        assert!(near(found.psnr_db, 0.25 * 0.01 + 0.75 * 0.04), "{found:?}");
        assert!(near(found.masked_psnr_db, 0.25 * 0.01), "{found:?}");
        assert!(found.masked_ssim > found.ssim && found.masked_lpips.is_none());
        view.mask = None;
        let found = scores(&seen, &view, 1.0, None).unwrap();
        assert_eq!((found.masked_psnr_db, found.masked_ssim), (None, None));
    }
}
