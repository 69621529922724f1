//! `raygrad export`: the cameras that a run found, for other programs.

use crate::held::HeldRun;
use crate::{output_folder, print};
use clap::{Args, ValueEnum};
use raygrad::Error;
use raygrad::evaluation::{Colmap, ExportCamera, poses_bounds, transforms_json};
use raygrad::run::files::write_atomically;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Args)]
pub struct ExportArgs {
    #[command(flatten)]
    held: HeldRun,
    /// Folder to write into.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Formats to write, separated by commas; by default all that can hold the cameras.
    #[arg(long, value_enum, value_delimiter = ',')]
    format: Vec<Format>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// `transforms.json` (NeRF, instant-ngp, nerfstudio).
    Transforms,
    /// `cameras.txt`, `images.txt` and `points3D.txt` in a folder `colmap`.
    Colmap,
    /// `poses_bounds.npy` (LLFF).
    PosesBounds,
}

impl Format {
    fn write(self, cameras: &[ExportCamera], folder: &Path) -> Result<&'static str, Error> {
        match self {
            Format::Transforms => {
                write_atomically(&folder.join("transforms.json"), transforms_json(cameras)?.as_bytes())?;
                Ok("transforms.json")
            }
            Format::Colmap => {
                let model = Colmap::new(cameras)?;
                let folder = folder.join("colmap");
                output_folder(&folder)?;
                model.write(&folder)?;
                Ok("colmap")
            }
            Format::PosesBounds => {
                write_atomically(&folder.join("poses_bounds.npy"), &poses_bounds(cameras)?)?;
                Ok("poses_bounds.npy")
            }
        }
    }
}

pub fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let cameras = args.held.experiment()?.restored_explorer()?.cameras()?;
    output_folder(&args.out)?;
    let (all, asked) = (args.format.is_empty(), &args.format);
    let formats = if all { Format::value_variants() } else { asked };
    for format in formats {
        match format.write(&cameras, &args.out) {
            Ok(name) => print(&format!("{} cameras in {}\n", cameras.len(), args.out.join(name).display()))?,
            // Nobody asked for this one.
            Err(Error::Export(error)) if all => note!("note: left out: {error}"),
            Err(error) => return Err(error.into()),
        }
    }
    Ok(ExitCode::SUCCESS)
}
