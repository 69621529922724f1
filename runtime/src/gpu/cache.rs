//! Compiled pipelines on disk, so that a second start compiles nothing.
//!
//! One file an adapter and driver, `raygrad/<key>.bin` in the user's folder for caches: a hash of the driver's bytes, so
//! that no driver gets a damaged file, then the bytes. A file that cannot be read or written is as good as none.

use crate::RunError;
use etcetera::{BaseStrategy, choose_base_strategy};
use std::path::PathBuf;

/// A larger cache is not kept, and starts anew.
const MOST: usize = 64 << 20;
const HASH: usize = 32;

/// The file of an adapter's pipelines.
pub(crate) struct CacheFile {
    path: Option<PathBuf>,
    known: Option<blake3::Hash>,
}

impl CacheFile {
    /// The file, and what it holds: nothing where there is none, or a damaged one.
    pub fn open(key: &str) -> (CacheFile, Vec<u8>) {
        let folder = choose_base_strategy().ok().map(|s| s.cache_dir());
        let path = folder.map(|f| f.join("raygrad").join(format!("{key}.bin")));
        CacheFile::at(path)
    }

    pub(super) fn at(path: Option<PathBuf>) -> (CacheFile, Vec<u8>) {
        let small = |f: &&PathBuf| std::fs::metadata(f).is_ok_and(|m| m.len() <= (MOST + HASH) as u64);
        let mut bytes = path.as_ref().filter(small).and_then(|f| std::fs::read(f).ok()).unwrap_or_default();
        if bytes.len() < HASH {
            return (CacheFile { path, known: None }, vec![]);
        }
        let data = bytes.split_off(HASH);
        let hash = blake3::hash(&data);
        match hash.as_bytes()[..] == bytes {
            true => (CacheFile { path, known: Some(hash) }, data),
            false => (CacheFile { path, known: None }, vec![]),
        }
    }

    /// Writes the file if there is something new; under another name first, since others may read.
    pub fn save(&self, data: &[u8]) {
        let hash = blake3::hash(data);
        let Some(path) = self.path.as_ref().filter(|_| self.known != Some(hash)) else { return };
        if data.len() > MOST {
            let _ = std::fs::remove_file(path);
            return;
        }
        let part = path.with_extension(format!("{}.part", std::process::id()));
        let file = [hash.as_bytes(), data].concat();
        let folder = path.parent().map_or(Ok(()), std::fs::create_dir_all);
        if folder.and_then(|()| std::fs::write(&part, file)).and_then(|()| std::fs::rename(&part, path)).is_err() {
            let _ = std::fs::remove_file(&part);
        }
    }
}

/// Lines of a file that are kept; the oldest go first.
const KEPT: usize = 512;

/// What a file of lines knows of a key; what is made, and kept, where it has no line of the key that `read` understands.
pub(super) fn kept<T>(
    open: impl Fn() -> (CacheFile, Vec<u8>),
    key: &str,
    read: impl Fn(&str) -> Option<T>,
    write: impl Fn(&T) -> String,
    make: impl FnOnce() -> Result<T, RunError>,
) -> Result<T, RunError> {
    let known = |held: &[u8]| lines(held).into_iter().find(|l| l.0 == key).and_then(|l| read(&l.1));
    if let Some(value) = known(&open().1) {
        return Ok(value);
    }
    let made = make()?;
    // Others may have added theirs in the meantime, even one of this key.
    let (file, held) = open();
    if let Some(value) = known(&held) {
        return Ok(value);
    }
    let mut all = lines(&held);
    all.retain(|l| l.0 != key);
    all.push((key.to_string(), write(&made)));
    let first = all.len().saturating_sub(KEPT);
    let text: String = all[first..].iter().map(|(key, value)| format!("{key} {value}\n")).collect();
    file.save(text.as_bytes());
    Ok(made)
}

/// Keys, and what is said of them.
fn lines(held: &[u8]) -> Vec<(String, String)> {
    let one = |line: &str| line.split_once(' ').map(|(key, value)| (key.to_string(), value.to_string()));
    String::from_utf8_lossy(held).lines().filter_map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What another process has found in the meantime counts, so that both go on with the same; lines of other keys stay.
    #[test]
    fn the_first_answer_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines.bin");
        let open = || CacheFile::at(Some(path.clone()));
        let ask = |key: &str, made: usize, others: &str| {
            let make = || {
                if !others.is_empty() {
                    open().0.save(others.as_bytes());
                }
                Ok(made)
            };
            kept(open, key, |text| text.parse().ok(), usize::to_string, make).unwrap()
        };
        assert_eq!(ask("a", 1, ""), 1);
        assert_eq!(ask("a", 2, ""), 1);
        assert_eq!(ask("b", 3, "a 1\nb 4\n"), 4);
        assert_eq!(ask("c", 5, "a 1\nb 4\nc nonsense\n"), 5);
        assert_eq!(open().1, b"a 1\nb 4\nc 5\n");
    }

    #[test]
    fn keeps_what_it_gets_and_trusts_no_damaged_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deeper").join("adapter.bin");
        let open = || CacheFile::at(Some(path.clone()));
        let (file, found) = open();
        assert!(found.is_empty());
        file.save(b"pipelines");
        let (file, found) = open();
        assert_eq!(found, b"pipelines");
        file.save(b"other pipelines");
        assert_eq!(open().1, b"other pipelines");
        let mut bytes = std::fs::read(&path).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert!(open().1.is_empty());
        std::fs::write(&path, b"short").unwrap();
        assert!(open().1.is_empty());
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }
}
