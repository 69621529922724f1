//! Running the command on an experiment small enough for a test.

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

impl Workplace {
    pub fn new() -> Workplace {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("tiny.toml"), TINY).unwrap();
        Workplace { dir }
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

    /// Names of the files and folders here, without the settings.
    pub fn left_behind(&self) -> Vec<String> {
        let mut names: Vec<String> = names(self.dir.path()).into_iter().filter(|n| n != "tiny.toml").collect();
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
