//! The run folder: which run it holds, and that nothing of another run is overwritten.

use super::checkpoint::MANIFEST;
use super::files::{WriteError, tidy, write_atomically, write_new};
use super::lock::{LOCK, RunLock};
use crate::config::{ConfigError, Count, DeviceChoice, Layered, Networks, Settings};
use std::path::{Path, PathBuf};

/// Name of the resolved settings, which mark a folder as a run's.
pub const CONFIG: &str = "config.toml";
/// Name of what was measured of a run.
pub const EVALUATION: &str = "evaluation.json";

/// Why a folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("{} is the folder of a run, not of a sweep; give another one with `--out`", .path.display())]
    OfRun { path: PathBuf },
    #[error("{} is not a folder", .path.display())]
    NotAFolder { path: PathBuf },
    #[error("cannot use the folder {}: {source}", .path.display())]
    Access { path: PathBuf, source: std::io::Error },
    #[error("the folder {} is not empty and holds no raygrad run; give another with `--out`", .path.display())]
    Foreign { path: PathBuf },
    #[error(
        "the folder {} holds another run{}; give another with `--out`{}",
        .path.display(),
        .difference.as_ref().map_or(String::new(), |d| format!(" ({d})")),
        if .difference.is_none() { ", or continue it with `--resume`" } else { "" }
    )]
    Occupied { path: PathBuf, difference: Option<String> },
    #[error(
        "the folder {} holds this run, which was cut off before its first checkpoint; remove the folder to begin anew",
        .path.display()
    )]
    CutOff { path: PathBuf },
    #[error("the run in {} is being trained by another process; wait for it, or give another folder with `--out`", .path.display())]
    InUse { path: PathBuf },
    #[error("nothing to resume: {} holds no checkpoint", .path.display())]
    NothingToResume { path: PathBuf },
    #[error("there is no run in {}: {lacks}", .path.display())]
    NoRun { path: PathBuf, lacks: String },
    #[error("{} cannot be read back: {source}", .path.display())]
    Config { path: PathBuf, source: Box<ConfigError> },
}

/// A folder that belongs to one run.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
    /// Folders made for this run, innermost first, removed again if the run does not begin.
    made: Vec<PathBuf>,
    /// Files written before the run began, removed likewise.
    written: std::cell::RefCell<Vec<PathBuf>>,
    kept: bool,
    /// Of a folder that is trained into.
    lock: Option<RunLock>,
}

impl RunFolder {
    fn at(path: &Path, kept: bool, lock: Option<RunLock>) -> RunFolder {
        RunFolder { path: path.to_path_buf(), made: vec![], written: Default::default(), kept, lock }
    }

    /// The folder a run gets if none is asked for: `runs/NAME`, then `runs/NAME-2`, ...: the first free one, or to
    /// resume, the last that is there.
    pub fn default_path(name: &str, resume: bool) -> PathBuf {
        let nth = |n: usize| Path::new("runs").join(if n == 1 { name.to_string() } else { format!("{name}-{n}") });
        let free = (1..).map(nth).position(|p| !p.exists()).unwrap_or(0) + 1;
        nth(if resume { (free - 1).max(1) } else { free })
    }

    /// Claims an empty or new folder. Nothing is written yet.
    pub fn claim(path: &Path, settings: &Settings) -> Result<RunFolder, FolderError> {
        if path.exists() {
            match RunFolder::held_settings(path)? {
                Some(held) => {
                    let (path, difference) = (path.to_path_buf(), difference(&held, settings));
                    if difference.is_none() && path.join(LOCK).exists() {
                        RunLock::take(&path)?;
                    }
                    let cut_off = difference.is_none() && !path.join(MANIFEST).exists();
                    return Err(if cut_off {
                        FolderError::CutOff { path }
                    } else {
                        FolderError::Occupied { path, difference }
                    });
                }
                None if is_empty(path)? => {}
                None => return Err(FolderError::Foreign { path: path.to_path_buf() }),
            }
        }
        Ok(RunFolder::at(path, false, None))
    }

