//! One process at a time trains the run in a folder.
//!
//! The process that does holds a lock on a file in it. The system gives the lock back when the process ends, however it
//! ends, so that the file alone means nothing. Who only reads a run takes no lock.

use super::folder::FolderError;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::ErrorKind;
use std::path::Path;

/// Name of the file in the run folder.
pub const LOCK: &str = ".lock";

/// Held as long as this lives.
#[derive(Debug)]
pub struct RunLock {
    _file: File,
}

impl RunLock {
    /// Takes the lock of a folder that is there.
    ///
    /// # Errors
    /// If another has it, or the file cannot be written.
    pub fn take(folder: &Path) -> Result<RunLock, FolderError> {
        let path = folder.join(LOCK);
        let refuse = |source| FolderError::Access { path: path.clone(), source };
        let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path).map_err(refuse)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => Err(FolderError::InUse { path: folder.to_path_buf() }),
            // Some network file systems know no locks; runs there are worth more than their protection.
            Err(TryLockError::Error(e)) if e.kind() != ErrorKind::Unsupported => Err(refuse(e)),
            Ok(()) | Err(TryLockError::Error(_)) => Ok(RunLock { _file: file }),
        }
    }
}
