//! raygrad's kernels: launches lowered to CPU tile programs and to naga modules.
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
