//! Layers of settings: a file, the `base` below it, assignments above it, each value with its origin.
//!
//! A file may say what it sets for some scenes only: below `[captures]` where the scene is a capture
//! ([`crate::scene::Layout::is_capture`]), as in `optim.lr = 1e-3`, and below `[on.NAME]` where it is called so
//! ([`Settings::scene_name`]). Whatever is set later, in a file or by an assignment, wins.

use super::error::{ConfigError, Origin};
use super::leaves::{Leaf, leaves};
use super::presets::{PRESETS, Preset};
use super::settings::Settings;
use crate::warps::{self, Warp};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use toml::{Table, Value};

/// Settings together with where each value came from.
#[derive(Clone, Debug)]
pub struct Layered {
    /// Name of the preset, or stem of the file.
    pub name: String,
    pub settings: Settings,
    /// What was set for each key, in order; of those that hold the last one is in force.
    set: BTreeMap<String, Vec<Setting>>,
    /// What the conditions are about.
    scene: Scene,
}

/// One value that was set.
#[derive(Clone, Debug)]
struct Setting {
    when: When,
    value: Value,
    origin: Origin,
}

/// Where a value holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum When {
    Always,
    /// The scene is a capture.
    Capture,
    /// The scene has this name.
    On(String),
}

#[derive(Clone, Debug, Default)]
struct Scene {
    name: String,
    is_capture: bool,
}

/// The keys on which the scene depends.
const SCENE: [&str; 3] = ["scene.path", "scene.layout", "data.image"];

impl When {
    /// The condition in front of a key of a file, and the key.
    pub(super) fn split(key: &str) -> (When, &str) {
        if let Some(key) = key.strip_prefix("captures.") {
            return (When::Capture, key);
        }
        match key.strip_prefix("on.").and_then(|rest| rest.split_once('.')) {
            Some((scene, key)) => (When::On(scene.to_string()), key),
            None => (When::Always, key),
        }
    }

    fn holds(&self, scene: &Scene) -> bool {
        match self {
            When::Always => true,
            When::Capture => scene.is_capture,
            When::On(name) => *name == scene.name,
        }
    }
}

impl Scene {
    fn of(settings: &Settings) -> Scene {
        let is_capture = settings.scene.as_ref().is_some_and(|s| s.layout().is_capture());
        Scene { name: settings.scene_name(), is_capture }
    }
}

impl Layered {
    /// Loads a preset by name, or a file if `name` ends in `.toml`.
    pub fn load(name: &str) -> Result<Layered, ConfigError> {
        load(name, &mut vec![])
    }

    /// Sets one value; `text` is `section.key=value`, the value in TOML or a bare word.
    pub fn set(&mut self, text: &str) -> Result<(), ConfigError> {
        let refused = || ConfigError::NotAnAssignment { text: text.to_string() };
        let (key, raw) = text.split_once('=').ok_or_else(refused)?;
        let (key, raw) = (key.trim(), raw.trim());
        if key.is_empty() {
            return Err(refused());
        }
        self.assign(key, raw, Origin::Option(format!("--set {text}")))
    }

    /// Sets one value, given as it would be written in a file or as a bare word.
    pub fn assign(&mut self, key: &str, raw: &str, origin: Origin) -> Result<(), ConfigError> {
        let word = Value::String(raw.to_string());
        let parsed =
            format!("v = {raw}").parse::<Table>().ok().filter(|t| t.len() == 1).and_then(|mut t| t.remove("v"));
        match parsed {
            None => self.apply(key, word, origin),
            // A path such as `2024` is a number in TOML, but a word where a word is due.
            Some(value) => {
                self.apply(key, value, origin.clone()).or_else(|e| self.apply(key, word, origin).map_err(|_| e))
            }
        }
    }

    /// Sets a value that is text, such as a path.
    pub fn set_text(&mut self, key: &str, text: &str, origin: Origin) {
        // Text fits a field of text: there is nothing to refuse.
        let _ = self.apply(key, Value::String(text.to_string()), origin);
    }

    /// Where the value in force was set.
    pub fn origin(&self, key: &str) -> Origin {
        let set = self.set.get(key).and_then(|set| self.in_force(set));
        set.map_or_else(|| Origin::Option(self.name.clone()), |s| s.origin.clone())
    }

