//! A run that is there already, as `eval`, `export` and `video` take it.

use clap::Args;
use raygrad::{Error, Experiment};
use std::path::PathBuf;

#[derive(Args)]
pub struct HeldRun {
    /// Folder of the run.
    pub run: PathBuf,
    /// Folder of its scene, where that has moved.
    #[arg(long, value_name = "DIR")]
    data: Option<String>,
    /// Where to compute: `auto`, `cpu`, `wgpu` or `vulkan`, the latter two with `:N` for the Nth adapter.
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// Threads of the CPU backend. Results do not depend on them.
    #[arg(long, value_name = "N")]
    threads: Option<String>,
    /// Fit the poses once more, on a grid of N x N pixels of every view (0: take those of the last step).
    #[arg(long, value_name = "N")]
    fit_grid: Option<String>,
}

impl HeldRun {
    /// The experiment, from the settings in the folder.
    pub fn experiment(&self) -> Result<Experiment, Error> {
        let mut experiment = Experiment::of_run(&self.run)?;
        let options = [
            ("--data", "scene.path", &self.data),
            ("--device", "run.device", &self.device),
            ("--threads", "run.threads", &self.threads),
            ("--fit-grid", "train.fit_grid", &self.fit_grid),
        ];
        crate::set_options(&mut experiment, &options)?;
        Ok(experiment)
    }
}
