//! `raygrad data`: what a scene's folder holds.

use crate::{print, progress};
use clap::Args;
use raygrad::Error;
use raygrad::run::files::write_atomically;
use raygrad::scene::{DepthRange, Layout, LoadOptions, Scene, SceneError, View, load, plot, stand_around};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct DataArgs {
    /// Folder of the scene.
    folder: PathBuf,
    /// Read it as this layout instead of the first that fits: blender, transforms, dtu, llff, colmap or folder.
    #[arg(long, value_name = "LAYOUT", value_parser = layout)]
    layout: Option<Layout>,
    /// Draw the cameras from above and from the side into this file (`.svg` or `.png`).
    #[arg(long, value_name = "FILE", value_parser = plot_file)]
    plot: Option<PathBuf>,
}

fn layout(name: &str) -> Result<Layout, String> {
    let names: Vec<&str> = Layout::ALL.iter().map(|l| l.name()).collect();
    Layout::from_name(name).ok_or_else(|| format!("expected one of {}", names.join(", ")))
}

fn plot_file(name: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(name);
    let known = path.extension().is_some_and(|e| e == "svg" || e == "png");
    if known { Ok(path) } else { Err("expected a name ending in `.svg` or `.png`".to_string()) }
}

pub fn run(args: &DataArgs) -> anyhow::Result<ExitCode> {
    let options = LoadOptions { layout: args.layout, ..LoadOptions::default() };
    let bar = progress::bar("reading", "images");
    let loaded = load(&args.folder, &options, &|done, all| bar.show(done, all));
    bar.finish();
    // Sizes may differ where they are brought to one later; the summary shows the first.
    let loaded = loaded.or_else(|error| match error {
        SceneError::MixedSizes { expected, .. } => {
            note!("warning: {error}");
            load(&args.folder, &LoadOptions { size: Some(expected), ..options }, &|_, _| ())
        }
        other => Err(other),
    });
    let scene = loaded.map_err(Error::from)?;
    print(&summary(&scene))?;
    if starts_blind(&scene) {
        note!(
            "warning: the cameras stand around something; training that starts captures from the identity finds cameras \
             that look the same way only: give it rough poses (scene.poses)"
        );
    }
    if let Some(path) = &args.plot {
        let bytes = match path.extension().is_some_and(|e| e == "svg") {
            true => plot::svg(&scene).map_err(Error::from)?.into_bytes(),
            false => plot::png(&scene).map_err(Error::from)?,
        };
        write_atomically(path, &bytes).map_err(Error::from)?;
        print(&format!("plot          {}\n", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Whether training would start from poses that it cannot get away from.
fn starts_blind(scene: &Scene) -> bool {
    let poses: Vec<_> = scene.train.iter().filter_map(|v| v.pose).collect();
    scene.layout.is_capture() && stand_around(&poses)
}

fn summary(scene: &Scene) -> String {
    let mut text = String::new();
    let mut line = |name: &str, value: String| text += &format!("{name:<13} {value}\n");
    // One folder may be both.
    let val = if scene.val == scene.test { &[][..] } else { &scene.val };
    let all: Vec<&View> = scene.train.iter().chain(val).chain(&scene.test).collect();
    line("layout", scene.layout.to_string());
    let (train, val, test) = (scene.train.len(), scene.val.len(), scene.test.len());
    let same = if scene.val == scene.test && val > 0 { " (the same)" } else { "" };
    line("views", format!("{train} to train, {val} to validate, {test} to test{same}"));
    let c = &scene.train[0].intrinsics;
    line("size", format!("{} x {} (height x width)", c.height, c.width));
    let (mut low, mut high) = (f64::INFINITY, 0.0f64);
    for view in &all {
        (low, high) = (low.min(view.intrinsics.fx), high.max(view.intrinsics.fx));
    }
    let angle = 2.0 * (c.width as f64 / (2.0 * c.fx)).atan().to_degrees();
    let vary = if high - low > 1e-3 * high { format!("; fx from {low:.1} to {high:.1}") } else { String::new() };
    let numbers = format!("fx {:.2}, fy {:.2}, cx {:.2}, cy {:.2} px", c.fx, c.fy, c.cx, c.cy);
    line("intrinsics", format!("{numbers}, {angle:.1} degrees wide{vary}"));
    if let Some([k1, k2, p1, p2]) = scene.train[0].removed_distortion {
        line("distortion", format!("k1 {k1}, k2 {k2}, p1 {p1}, p2 {p2}; removed on loading"));
    }
    line(
        "depth",
        match scene.depth {
            DepthRange::Metric { near, far } => format!("{near:.3} to {far:.3}"),
            DepthRange::Inverse { near } => format!("inverse, from {near:.3} to infinity"),
        },
    );
    let poses: Vec<_> = all.iter().filter_map(|v| v.pose).collect();
    line(
        "poses",
        if poses.is_empty() { "none".to_string() } else { format!("{} of {} views", poses.len(), all.len()) },
    );
    if !poses.is_empty() {
        let radii: Vec<f64> = poses.iter().map(|p| p.center().norm()).collect();
        let mean = radii.iter().sum::<f64>() / radii.len() as f64;
        let (least, most) = radii.iter().fold((f64::INFINITY, 0.0f64), |(l, m), r| (l.min(*r), m.max(*r)));
        line("cameras", format!("{mean:.3} from the origin on average, {least:.3} to {most:.3}"));
        line("scale", format!("1 unit of the files is {:.5} here", scene.frame.scale));
    }
    let count = |has: &dyn Fn(&View) -> bool| all.iter().filter(|v| has(v)).count();
    let (masks, depths) = (count(&|v| v.mask.is_some() || v.transparent), count(&|v| v.depth.is_some()));
    line("masks, depths", format!("{masks} and {depths} of {} views", all.len()));
    if scene.train.iter().any(|v| v.transparent) {
        line("background", "white behind transparent pixels".to_string());
    }
    for note in &scene.notes {
        line("note", note.clone());
    }
    text
}