    /// Opens the folder of the same run again, to train on in it.
    pub fn reopen(path: &Path, settings: &Settings) -> Result<RunFolder, FolderError> {
        RunFolder::check(path, settings)?;
        let lock = RunLock::take(path)?;
        tidy(path);
        Ok(RunFolder::at(path, true, Some(lock)))
    }

    /// Refuses a folder that does not hold this run.
    pub fn check(path: &Path, settings: &Settings) -> Result<(), FolderError> {
        let missing = || FolderError::NothingToResume { path: path.to_path_buf() };
        if !path.exists() {
            return Err(missing());
        }
        let held = RunFolder::held_settings(path)?.ok_or_else(missing)?;
        match difference(&held, settings) {
            None => Ok(()),
            difference => Err(FolderError::Occupied { path: path.to_path_buf(), difference }),
        }
    }

    /// Opens the folder of a run to add to it.
    pub fn open(path: &Path) -> Result<RunFolder, FolderError> {
        RunFolder::settings_of_run(path)?;
        Ok(RunFolder::at(path, true, None))
    }

    /// Takes away what a run left that was cut off before its first checkpoint, so that it can begin anew.
    ///
    /// # Errors
    /// If it is not cut off but being trained, or its files cannot be removed.
    pub fn clear(path: &Path) -> Result<(), FolderError> {
        if !path.exists() {
            return Ok(());
        }
        let refuse = |source| FolderError::Access { path: path.to_path_buf(), source };
        let _lock = RunLock::take(path)?;
        // Another process may have trained it since it was looked at.
        if path.join(MANIFEST).exists() {
            return Err(FolderError::Occupied { path: path.to_path_buf(), difference: None });
        }
        for entry in std::fs::read_dir(path).map_err(refuse)? {
            let entry = entry.map_err(refuse)?;
            // Without the lock file another process could make one, and have a lock of its own.
            if entry.file_name() == LOCK {
                continue;
            }
            let is_folder = entry.file_type().map_err(refuse)?.is_dir();
            if is_folder { std::fs::remove_dir_all(entry.path()) } else { std::fs::remove_file(entry.path()) }
                .map_err(refuse)?;
        }
        Ok(())
    }

    /// Settings of a run that has a checkpoint, named as its folder is.
    pub fn settings_of_run(path: &Path) -> Result<Layered, FolderError> {
        let no_run = |lacks: &str| FolderError::NoRun { path: path.to_path_buf(), lacks: lacks.to_string() };
        if !path.exists() {
            return Err(no_run("no such folder"));
        }
        let mut layered = RunFolder::held(path)?.ok_or_else(|| no_run(&format!("it holds no {CONFIG}")))?;
        if !path.join(MANIFEST).exists() {
            return Err(no_run("it has no checkpoint yet"));
        }
        let name = path.canonicalize().ok().and_then(|p| Some(p.file_name()?.to_string_lossy().into_owned()));
        layered.name = name.unwrap_or(layered.name);
        Ok(layered)
    }

    /// Settings of the run in a folder, if it holds one.
    pub fn held_settings(path: &Path) -> Result<Option<Settings>, FolderError> {
        Ok(RunFolder::held(path)?.map(|l| l.settings))
    }

