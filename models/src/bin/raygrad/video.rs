//! `raygrad video`: the papers' novel views of a run.

use crate::held::HeldRun;
use crate::progress::bar;
use crate::{output_folder, print};
use clap::Args;
use raygrad::Error;
use raygrad::evaluation::{FRAMES, Video, write_video};
use std::path::PathBuf;
use std::process::ExitCode;

/// Frames a second.
const RATE: u32 = 30;

#[derive(Args)]
pub struct VideoArgs {
    #[command(flatten)]
    held: HeldRun,
    /// Folder to write into; by default that of the run.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Frames of the video, thirty a second.
    #[arg(long, value_name = "N", default_value_t = FRAMES)]
    frames: usize,
}

pub fn run(args: &VideoArgs) -> anyhow::Result<ExitCode> {
    let mut explorer = args.held.experiment()?.restored_explorer()?;
    let shown = bar("rendering", "frames");
    let views = explorer.novel_views(args.frames, &|done, all| shown.show(done, all));
    shown.finish();
    let views = views?;
    let folder = args.out.as_ref().unwrap_or(&args.held.run);
    output_folder(folder)?;
    for (name, frames) in [("novel_view", &views.rgb), ("novel_view_depth", &views.depth)] {
        let path = match write_video(frames, RATE, &folder.join(name)).map_err(Error::from)? {
            Video::Mp4(path) | Video::AnimatedPng(path, None) => path,
            Video::AnimatedPng(path, Some(failure)) => {
                note!("note: an animated picture instead of a video: {failure}");
                path
            }
        };
        print(&format!("{}\n", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}
