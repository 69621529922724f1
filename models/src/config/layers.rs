//! Layers of settings: a file, the `base` below it, assignments above it, each value with its origin.
//!
//! A file may have a section `captures`: what it sets instead where the scene is a capture ([`crate::scene::Layout::is_capture`]), as in
//! `optim.lr = 1e-3` below `[captures]`. Whatever is set later, in a file or by an assignment, wins over both.

use super::error::{ConfigError, Origin};
use super::leaves::{Leaf, leaves};
use super::presets::{PRESETS, Preset};
use super::settings::Settings;
use std::collections::BTreeMap;
use std::path::Path;
use toml::{Table, Value};

/// Settings together with where each value came from.
#[derive(Clone, Debug)]
pub struct Layered {
    /// Name of the preset, or stem of the file.
    pub name: String,
    pub settings: Settings,
    table: Table,
    origins: BTreeMap<String, Origin>,
    /// The section `captures`; once the scene is a capture, what is set where it is not.
    other: BTreeMap<String, (Value, Origin)>,
    on_capture: bool,
}

/// Before the keys of the section.
const CAPTURES: &str = "captures.";
/// The key of the scene's folder.
const SCENE: &str = "scene.path";

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
        self.check_key(key, &origin)?;
        let word = Value::String(raw.to_string());
        let parsed =
            format!("v = {raw}").parse::<Table>().ok().filter(|t| t.len() == 1).and_then(|mut t| t.remove("v"));
        match parsed {
            None => self.put(key, word, origin),
            // A path such as `2024` is a number in TOML, but a word where a word is due.
            Some(value) => self.put(key, value, origin.clone()).or_else(|e| self.put(key, word, origin).map_err(|_| e)),
        }
    }

    /// Sets a value that is text, such as a path.
    pub fn set_text(&mut self, key: &str, text: &str, origin: Origin) {
        // Text fits a field of text: there is nothing to refuse.
        let _ = self.put(key, Value::String(text.to_string()), origin);
    }

    /// Where a value was set.
    pub fn origin(&self, key: &str) -> Origin {
        self.origins.get(key).cloned().unwrap_or_else(|| Origin::Option(self.name.clone()))
    }

    /// An error about the value of `key`.
    pub fn refuse(&self, key: &str, message: impl Into<String>) -> ConfigError {
        ConfigError::Value { origin: self.origin(key), key: key.to_string(), message: message.into() }
    }

    /// Whether the scene is a capture and something is set for those.
    pub fn is_on_capture(&self) -> bool {
        self.on_capture && !self.other.is_empty()
    }

    /// Sets a value that a file sets.
    pub(super) fn apply(&mut self, key: &str, value: Value, origin: Origin) -> Result<(), ConfigError> {
        self.check_key(key, &origin)?;
        self.put(key, value, origin)
    }

    /// Sets a value that a file sets for captures. In force or not, it must fit.
    fn apply_to_captures(&mut self, key: &str, value: Value, origin: Origin) -> Result<(), ConfigError> {
        self.check_key(key, &origin)?;
        let mut other = self.replace(key, value, origin)?;
        if !self.on_capture {
            other = self.replace(key, other.0, other.1)?;
        }
        self.other.insert(key.to_string(), other);
        Ok(())
    }

    fn check_key(&self, key: &str, origin: &Origin) -> Result<(), ConfigError> {
        if self.origins.contains_key(key) {
            return Ok(());
        }
        Err(unknown(origin.clone(), key, self.origins.keys()))
    }

    /// Sets one value, for captures and all other scenes; the old one stays if it has the wrong type.
    fn put(&mut self, key: &str, value: Value, origin: Origin) -> Result<(), ConfigError> {
        self.replace(key, value, origin)?;
        self.other.remove(key);
        if key == SCENE { self.suit_scene() } else { Ok(()) }
    }

    /// Exchanges the values that captures have for themselves where the scene has become one, or ceased to be one.
    fn suit_scene(&mut self) -> Result<(), ConfigError> {
        let is_capture = self.settings.scene.as_ref().is_some_and(|s| s.layout().is_capture());
        if is_capture != self.on_capture {
            self.on_capture = is_capture;
            for (key, (value, origin)) in std::mem::take(&mut self.other) {
                let old = self.replace(&key, value, origin)?;
                self.other.insert(key, old);
            }
        }
        Ok(())
    }

    /// Replaces one value and returns the old one, which stays if the new one has the wrong type.
    fn replace(&mut self, key: &str, value: Value, origin: Origin) -> Result<(Value, Origin), ConfigError> {
        let mut table = self.table.clone();
        let old = slot(&mut table, key).map_or(Value::Boolean(false), |slot| std::mem::replace(slot, value));
        self.settings = parse(&table).map_err(|(field, message)| ConfigError::Value {
            origin: origin.clone(),
            key: if field.is_empty() { key.to_string() } else { field },
            message,
        })?;
        self.table = table;
        let from = self.origins.insert(key.to_string(), origin.clone()).unwrap_or(origin);
        Ok((old, from))
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
    let (captures, mut leaves): (Vec<Leaf>, Vec<Leaf>) =
        leaves(&file, &text)?.into_iter().partition(|l| l.key.starts_with(CAPTURES));
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
    for leaf in captures {
        layered.apply_to_captures(&leaf.key[CAPTURES.len()..], leaf.value, leaf.origin)?;
    }
    Ok(layered)
}

