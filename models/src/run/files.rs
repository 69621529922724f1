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

/// Writes to a temporary file beside `path`, waits until it is on the disk, and puts it in place.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let refuse = |source| WriteError { path: path.to_path_buf(), source };
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let file = NamedTempFile::with_prefix_in(".raygrad-", folder).map_err(refuse)?;
    let mut plain = file.as_file();
    plain.write_all(bytes).and_then(|()| plain.sync_all()).map_err(refuse)?;
    make_readable(file.as_file()).map_err(refuse)?;
    file.persist(path).map_err(|e| refuse(e.error))?;
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
        assert!(write_atomically(&path.join("below"), b"x").unwrap_err().to_string().contains("a.txt"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