    fn held(path: &Path) -> Result<Option<Layered>, FolderError> {
        if !path.is_dir() {
            return Err(FolderError::NotAFolder { path: path.to_path_buf() });
        }
        let config = path.join(CONFIG);
        if !config.exists() {
            return Ok(None);
        }
        match Layered::load(&config.to_string_lossy()) {
            Ok(layered) => Ok(Some(layered)),
            Err(source) => Err(FolderError::Config { path: config, source: Box::new(source) }),
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes the folder and writes the resolved settings; if even that fails, the folder goes away again.
    pub fn start(&mut self, settings: &Settings) -> Result<(), FolderError> {
        for folder in self.path.ancestors().filter(|p| !p.as_os_str().is_empty()).take_while(|p| !p.exists()) {
            self.made.push(folder.to_path_buf());
        }
        std::fs::create_dir_all(&self.path)
            .map_err(|source| FolderError::Access { path: self.path.clone(), source })?;
        if self.lock.is_none() {
            let is_new = !self.path.join(LOCK).exists();
            self.lock = Some(RunLock::take(&self.path)?);
            self.written.get_mut().extend(is_new.then(|| self.path.join(LOCK)));
        }
        // Of two runs that claimed the folder together, one after the other, the one that makes the file has it.
        let config = self.path.join(CONFIG);
        // A setting that later versions add is then what that preset says: as it was before.
        let base = if settings.scene.is_some() { "l2g-blender" } else { "planar-l2g" };
        let text = format!("base = \"{base}\"\n\n{}", toml::to_string(settings).unwrap_or_default());
        write_new(&config, text.as_bytes()).map_err(|error| match error.source.kind() {
            std::io::ErrorKind::AlreadyExists => FolderError::Occupied { path: self.path.clone(), difference: None },
            _ => FolderError::from(error),
        })?;
        self.written.get_mut().push(config);
        Ok(())
    }

    /// From here on the folder stays, whatever happens.
    pub fn keep(&mut self) {
        self.kept = true;
    }

    /// Writes one file of the run.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), WriteError> {
        let path = self.path.join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).map_err(|source| WriteError { path: path.clone(), source })?;
        }
        write_atomically(&path, bytes)?;
        if !self.kept {
            self.written.borrow_mut().push(path);
        }
        Ok(())
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        if self.kept {
            return;
        }
        // Only what this run made, while it still has the lock: a failure to tidy up is no news.
        for file in self.written.borrow().iter() {
            let _ = std::fs::remove_file(file);
        }
        for folder in &self.made {
            let _ = std::fs::remove_dir(folder);
        }
    }
}

fn is_empty(path: &Path) -> Result<bool, FolderError> {
    let mut entries =
        std::fs::read_dir(path).map_err(|source| FolderError::Access { path: path.to_path_buf(), source })?;
    Ok(entries.all(|e| e.is_ok_and(|e| e.file_name() == LOCK)))
}

