//! `raygrad make-scene`: the built-in scene as files.

use crate::{print, progress};
use clap::Args;
use raygrad::scene::make_scene::{MakeOptions, make_scene};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct MakeSceneArgs {
    /// Folder to make it in: a new or an empty one.
    folder: PathBuf,
    /// Training views; a tenth as many more for validation, a fifth for testing, at least 4 each.
    #[arg(long, value_name = "N", default_value_t = MakeOptions::default().views)]
    views: usize,
    /// Height and width of the images in pixels.
    #[arg(long, value_name = "N", default_value_t = MakeOptions::default().size)]
    size: usize,
    /// Seed of shapes, colours and cameras.
    #[arg(long, value_name = "N", default_value_t = MakeOptions::default().seed)]
    seed: u32,
}

pub fn run(args: &MakeSceneArgs) -> anyhow::Result<ExitCode> {
    let options = MakeOptions { views: args.views, size: args.size, seed: args.seed };
    let bar = progress::bar("making", "images");
    let made = make_scene(&args.folder, &options, &|done, all| bar.show(done, all));
    bar.finish();
    made.map_err(raygrad::Error::from)?;
    print(&format!("a scene of {} training views in {}\n", args.views, args.folder.display()))?;
    Ok(ExitCode::SUCCESS)
}
