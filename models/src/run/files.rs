//! Writing files so that a reader finds either the old content or the new, never half of it.

use std::io::Write;
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// A file that could not be written: a full disk, missing rights, a vanished folder.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", .path.display())]
pub struct WriteError {
    pub path: PathBuf,
    pub source: std::io::Error,
}

/// Writes to a temporary file beside `path`, waits until it is on the disk, and puts it in place. What a link points to is
/// replaced, not the link; what is no file, as a terminal or `/dev/null`, is written to.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let refuse = |source| WriteError { path: path.to_path_buf(), source };
    if path.metadata().is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        return std::fs::OpenOptions::new().write(true).open(path).and_then(|mut f| f.write_all(bytes)).map_err(refuse);
    }
    let linked = if path.is_symlink() { path.canonicalize().ok() } else { None };
    let path = linked.as_deref().unwrap_or(path);
    place(path, bytes, |file| file.persist(path).map(drop))
}

/// Refuses a path that nothing can be written to, before there is anything to write: one in no folder or in one without the right
/// to write, or a folder.
pub fn can_be_written(path: &Path) -> Result<(), WriteError> {
    let refuse = |source| Err(WriteError { path: path.to_path_buf(), source });
    match path.metadata() {
        Ok(found) if found.is_dir() => refuse(std::io::ErrorKind::IsADirectory.into()),
        Ok(found) if !found.is_file() => Ok(()),
        _ => NamedTempFile::with_prefix_in(TEMPORARY, folder_of(path)).map(drop).or_else(refuse),
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// The same for a file that must not be there yet: of two that write one at a time, one gets an error.
pub fn write_new(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    place(path, bytes, |file| file.persist_noclobber(path).map(drop))
}

/// How temporary files are called, at first.
const TEMPORARY: &str = ".raygrad-";
/// Seconds after which nobody writes a temporary file any more.
const ABANDONED: u64 = 3600;

/// Removes the temporary files that killed processes left in a folder. One that will not go away does no harm.
pub fn tidy(folder: &Path) {
    let abandoned = |entry: &std::fs::DirEntry| {
        let written = entry.metadata().and_then(|m| m.modified());
        let age = written.ok().and_then(|time| time.elapsed().ok()).unwrap_or_default();
        entry.file_name().to_string_lossy().starts_with(TEMPORARY) && age.as_secs() >= ABANDONED
    };
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten().filter(abandoned) {
        let _ = std::fs::remove_file(entry.path());
    }
}

fn place(
    path: &Path,
    bytes: &[u8],
    persist: impl FnOnce(NamedTempFile) -> Result<(), tempfile::PersistError>,
) -> Result<(), WriteError> {
    let refuse = |source| WriteError { path: path.to_path_buf(), source };
    let folder = folder_of(path);
    let file = NamedTempFile::with_prefix_in(TEMPORARY, folder).map_err(refuse)?;
    let mut plain = file.as_file();
    plain.write_all(bytes).and_then(|()| plain.sync_all()).map_err(refuse)?;
    make_readable(file.as_file()).map_err(refuse)?;
    persist(file).map_err(|e| refuse(e.error))?;
    sync_folder(folder).map_err(refuse)
}

/// Temporary files are private to their owner; results are not.
#[cfg(unix)]
fn make_readable(file: &std::fs::File) -> std::io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    file.set_permissions(std::fs::Permissions::from_mode(0o644))
}
#[cfg(not(unix))]
fn make_readable(_: &std::fs::File) -> std::io::Result<()> {
    Ok(())
}

/// A rename is on the disk once its folder is.
#[cfg(unix)]
fn sync_folder(folder: &Path) -> std::io::Result<()> {
    std::fs::File::open(folder)?.sync_all()
}
#[cfg(not(unix))]
fn sync_folder(_: &Path) -> std::io::Result<()> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_whole_files_and_leaves_nothing_behind() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_atomically(&path, b"one").unwrap();
        write_atomically(&path, b"two").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        assert!(write_new(&path, b"three").is_err());
        write_new(&dir.path().join("b.txt"), b"three").unwrap();
        std::fs::remove_file(dir.path().join("b.txt")).unwrap();
        assert!(write_atomically(&path.join("below"), b"x").unwrap_err().to_string().contains("a.txt"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_killed_processes_left_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let make = |name: &str, seconds: u64| {
            let file = std::fs::File::create(dir.path().join(name)).unwrap();
            file.set_modified(std::time::SystemTime::now() - std::time::Duration::from_secs(seconds)).unwrap();
        };
        make(".raygrad-old", ABANDONED + 60);
        make(".raygrad-new", 60);
        make("raygrad-own", ABANDONED + 60);
        tidy(dir.path());
        let mut left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, [".raygrad-new", "raygrad-own"]);
    }

    #[cfg(unix)]
    #[test]
    fn links_and_devices_stay_what_they_are() {
        use std::os::unix::fs::{FileTypeExt, symlink};
        let dir = tempfile::tempdir().unwrap();
        let (path, link, device) = (dir.path().join("a"), dir.path().join("link"), dir.path().join("pipe"));
        write_atomically(&path, b"one").unwrap();
        symlink(&path, &link).unwrap();
        write_atomically(&link, b"two").unwrap();
        assert!(link.is_symlink() && std::fs::read(&path).unwrap() == b"two");
        // Of the kinds of files that are none this one takes no rights to make.
        let made = std::process::Command::new("mkfifo").arg(&device).status();
        if !made.is_ok_and(|s| s.success()) {
            return;
        }
        // Opened for both, neither end waits for the other.
        let mut pipe = std::fs::OpenOptions::new().read(true).write(true).open(&device).unwrap();
        write_atomically(&device, b"three").unwrap();
        assert!(device.metadata().unwrap().file_type().is_fifo());
        let mut read = [0; 5];
        std::io::Read::read_exact(&mut pipe, &mut read).unwrap();
        assert_eq!(&read, b"three");
    }
}