    /// An error about the value of `key`.
    pub fn refuse(&self, key: &str, message: impl Into<String>) -> ConfigError {
        ConfigError::Value { origin: self.origin(key), key: key.to_string(), message: message.into() }
    }

    /// The warp of so many frames that the settings ask for. That of a program is not to be had from them.
    pub fn built_in_warp(&self, frames: usize) -> Result<Arc<dyn Warp>, ConfigError> {
        let own = &self.settings.warp.own;
        if own.is_empty() {
            return Ok(warps::of_settings(&self.settings, frames));
        }
        let text =
            format!("`{own}` is the warp of a program: resume and measure its runs there, with `Experiment::warp`");
        Err(self.refuse("warp.own", text))
    }

    /// The settings that hold for this scene, and would not for any other: keys and values.
    pub fn of_scene(&self) -> Vec<(&str, &Value)> {
        let mut found = vec![];
        for (key, set) in &self.set {
            let Some(s) = self.in_force(set).filter(|s| s.when != When::Always) else { continue };
            found.push((key.as_str(), &s.value));
        }
        found
    }

    /// Sets one value; a condition in front of the key says where it holds. The old one stays if the new one has the wrong type.
    pub(super) fn apply(&mut self, key: &str, value: Value, origin: Origin) -> Result<(), ConfigError> {
        let (when, key) = When::split(key);
        if !self.set.contains_key(key) {
            return Err(unknown(origin, key, self.set.keys()));
        }
        // In force or not, it must fit.
        let mut table = self.table();
        insert(&mut table, key, value.clone());
        let trial = parse(&table).map_err(|(field, message)| ConfigError::Value {
            origin: origin.clone(),
            key: if field.is_empty() { key.to_string() } else { field },
            message,
        })?;
        if SCENE.contains(&key) {
            if when != When::Always {
                let message = "what holds for some scenes cannot say which one it is".to_string();
                return Err(ConfigError::Value { origin, key: key.to_string(), message });
            }
            self.scene = Scene::of(&trial);
        }
        let set = self.set.entry(key.to_string()).or_default();
        if when == When::Always {
            set.clear();
        }
        set.push(Setting { when, value, origin });
        self.settle();
        Ok(())
    }

    fn in_force<'a>(&self, set: &'a [Setting]) -> Option<&'a Setting> {
        set.iter().rev().find(|s| s.when.holds(&self.scene))
    }

    /// All values in force.
    fn table(&self) -> Table {
        let mut table = Table::new();
        for (key, set) in &self.set {
            if let Some(s) = self.in_force(set) {
                insert(&mut table, key, s.value.clone());
            }
        }
        table
    }

    /// Takes the values in force. Each of them fitted when it was set, and fields do not depend on each other.
    fn settle(&mut self) {
        if let Ok(settings) = parse(&self.table()) {
            self.settings = settings;
        }
    }
}

fn load(name: &str, below: &mut Vec<String>) -> Result<Layered, ConfigError> {
    let (label, file, text) = match Preset::find(name) {
        Some(p) => (p.name.to_string(), format!("presets/{}.toml", p.name), p.text.to_string()),
        None if name.ends_with(".toml") => {
            let path = Path::new(name);
            let text =
                std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.into(), source })?;
            let stem = path.file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
            (stem, name.to_string(), text)
        }
        None => {
            let nearest = nearest(name, PRESETS.iter().map(|p| p.name));
            return Err(ConfigError::UnknownPreset { name: name.to_string(), nearest });
        }
    };
    // What holds for some scenes wins over what the same file sets for all, wherever in the file it stands.
    let (some, mut leaves): (Vec<Leaf>, Vec<Leaf>) =
        leaves(&file, &text)?.into_iter().partition(|l| When::split(&l.key).0 != When::Always);
    let base = leaves.iter().position(|l| l.key == "base").map(|i| leaves.remove(i));
    below.push(name.to_string());
    let mut layered = match base {
        None => root(label, file, leaves)?,
        Some(base) => {
            let Value::String(base_name) = &base.value else {
                let message = "expected the name of a preset or a file".to_string();
                return Err(ConfigError::Value { origin: base.origin, key: base.key, message });
            };
            if below.contains(base_name) {
                return Err(ConfigError::Cycle { origin: base.origin, name: base_name.clone() });
            }
            let mut layered = load(base_name, below)?;
            for leaf in leaves {
                layered.apply(&leaf.key, leaf.value, leaf.origin)?;
            }
            Layered { name: label, ..layered }
        }
    };
    for leaf in some {
        layered.apply(&leaf.key, leaf.value, leaf.origin)?;
    }
    Ok(layered)
}

