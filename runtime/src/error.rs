//! What can go wrong with devices and runs.

use raygrad_compiler::graph::Shape;
use raygrad_compiler::ops::input::Role;

/// A device that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    #[error("no GPU adapter {0}; `raygrad devices` lists what there is")]
    NoAdapter(String),
    #[error("Vulkan cannot be used: {0}")]
    NoVulkan(String),
    #[error("this build has no {0} backend (feature `{0}`)")]
    NotBuilt(&'static str),
    #[error("{device} has no half precision that raygrad uses; `--precision f32` runs everywhere")]
    NoHalf { device: String },
    #[error("cannot start {threads} threads: {reason}")]
    Threads { threads: usize, reason: String },
    #[error("the adapter `{name}` refused: {reason}")]
    Adapter { name: String, reason: String },
}

/// A program that cannot be loaded or run.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error("no program of this session has an input `{0}`")]
    UnknownInput(String),
    #[error("the program has no output `{0}`")]
    UnknownOutput(String),
    #[error("input `{name}` is {shape}: {expected} values expected, {found} given")]
    Length { name: String, shape: Shape, expected: usize, found: usize },
    #[error("input `{name}` is {shape}, the values given are {found}")]
    Type { name: String, shape: Shape, found: &'static str },
    #[error("`{name}` is {shape}: read its lanes (`read_lanes`, `get_lanes`), not floats")]
    Lanes { name: String, shape: Shape },
    #[error("input `{name}` is {first} in one program of the session and {second} in another")]
    Conflict { name: String, first: Shape, second: Shape },
    #[error(
        "input `{name}` is {first:?} in one program of the session and {second:?} in another: the host sets a PerStep input before every step"
    )]
    Roles { name: String, first: Role, second: Role },
    #[error("the program was compiled for {0:?}, which this device does not run")]
    Target(raygrad_compiler::fuse::TargetKind),
    #[error("{device}: `{buffer}` has {bytes} bytes, the device binds at most {limit} at once")]
    TooLarge { device: String, buffer: String, bytes: u64, limit: u64 },
    #[error("no memory for {what}, {bytes} bytes")]
    Memory { what: String, bytes: u64 },
    #[error("the program belongs to another session")]
    OtherSession,
    #[error("{device}: {problem}")]
    Device { device: String, problem: String },
}
