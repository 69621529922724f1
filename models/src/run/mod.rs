//! What a run leaves behind: its folder, metrics and checkpoints, and how it tells of its progress.

pub mod checkpoint;
pub mod files;
pub mod folder;
pub mod lock;
pub mod metrics;
pub mod results;

pub use checkpoint::{Checkpoint, CheckpointError};
pub use folder::{EVALUATION, FolderError, RunFolder};
pub use metrics::{Entry, Final, Measured, Metrics, Relocalised};
