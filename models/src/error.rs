//! Everything that can end an experiment early.

use crate::config::ConfigError;
use crate::evaluation::{
    CameraPlotError, CloudError, ExportError, ImageError, MeshError, MeshFileError, VideoError, WeightsError,
};
use crate::pictures::PictureError;
use crate::planar::DataError;
use crate::radiance::data::SpaceDataError;
use crate::report::PlotError;
use crate::run::files::WriteError;
use crate::run::{CheckpointError, FolderError};
use crate::scene::{NoiseError, SceneError, make_scene::MakeError};
use raygrad_compiler::StepError;
use raygrad_runtime::{DeviceError, RunError};

#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Data(#[from] DataError),
    #[error(transparent)]
    Space(#[from] SpaceDataError),
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Weights(#[from] WeightsError),
    #[error(transparent)]
    CameraPlot(#[from] CameraPlotError),
    #[error(transparent)]
    Mesh(#[from] MeshError),
    #[error(transparent)]
    MeshFile(#[from] MeshFileError),
    #[error(transparent)]
    Cloud(#[from] CloudError),
    #[error(transparent)]
    Export(#[from] ExportError),
    #[error(transparent)]
    Video(#[from] VideoError),
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Noise(#[from] NoiseError),
    #[error(transparent)]
    MakeScene(#[from] MakeError),
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Picture(#[from] PictureError),
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error("the model does not compile: {0}")]
    Compile(#[from] StepError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(
        "the model uses the parameter `{name}`, which `parameters()` of its warp or field does not list: it would stay 0"
    )]
    UnlistedParameter { name: String },
    #[error(
        "the training step reads the input `{name}`, which nothing sets: it would stay 0. A warp's own numbers are constants, or \
         parameters that its `parameters()` lists; what changes in training are the inputs `progress` and `step`"
    )]
    UnsetInput { name: String },
    #[error("stopped before everything was measured")]
    Stopped,
    #[error("`{what}` is not finite after step {step}; the last checkpoint is unharmed")]
    NotFinite { what: String, step: usize },
    #[error(
        "{source}\nthe run is kept as it was after step {step}; continue with the same command and `--out {folder} --resume`"
    )]
    DeviceFailed { source: RunError, step: usize, folder: String },
}

impl Error {
    /// Whether what the user gave is at fault, or the disk it goes to, and not the computation.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Error::Image(error) => matches!(error, ImageError::Small { .. }),
            Error::Mesh(error) => !matches!(
                error,
                MeshError::Density(_) | MeshError::NotFinite { .. } | MeshError::Count { .. } | MeshError::NoSurface
            ),
            Error::Video(error) => matches!(error, VideoError::Empty | VideoError::Rate(_) | VideoError::Write(_)),
            Error::Picture(_)
            | Error::CameraPlot(_)
            | Error::Plot(_)
            | Error::Compile(_)
            | Error::Run(_)
            | Error::DeviceFailed { .. }
            | Error::Stopped
            | Error::NotFinite { .. } => false,
            _ => true,
        }
    }
}
