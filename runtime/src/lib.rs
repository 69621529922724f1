//! raygrad's runtime: runs compiled programs on a device and keeps what they share.
//!
//! A [`Session`] holds the inputs of its programs (parameters, state, data, per-step values) by name, so a training step
//! and an evaluation see the same parameters. The `cpu` backend needs no driver; `wgpu` runs the same programs on any
//! adapter.

pub mod cpu;
mod device;
mod error;
mod session;
#[cfg(feature = "wgpu")]
pub mod wgpu;

pub use device::{Device, DeviceInfo};
pub use error::{DeviceError, RunError};
pub use session::{InputInfo, ProgramId, Session};
