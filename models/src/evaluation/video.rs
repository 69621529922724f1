//! Videos: MP4 where the program ffmpeg is at hand, else an animated PNG, which every browser plays.

use crate::pictures::{Canvas, PictureError, animate_at};
use crate::run::files::{WriteError, write_atomically};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Video {
    Mp4(PathBuf),
    /// With what the program said that should have made the MP4; nothing where there is no such program.
    AnimatedPng(PathBuf, Option<String>),
}

#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    #[error("a video needs at least one frame")]
    Empty,
    #[error("a video needs a frame rate of 1 to 1000 a second, not {0}")]
    Rate(u32),
    #[error(
        "frame {frame} has {} x {} pixels (width x height), the first has {} x {}",
        .found[0], .found[1], .first[0], .first[1]
    )]
    Size { frame: usize, first: [usize; 2], found: [usize; 2] },
    #[error(transparent)]
    Picture(#[from] PictureError),
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Writes `stem.mp4` through the ffmpeg on the search path, or `stem.png`, animated, where there is none or it fails.
///
/// # Errors
/// If there are no frames, they differ in size, or the file cannot be written.
pub fn write_video(frames: &[Canvas], rate: u32, stem: &Path) -> Result<Video, VideoError> {
    write_video_with("ffmpeg", frames, rate, stem)
}

/// The same with the name of the program.
///
/// # Errors
/// As [`write_video`].
pub fn write_video_with(program: &str, frames: &[Canvas], rate: u32, stem: &Path) -> Result<Video, VideoError> {
    let first = frames.first().map(|f| [f.width(), f.height()]).ok_or(VideoError::Empty)?;
    if !(1..=1000).contains(&rate) {
        return Err(VideoError::Rate(rate));
    }
    if let Some((frame, odd)) = frames.iter().enumerate().find(|(_, f)| [f.width(), f.height()] != first) {
        return Err(VideoError::Size { frame, first, found: [odd.width(), odd.height()] });
    }
    let path = with_extension(stem, "mp4");
    let failure = match encode(program, frames, rate, first, &path) {
        Ok(()) => return Ok(Video::Mp4(path)),
        Err(failure) => failure,
    };
    // What it has written of the video is none.
    let _ = std::fs::remove_file(&path);
    let path = with_extension(stem, "png");
    let shown = (1000 / rate) as u16;
    write_atomically(&path, &animate_at(frames, shown, shown)?)?;
    Ok(Video::AnimatedPng(path, failure))
}

/// Unlike [`Path::with_extension`] it keeps the dots of a name.
fn with_extension(stem: &Path, extension: &str) -> PathBuf {
    let mut name = stem.as_os_str().to_owned();
    name.push(".");
    name.push(extension);
    name.into()
}

/// Feeds the frames to the program. Of a failure, what is to be told; nothing if there is no such program.
fn encode(program: &str, frames: &[Canvas], rate: u32, size: [usize; 2], path: &Path) -> Result<(), Option<String>> {
    let pipe = |source: std::io::Error| Some(format!("{program} cannot be run: {source}"));
    let mut command = Command::new(program);
    command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
    command.args(["-s", &format!("{}x{}", size[0], size[1]), "-r", &rate.to_string(), "-i", "-"]);
    // The common colour format needs even sides; the padding is white as the papers' page.
    command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-pix_fmt", "yuv420p"]);
    command.arg(path).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = match command.spawn() {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Err(None),
        child => child.map_err(pipe)?,
    };
    let mut input = child.stdin.take();
    // A program that gives up early closes the pipe; its own message says more than that.
    let fed = frames.iter().try_for_each(|f| input.as_mut().map_or(Ok(()), |i| i.write_all(f.0.as_raw())));
    drop(input);
    let output = child.wait_with_output().map_err(pipe)?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(Some(format!("{program} failed ({}): {}", output.status, said.trim())));
    }
    fed.map_err(pipe)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<Canvas> {
        (0..4).map(|i| Canvas::new(6, 5, [i * 60, 0, 0])).collect()
    }

    #[test]
    fn without_the_program_the_video_is_an_animated_png() {
        let dir = tempfile::tempdir().unwrap();
        let stem = dir.path().join("novel.view");
        let video = write_video_with("no-such-program-here", &frames(), 30, &stem).unwrap();
        assert_eq!(video, Video::AnimatedPng(dir.path().join("novel.view.png"), None));
        let bytes = std::fs::read(dir.path().join("novel.view.png")).unwrap();
        assert!(bytes.windows(4).any(|w| w == b"acTL"), "not animated");
    }

    #[test]
    fn frames_of_several_sizes_and_none_are_refused() {
        let mut all = frames();
        all.push(Canvas::new(7, 5, [0; 3]));
        let refuse = |frames: &[Canvas], rate| write_video(frames, rate, Path::new("x")).unwrap_err();
        assert!(matches!(refuse(&all, 30), VideoError::Size { frame: 4, first: [6, 5], found: [7, 5] }));
        assert!(matches!(refuse(&[], 30), VideoError::Empty));
        assert!(matches!(refuse(&frames(), 0), VideoError::Rate(0)));
    }

    #[cfg(unix)]
    #[test]
    fn the_program_gets_every_frame_and_its_failure_is_told() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let program = |name: &str, script: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, script).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
            path.into_os_string().into_string().unwrap()
        };
        // Keeps what it is fed as the file it is asked for, its last argument.
        let keeps = program("keeps", "#!/bin/sh\nfor last; do :; done\ncat > \"$last\"\n");
        let video = write_video_with(&keeps, &frames(), 30, &dir.path().join("a")).unwrap();
        assert_eq!(video, Video::Mp4(dir.path().join("a.mp4")));
        let expected: Vec<u8> = frames().iter().flat_map(|f| f.0.as_raw().clone()).collect();
        assert_eq!(std::fs::read(dir.path().join("a.mp4")).unwrap(), expected);
        // What fails half-way leaves an animated picture alone.
        let fails =
            program("fails", "#!/bin/sh\nfor last; do :; done\necho x > \"$last\"\necho no such codec >&2\nexit 3\n");
        let video = write_video_with(&fails, &frames(), 30, &dir.path().join("b")).unwrap();
        let Video::AnimatedPng(path, Some(failure)) = video else { panic!("{video:?}") };
        assert!(failure.contains("fails failed") && failure.ends_with("no such codec"), "{failure}");
        assert!(path == dir.path().join("b.png") && path.exists() && !dir.path().join("b.mp4").exists());
        let locked = dir.path().join("locked");
        std::fs::write(&locked, "no program").unwrap();
        let video = write_video_with(locked.to_str().unwrap(), &frames(), 30, &dir.path().join("c")).unwrap();
        assert!(matches!(&video, Video::AnimatedPng(_, Some(f)) if f.contains("cannot be run")), "{video:?}");
    }
}
