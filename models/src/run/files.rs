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

/// Refuses a path that nothing can be written to, before there is anything to write: one in no folder, or a folder.
pub fn can_be_written(path: &Path) -> Result<(), WriteError> {
    let refuse = |kind: std::io::ErrorKind| Err(WriteError { path: path.to_path_buf(), source: kind.into() });
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match path.is_dir() {
        true => refuse(std::io::ErrorKind::IsADirectory),
        false if !folder.is_dir() => refuse(std::io::ErrorKind::NotFound),
        false => Ok(()),
    }
}

/// The same for a file that must not be there yet: of two that write one at a time, one gets an error.
pub fn write_new(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    place(path, bytes, |file| file.persist_noclobber(path).map(drop))
}

fn place(
    path: &Path,
    bytes: &[u8],
    persist: impl FnOnce(NamedTempFile) -> Result<(), tempfile::PersistError>,
) -> Result<(), WriteError> {
    let refuse = |source| WriteError { path: path.to_path_buf(), source };
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let file = NamedTempFile::with_prefix_in(".raygrad-", folder).map_err(refuse)?;
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
