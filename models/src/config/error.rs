//! Errors about settings: which file and line or option, which field, what was expected.

use std::fmt;
use std::path::PathBuf;

/// Where a value was set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A line of a file or a built-in preset.
    Line { file: String, line: usize },
    /// An option of the command line or a call of the API, as written.
    Option(String),
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Origin::Line { file, line } => write!(f, "{file}:{line}"),
            Origin::Option(text) => f.write_str(text),
        }
    }
}

/// What can be wrong with settings.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("there is no preset `{name}`{}; `raygrad presets` lists them", did_you_mean(.nearest))]
    UnknownPreset { name: String, nearest: Option<String> },
    #[error("cannot read the settings file {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{origin}: not valid TOML: {message}")]
    Syntax { origin: Origin, message: String },
    #[error("{origin}: unknown key `{key}`{}", did_you_mean(.nearest))]
    UnknownKey { origin: Origin, key: String, nearest: Option<String> },
    #[error("{origin}: `{key}`: {message}")]
    Value { origin: Origin, key: String, message: String },
    #[error("{file}: missing `{key}`; add it, or build on a preset with `base = \"{base}\"`")]
    Missing { file: String, key: String, base: &'static str },
    #[error("{file}: missing `presets`, the list of what to run")]
    MissingOfSweep { file: String },
    #[error("{origin}: `base` chains back to `{name}`: a file cannot build on itself")]
    Cycle { origin: Origin, name: String },
    #[error("`--set {text}`: expected `--set section.key=value`, for example `--set optim.steps=1000`")]
    NotAnAssignment { text: String },
}

fn did_you_mean(nearest: &Option<String>) -> String {
    nearest.as_ref().map_or(String::new(), |n| format!("; did you mean `{n}`?"))
}