/// The first setting in which two runs differ. Where a run computes is not part of what it is.
pub fn difference(held: &Settings, wanted: &Settings) -> Option<String> {
    // The same scene may be seen from elsewhere, where its path leads nowhere: what lies in it is compared once it is loaded.
    let place = |s: &Settings| std::fs::canonicalize(&s.scene.as_ref()?.path).ok();
    let moved = place(held).zip(place(wanted)).is_some_and(|(a, b)| a != b);
    let flat = |s: &Settings| {
        let mut s = s.clone();
        (s.run.device, s.run.threads) = (DeviceChoice::Auto, Count::All);
        (s.run.autotune, s.run.networks) = (false, Networks::Auto);
        let name = s.scene_name();
        if let Some(scene) = s.scene.as_mut().filter(|_| !moved) {
            scene.path = name;
        }
        let mut leaves = vec![];
        if let Ok(table) = toml::Table::try_from(&s) {
            for (section, values) in table {
                for (key, value) in values.as_table().cloned().unwrap_or_default() {
                    leaves.push((format!("{section}.{key}"), value));
                }
            }
        }
        leaves
    };
    if held.scene.is_some() != wanted.scene.is_some() {
        let [there, here] = [held, wanted].map(|s| if s.scene.is_some() { "in space" } else { "in the plane" });
        return Some(format!("there it is one {there}, here one {here}"));
    }
    let differs = flat(held).into_iter().zip(flat(wanted)).find(|(a, b)| a != b);
    differs.map(|((key, held), (_, wanted))| format!("there `{key}` is {held}, here {wanted}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_the_same_from_wherever_they_are_seen() {
        let dir = tempfile::tempdir().unwrap();
        let at = |path: &str| {
            let mut layered = Layered::load("l2g-small").unwrap();
            layered.set(&format!("scene.path={path}")).unwrap();
            layered.settings
        };
        let [one, other] = ["one", "other"].map(|part| {
            let folder = dir.path().join(part).join("lego");
            std::fs::create_dir_all(&folder).unwrap();
            folder.display().to_string()
        });
        let same = |a: &str, b: &str| difference(&at(a), &at(b)).is_none();
        assert!(same(&one, &format!("{one}/../lego/")) && same("gone/lego", &one) && same(&one, "lego"));
        assert!(!same(&one, &other) && !same(&one, "builtin") && !same("gone/lego", "gone/fern"));
    }

    #[test]
    fn another_run_is_never_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        let settings = Layered::load("planar-l2g").unwrap().settings;
        let mut other = settings.clone();
        other.optim.steps = 7;
        let path = dir.path().join("a/b");
        drop(RunFolder::claim(&path, &settings).unwrap());
        assert!(!path.exists());
        let mut folder = RunFolder::claim(&path, &settings).unwrap();
        folder.start(&settings).unwrap();
        drop(folder);
        assert!(!dir.path().join("a").exists(), "a run that wrote nothing leaves nothing");
        let mut folder = RunFolder::claim(&path, &settings).unwrap();
        folder.start(&settings).unwrap();
        folder.keep();
        drop(folder);
        let error = |r: Result<RunFolder, FolderError>| r.unwrap_err().to_string();
        let again = error(RunFolder::claim(&path, &settings));
        assert!(again.contains("cut off before its first checkpoint"), "{again}");
        std::fs::write(path.join(MANIFEST), "").unwrap();
        assert!(error(RunFolder::claim(&path, &settings)).contains("--resume"));
        let text = error(RunFolder::claim(&path, &other));
        assert!(text.contains("there `optim.steps` is 5000, here 7"), "{text}");
        assert!(RunFolder::reopen(&path, &settings).is_ok());
        let text = std::fs::read_to_string(path.join(CONFIG)).unwrap();
        let older: Vec<&str> = text.lines().filter(|l| !l.starts_with("warmup_pose")).collect();
        assert!(older.len() < text.lines().count());
        std::fs::write(path.join(CONFIG), older.join("\n")).unwrap();
        assert!(RunFolder::reopen(&path, &settings).is_ok(), "a setting of later versions");
        assert!(error(RunFolder::reopen(&path, &other)).contains("optim.steps"));
        std::fs::remove_file(path.join(CONFIG)).unwrap();
        std::fs::write(path.join("thesis.tex"), "x").unwrap();
        assert!(error(RunFolder::claim(&path, &settings)).contains("not empty"));
    }
    #[test]
    fn a_run_is_trained_by_one_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let settings = Layered::load("planar-l2g").unwrap().settings;
        let path = dir.path().join("run");
        let claim = || RunFolder::claim(&path, &settings);
        let in_use = |r: Result<RunFolder, FolderError>| matches!(r, Err(FolderError::InUse { .. }));
        let mut second = claim().unwrap();
        let mut first = claim().unwrap();
        first.start(&settings).unwrap();
        first.keep();
        assert!(matches!(second.start(&settings), Err(FolderError::InUse { .. })), "both claimed the folder");
        drop(second);
        // Before its first checkpoint a run is neither cut off nor to be cleared.
        assert!(in_use(claim()));
        assert!(matches!(RunFolder::clear(&path), Err(FolderError::InUse { .. })));
        assert!(path.join(CONFIG).exists());
        drop(first);
        assert!(matches!(claim(), Err(FolderError::CutOff { .. })));
        std::fs::write(path.join(MANIFEST), "").unwrap();
        let resumed = RunFolder::reopen(&path, &settings).unwrap();
        assert!(in_use(RunFolder::reopen(&path, &settings)) && in_use(claim()));
        // Readers need no lock.
        RunFolder::open(&path).unwrap();
        drop(resumed);
        drop(RunFolder::reopen(&path, &settings).unwrap());
        // What has a checkpoint is never cleared.
        assert!(matches!(RunFolder::clear(&path), Err(FolderError::Occupied { .. })));
        std::fs::remove_file(path.join(MANIFEST)).unwrap();
        RunFolder::clear(&path).unwrap();
        assert!(!path.join(CONFIG).exists());
        claim().unwrap().start(&settings).unwrap();
    }
}
