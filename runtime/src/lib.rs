//! raygrad's runtime: runs compiled programs on a device and keeps what they share.
//!
//! A [`Session`] holds the inputs of its programs (parameters, state, data, per-step values) by name, so a training step
//! and an evaluation see the same parameters. The `cpu` backend needs no driver; `wgpu` runs the same programs on any
//! adapter, `vulkan` on a Vulkan driver without a layer in between.

mod ceilings;
pub mod cpu;
mod device;
mod error;
#[cfg(feature = "gpu")]
mod gpu;
mod session;
#[cfg(feature = "vulkan")]
pub mod vulkan;
#[cfg(feature = "wgpu")]
pub mod wgpu;

#[cfg(feature = "gpu")]
pub use device::Forms;
pub use device::{Device, DeviceInfo, Precision};
pub use error::{DeviceError, RunError};
#[cfg(feature = "gpu")]
pub use gpu::{Adapter, AdapterKind};
pub use session::{InputInfo, ProgramId, Session};