/// A file without a base: it must set everything.
fn root(name: String, file: String, leaves: Vec<Leaf>) -> Result<Layered, ConfigError> {
    let space = leaves.iter().any(|l| l.key.starts_with("scene."));
    let known: Vec<String> = known_keys(space);
    let (mut table, mut set) = (Table::new(), BTreeMap::new());
    for Leaf { key, value, origin } in leaves {
        if !known.contains(&key) {
            return Err(unknown(origin, &key, known.iter()));
        }
        insert(&mut table, &key, value.clone());
        set.insert(key, vec![Setting { when: When::Always, value, origin }]);
    }
    if let Some(key) = known.iter().find(|k| !set.contains_key(*k)) {
        let base = if space { "l2g-blender" } else { "planar-l2g" };
        return Err(ConfigError::Missing { file, key: key.clone(), base });
    }
    let settings = parse(&table).map_err(|(key, message)| {
        let origin = set.iter().find(|(k, _)| key.starts_with(*k)).map(|(_, set)| set[0].origin.clone());
        ConfigError::Value { origin: origin.unwrap_or(Origin::Line { file, line: 1 }), key, message }
    })?;
    Ok(Layered { name, scene: Scene::of(&settings), settings, set })
}

/// The keys of the preset that sets them all, in 3D or 2D.
fn known_keys(space: bool) -> Vec<String> {
    let root = |p: &&Preset| !p.text.contains("\nbase ") && p.text.contains("\n[scene]") == space;
    let text = PRESETS.iter().find(root).map_or("", |p| p.text);
    let all = leaves("", text).unwrap_or_default().into_iter().map(|l| l.key);
    all.filter(|key| When::split(key).0 == When::Always).collect()
}

fn insert(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        None => {
            table.insert(key.to_string(), value);
        }
        Some((section, rest)) => {
            let inner = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
            if let Value::Table(inner) = inner {
                insert(inner, rest, value);
            }
        }
    }
}

/// The settings, or the field that does not fit and why.
fn parse(table: &Table) -> Result<Settings, (String, String)> {
    serde_path_to_error::deserialize(Value::Table(table.clone())).map_err(|e| {
        let path = e.path().to_string();
        let message = e.into_inner().message().to_string();
        let kinds = [("expected f64", "expected a number"), ("expected usize", "expected a whole number, 0 or more")];
        let more = [
            ("expected u32", "expected a whole number, 0 to 4294967295"),
            ("expected a boolean", "expected true or false"),
        ];
        let message = kinds.iter().chain(&more).fold(message, |m, (from, to)| m.replace(from, to));
        (path, message.trim().to_string())
    })
}

pub(super) fn unknown<'a>(origin: Origin, key: &str, known: impl Iterator<Item = &'a String>) -> ConfigError {
    ConfigError::UnknownKey { origin, key: key.to_string(), nearest: nearest(key, known.map(String::as_str)) }
}

/// The candidate closest to what was written, by edit distance of the whole and of the last component, if it is close.
pub fn nearest<'a>(written: &str, candidates: impl Iterator<Item = &'a str>) -> Option<String> {
    let leaf = |s: &str| s.rsplit('.').next().unwrap_or_default().to_string();
    let distance = |c: &str| {
        let whole = strsim::damerau_levenshtein(written, c);
        let last = 1 + strsim::damerau_levenshtein(&leaf(written), &leaf(c));
        if c.contains('.') { whole.min(last) } else { whole }
    };
    let best = candidates.map(|c| (distance(c), c)).min()?;
    (best.0 <= 2 + leaf(written).len() / 3).then(|| best.1.to_string())
}

#[cfg(test)]
#[path = "layers_tests.rs"]
mod tests;
