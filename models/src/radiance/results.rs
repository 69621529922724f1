//! The files of a 3D run: where it starts, frames of the animation, rendered views, poses, measurements and report.

use super::data::{START, SpaceData, SpaceDataError};
use super::evaluate::{Found, evaluate};
use super::explorer::Explorer;
use crate::Error;
use crate::config::Layered;
use crate::evaluation::{CameraLayout, CameraPanel, DepthStyle, Evaluation, Metric, Stage, camera_plot, inverse_depth};
use crate::geometry::Pose;
use crate::pictures::{self, Canvas};
use crate::report::{Picture, Report};
use crate::run::metrics::{Final, Metrics};
use crate::run::results::{FRAMES, animation};
use crate::run::{EVALUATION, RunFolder};
use crate::scene::{Layout, View, stand_around};
use crate::training::{Training, Watch};

/// Test views shown in the report.
const SHOWN: usize = 6;

/// What was written of an evaluation.
pub struct Written {
    pub evaluation: Evaluation,
    /// Some test views with their photos and depths, as one PNG.
    pub views: Option<Vec<u8>>,
    /// The cameras before and after, as SVG.
    pub cameras: String,
}

/// What the run starts from, before it begins.
pub fn write_data(folder: &RunFolder, data: &SpaceData) -> Result<(), Error> {
    folder.write(START, data.start.to_json(Some(data.seed), data.scene.training_poses()).as_bytes())?;
    Ok(())
}

/// One frame of the animation: the first validation view as it is seen now.
pub fn write_frame(folder: &RunFolder, explorer: &mut Explorer) -> Result<(), Error> {
    let scene = &explorer.data.scene;
    let Some(View { pose, intrinsics, .. }) = scene.val.first().or(scene.train.first()).cloned() else { return Ok(()) };
    let pose = match pose {
        Some(pose) => explorer.learned_pose(&pose)?,
        None => explorer.poses()?[0],
    };
    let seen = explorer.render(&pose, &intrinsics, Watch::none())?;
    let canvas = Canvas::from_colors(intrinsics.width, intrinsics.height, &seen.rgb);
    folder.write(&format!("{FRAMES}/{:07}.png", explorer.steps_done()), &canvas.to_png()?)?;
    Ok(())
}

/// Measures the model, and writes `evaluation.json`, the test views, the poses and a plot of the cameras.
pub fn write_evaluation(folder: &RunFolder, explorer: &mut Explorer, watch: Watch) -> Result<Written, Error> {
    let shifted = explorer.data.scene.layout == Layout::Blender;
    let mut shown = vec![];
    let found = evaluate(explorer, watch, |seen| {
        let (i, lens, rendered) = (seen.index, &seen.view.intrinsics, &seen.rendered);
        let rgb = Canvas::from_colors(lens.width, lens.height, &rendered.rgb);
        folder.write(&format!("test/{i:03}.png"), &rgb.to_png()?)?;
        let style = DepthStyle { scale: seen.scale, shifted };
        let depth = inverse_depth(lens.width, lens.height, &rendered.depth, &rendered.opacity, style);
        folder.write(&format!("test/{i:03}_depth.png"), &depth.to_png()?)?;
        if shown.len() < SHOWN {
            shown.push(vec![Canvas::from_colors(lens.width, lens.height, &seen.view.rgb()), rgb, depth]);
        }
        Ok(())
    })?;
    let views = if shown.is_empty() { None } else { Some(pictures::tile(&shown).to_png()?) };
    if let Some(png) = &views {
        folder.write("test_views.png", png)?;
    }
    write_poses(folder, &explorer.data, &found)?;
    let cameras = cameras(&explorer.data, &found)?;
    folder.write("cameras.svg", cameras.as_bytes())?;
    folder.write(EVALUATION, found.evaluation.to_json().as_bytes())?;
    Ok(Written { evaluation: found.evaluation, views, cameras })
}

