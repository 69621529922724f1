//! Running the command on an experiment small enough for a test.

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;

/// A folder of its own, with the settings of a tiny experiment in it.
pub struct Workplace {
    dir: TempDir,
}

/// Registers 12 x 10 pixels of a 32 x 24 photo with networks of 16 channels.
const TINY: &str = r#"
base = "planar-l2g"

[data]
image_size = [24, 32]
patch_crop = [10, 12]
patches = 3
points_per_patch = 40

[noise]
homography = 0.05
rotation = 0.1

[warp]
code = 6
layers = [16, 16]
skip = [1]

[field]
layers = [16, 16]
bands = 3

[optim]
steps = 12

[run]
device = "cpu"
threads = 1
log_every = 4
picture_every = 6
checkpoint_every = 5
"#;

/// Registers five views of 16 x 16 pixels of a scene, likewise.
const SPACE: &str = r#"
base = "l2g-small"

[scene]
path = "scene"
image_size = [16, 16]
train_views = 5
val_views = 1
test_views = 2

[train]
rays = 20
samples = 8
refine_steps = 3

[field]
layers = [16, 16, 16]
bands = 2

[radiance]
skip = [2]
color_layers = [8]

[warp]
code = 4
layers = [8, 8]
skip = [1]

[optim]
steps = 6

[run]
device = "cpu"
threads = 1
log_every = 3
picture_every = 0
checkpoint_every = 2
"#;

const SETTINGS: [(&str, &str); 2] = [("tiny.toml", TINY), ("space.toml", SPACE)];

impl Workplace {
    pub fn new() -> Workplace {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in SETTINGS {
            std::fs::write(dir.path().join(name), text).unwrap();
        }
        Workplace { dir }
    }

    /// The same with a scene in the folder `scene`.
    pub fn in_space() -> Workplace {
        let w = Workplace::new();
        w.succeed(&["make-scene", "scene", "--views", "5", "--size", "16"]);
        w
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raygrad"));
        command.args(args).current_dir(self.dir.path());
        command
    }

    pub fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    /// Runs and expects success; standard output.
    pub fn succeed(&self, args: &[&str]) -> String {
        let output = self.run(args);
        assert!(output.status.success(), "raygrad {}:\n{}", args.join(" "), stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Runs and expects exit code 2 and one message of one line; the message.
    pub fn refuse(&self, args: &[&str]) -> String {
        let output = self.run(args);
        let text = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "raygrad {}:\n{text}", args.join(" "));
        assert!(text.starts_with("error: ") && text.trim_end().lines().count() == 1, "one message expected:\n{text}");
        text
    }

    pub fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&std::fs::read(self.path(name)).unwrap()).unwrap()
    }

    /// Names of the files and folders here, without the settings.
    pub fn left_behind(&self) -> Vec<String> {
        let mut names = names(self.dir.path());
        names.retain(|n| SETTINGS.iter().all(|(file, _)| n != file));
        names.sort();
        names
    }
}

pub fn names(folder: &Path) -> Vec<String> {
    std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[track_caller]
pub fn mentions(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "expected `{part}` in: {text}");
    }
}
