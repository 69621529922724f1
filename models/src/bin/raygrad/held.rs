//! A run that is there already, as `eval`, `export` and `video` take it.

use clap::Args;
use raygrad::{Error, Experiment};
use std::path::{Path, PathBuf};

#[derive(Args)]
pub struct HeldRun {
    /// Folder of the run.
    pub run: PathBuf,
    /// Folder of its scene, where that has moved.
    #[arg(long, value_name = "DIR")]
    data: Option<String>,
    /// Its photo, where that has moved.
    #[arg(long, value_name = "FILE")]
    image: Option<String>,
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
        crate::place(&experiment, "the run", self.image.is_some(), self.data.is_some())?;
        if self.fit_grid.is_some() && experiment.layered.settings.scene.is_none() {
            let text = "the run is in the plane, where fits are measured on all pixels";
            return Err(experiment.layered.refuse("--fit-grid", text).into());
        }
        let options = [
            ("--data", "scene.path", &self.data),
            ("--image", "data.image", &self.image),
            ("--device", "run.device", &self.device),
            ("--threads", "run.threads", &self.threads),
            ("--fit-grid", "train.fit_grid", &self.fit_grid),
        ];
        crate::set_options(&mut experiment, &options)?;
        let settings = &experiment.layered.settings;
        let (key, path, option) = match &settings.scene {
            Some(scene) => ("scene.path", &scene.path, "--data"),
            None => ("data.image", &settings.data.image, "--image"),
        };
        if path != "builtin" && !Path::new(path).exists() {
            let text = format!("there is no {path}; `{option}` says where it is now");
            return Err(experiment.layered.refuse(key, text).into());
        }
        Ok(experiment)
    }
}