/// A file without a base: it must set everything.
fn root(name: String, file: String, leaves: Vec<Leaf>) -> Result<Layered, ConfigError> {
    let known: Vec<String> = known_keys(leaves.iter().any(|l| l.key.starts_with("scene.")));
    let (mut table, mut origins) = (Table::new(), BTreeMap::new());
    for leaf in leaves {
        if !known.contains(&leaf.key) {
            return Err(unknown(leaf.origin, &leaf.key, known.iter()));
        }
        insert(&mut table, &leaf.key, leaf.value);
        origins.insert(leaf.key, leaf.origin);
    }
    if let Some(key) = known.iter().find(|k| !origins.contains_key(*k)) {
        return Err(ConfigError::Missing { file, key: key.clone() });
    }
    let settings = parse(&table).map_err(|(key, message)| {
        let origin = origins.iter().find(|(k, _)| key.starts_with(*k)).map(|(_, o)| o.clone());
        ConfigError::Value { origin: origin.unwrap_or(Origin::Line { file, line: 1 }), key, message }
    })?;
    let mut layered = Layered { name, settings, table, origins, other: BTreeMap::new(), on_capture: false };
    layered.suit_scene()?;
    Ok(layered)
}

/// The keys of the preset that sets them all, in 3D or 2D.
fn known_keys(space: bool) -> Vec<String> {
    let root = |p: &&Preset| !p.text.contains("\nbase ") && p.text.contains("\n[scene]") == space;
    let text = PRESETS.iter().find(root).map_or("", |p| p.text);
    leaves("", text).unwrap_or_default().into_iter().map(|l| l.key).collect()
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

fn slot<'a>(table: &'a mut Table, key: &str) -> Option<&'a mut Value> {
    match key.split_once('.') {
        None => table.get_mut(key),
        Some((section, rest)) => slot(table.get_mut(section)?.as_table_mut()?, rest),
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
mod tests {
    use super::*;

    #[test]
    fn every_preset_loads_and_survives_a_round_trip() {
        for p in PRESETS {
            let layered = Layered::load(p.name).unwrap_or_else(|e| panic!("{}: {e}", p.name));
            layered.validate().unwrap_or_else(|e| panic!("{}: {e}", p.name));
            let text = toml::to_string(&layered.settings).unwrap();
            assert_eq!(toml::from_str::<Settings>(&text).unwrap(), layered.settings, "{}", p.name);
            assert!(!p.summary().is_empty(), "{} needs a first comment", p.name);
        }
    }

    #[test]
    fn errors_name_origin_field_and_nearest_key() {
        let mut l = Layered::load("planar-l2g").unwrap();
        let error = |r: Result<(), ConfigError>| r.unwrap_err().to_string();
        assert_eq!(
            error(l.set("optim.stesp=3")),
            "--set optim.stesp=3: unknown key `optim.stesp`; did you mean `optim.steps`?"
        );
        assert!(error(l.set("points_per_patch=3")).contains("did you mean `data.points_per_patch`?"));
        assert!(
            error(l.set("warp.dof=4"))
                .contains("expected 1 (rotation), 2 (translation), 3 (rigid), 6 (pose) or 8 (homography)")
        );
        assert!(error(l.set("optim.lr=fast")).contains("`optim.lr`: invalid type: string \"fast\", expected a number"));
        assert!(error(l.set("steps")).contains("section.key=value"));
        assert!(Layered::load("planar-l2g-smal").unwrap_err().to_string().contains("did you mean `planar-l2g-small`?"));
        l.set("data.points_per_patch=4096").unwrap();
        l.set("data.image=2024").unwrap();
        l.set("optim.lr=1").unwrap();
        assert_eq!((l.settings.data.image.as_str(), l.settings.optim.lr), ("2024", 1.0));
        assert_eq!(l.settings.data.points_per_patch, super::super::Count::Of(4096));
    }

    #[test]
    fn a_share_of_the_light_is_below_all_of_it() {
        let mut l = Layered::load("nerf-small").unwrap();
        let mut check = |value: &str| {
            l.set(&format!("radiance.stop_below={value}")).unwrap();
            l.validate().map_err(|e| e.to_string())
        };
        assert_eq!((check("0.0"), check("0.5")), (Ok(()), Ok(())));
        for bad in ["1.0", "-0.1", "nan"] {
            assert!(check(bad).unwrap_err().contains("`radiance.stop_below`: expected a share of the light"), "{bad}");
        }
    }

    #[test]
    fn a_file_reports_its_lines() {
        let dir = tempfile::tempdir().unwrap();
        let write = |text: &str| {
            let path = dir.path().join("mine.toml");
            std::fs::write(&path, text).unwrap();
            Layered::load(path.to_str().unwrap())
        };
        let error = |text: &str| write(text).unwrap_err().to_string();
        assert!(
            error("base = \"planar-l2g\"\n[optim]\nsteps = \"many\"\n")
                .contains("mine.toml:3: `optim.steps`: invalid type")
        );
        assert!(
            error("base = \"planar-l2g\"\n\n[optim]\nstep = 3\n").contains("mine.toml:4: unknown key `optim.step`")
        );
        assert!(error("base = \"planar-l2g\"\n[optim\n").contains("mine.toml:2: not valid TOML"));
        assert!(error("[data]\npatches = 5\n").contains("missing `data.image`"));
        let mine = write("base = \"planar-barf\"\n[optim]\nsteps = 7\n").unwrap();
        assert_eq!((mine.settings.optim.steps, mine.name.as_str()), (7, "mine"));
    }

    #[test]
    fn captures_have_values_of_their_own_until_others_are_set() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
        std::fs::create_dir(path("photos")).unwrap();
        for i in 0..3 {
            image::RgbImage::new(4, 4).save(dir.path().join("photos").join(format!("{i}.png"))).unwrap();
        }
        let file = path("mine.toml");
        let text = "base = \"l2g-small\"\n[captures]\noptim.steps = 7\noptim.lr = 0.25\n[optim]\nsteps = 9\nlr = 0.5\n";
        std::fs::write(&file, text).unwrap();
        let mut l = Layered::load(&file).unwrap();
        let numbers = |l: &Layered| (l.settings.optim.steps, l.settings.optim.lr);
        let scene = |l: &mut Layered, path: &str| l.set(&format!("scene.path={path}")).unwrap();
        assert_eq!((numbers(&l), l.is_on_capture()), ((9, 0.5), false));
        scene(&mut l, &path("photos"));
        assert_eq!((numbers(&l), l.is_on_capture()), ((7, 0.25), true));
        assert_eq!(l.origin("optim.lr"), Origin::Line { file: file.clone(), line: 4 });
        scene(&mut l, "builtin");
        assert_eq!(numbers(&l), (9, 0.5));
        assert_eq!(l.origin("optim.lr"), Origin::Line { file: file.clone(), line: 7 });
        l.set("optim.lr=0.125").unwrap();
        scene(&mut l, &path("photos"));
        assert_eq!(numbers(&l), (7, 0.125));
        l.set("optim.steps=8").unwrap();
        scene(&mut l, "builtin");
        assert_eq!(numbers(&l), (8, 0.125));
        // A preset without the section has nothing for captures.
        let mut plain = Layered::load("l2g-llff").unwrap();
        scene(&mut plain, &path("photos"));
        assert!(!plain.is_on_capture());
        // A file above the section wins over it too, whether it names the scene or not.
        let above = path("above.toml");
        let text = format!("base = {file:?}\n[optim]\nlr = 0.75\n[scene]\npath = {:?}\n", path("photos"));
        std::fs::write(&above, text).unwrap();
        assert_eq!(numbers(&Layered::load(&above).unwrap()), (7, 0.75));
        for (line, expected) in [
            ("optim.stesp = 1", "did you mean `optim.steps`?"),
            ("optim.steps = \"many\"", "mine.toml:3: `optim.steps`: invalid type"),
        ] {
            std::fs::write(&file, format!("base = \"l2g-small\"\n[captures]\n{line}\n")).unwrap();
            let error = Layered::load(&file).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
