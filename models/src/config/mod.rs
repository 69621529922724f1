//! Experiments as settings: the same struct is preset, file, command line and API.
//!
//! Settings are layers: a preset or file, the `base` it builds on, and `--set` on top. Every value knows the file and
//! line, or the option, that it came from, so an error about it says where to look.

mod error;
mod layers;
mod leaves;
mod names;
mod presets;
mod settings;
mod sweep;
mod validate;
mod values;

pub use error::{ConfigError, Origin};
pub use layers::{Layered, nearest};
pub use presets::{PRESETS, Preset};
pub use settings::*;
pub use sweep::{Sweep, SweepCell};
pub use values::*;