/// `poses.json`: the poses found, in the learned world and aligned with the true one, world to camera, row by row.
fn write_poses(folder: &RunFolder, data: &SpaceData, found: &Found) -> Result<(), Error> {
    let names: Vec<&str> = data.scene.train.iter().map(|v| v.name.as_str()).collect();
    let rows = |poses: &[Pose]| poses.iter().map(|p| p.to_rows()).collect::<Vec<_>>();
    let aligned = found.similarity.align(&found.poses);
    let found = serde_json::json!({ "views": names, "learned": rows(&found.poses), "aligned": rows(&aligned) });
    folder.write("poses.json", serde_json::to_string_pretty(&found).unwrap_or_default().as_bytes())?;
    Ok(())
}

/// The poses that training started from and those it found, each aligned with the true ones, as a drawing.
fn cameras(data: &SpaceData, found: &Found) -> Result<String, Error> {
    let reference = data.truth.clone().unwrap_or_default();
    let around = match data.scene.layout {
        Layout::Blender | Layout::Dtu => true,
        Layout::Llff => false,
        _ => stand_around(data.truth.as_ref().unwrap_or(&found.poses)),
    };
    let layout = if around { CameraLayout::Orbit } else { CameraLayout::ForwardFacing };
    let panel = |title: &str, poses: &[Pose]| -> Result<CameraPanel, Error> {
        let similarity = data.similarity(poses).map_err(SpaceDataError::from)?;
        Ok(CameraPanel { title: title.into(), predicted: similarity.align(poses), reference: reference.clone() })
    };
    Ok(camera_plot(layout, &[panel("before", &data.start.poses)?, panel("after", &found.poses)?])?)
}

/// The animation and the page.
pub fn write_report(
    folder: &RunFolder,
    layered: &Layered,
    explorer: &Explorer,
    metrics: &Metrics,
    written: &Written,
) -> Result<(), Error> {
    let animation = animation(folder, explorer.steps_done())?;
    let mut pictures = vec![];
    if let Some(png) = &written.views {
        let caption = "Test views: the photo, the same rendered by the model, and its inverse depth.";
        pictures.push(Picture { title: "Views", caption, png });
    }
    if let Some(png) = &animation {
        pictures.push(Picture { title: "Training", caption: "A view over training.", png });
        folder.write("training.png", png)?;
    }
    let config = toml::to_string(&layered.settings).unwrap_or_default();
    let device = explorer.learner().device_name();
    let caption = "Cameras before and after: where they are taken to be (teal), where they are (purple), and the way between (red).";
    let drawings = vec![(caption, written.cameras.as_str())];
    let (title, device, evaluation) = (layered.name.as_str(), device.as_str(), &written.evaluation);
    let report = Report { title, device, metrics, evaluation, pictures, drawings, config: &config };
    Ok(folder.write("report.html", report.to_html()?.as_bytes())?)
}

/// The headline numbers of a run with so many training views, as lines of text.
pub fn summary(views: usize, last: &Final, evaluation: Option<&Evaluation>) -> String {
    let (steps, time) = (last.entry.step, crate::report::duration(last.seconds));
    let mut text = String::new();
    // What was evaluated: a run that ends with averages, or fits its poses once more, ends elsewhere than its last step.
    let mean = |metric| evaluation.and_then(|e| e.cameras.mean.get(metric));
    if let (Some(r), Some(t)) = (mean(Metric::RotationErrorDeg), mean(Metric::TranslationErrorX100)) {
        let shared =
            evaluation.and_then(|e| e.common_turn_deg).map_or(String::new(), |d| format!(", {d:.3} shared by all"));
        text += &format!("rotation error     {r:.3} deg (mean over {views} training views{shared})\n");
        text += &format!("translation error  {t:.3} x 0.01\n");
    }
    for metric in Metric::ALL.into_iter().filter(|m| m.is_of_views()) {
        let of = |stage| evaluation.and_then(|e| e.stage(stage)?.mean.get(metric));
        let Some(before) = of(Stage::Before) else { continue };
        let refined = of(Stage::After).map_or(String::new(), |v| format!(", refined {v:.0$}", metric.decimals()));
        let name = format!("test {}", metric.heading());
        text += &format!("{name:<18} {before:.0$}{refined}\n", metric.decimals());
    }
    for note in evaluation.into_iter().flat_map(Evaluation::notes) {
        text += &format!("note: {note}\n");
    }
    text + &format!("training PSNR      {:.2} dB\nsteps              {steps} in {time}\n", last.entry.psnr_db())
}
