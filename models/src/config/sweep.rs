//! A sweep: every preset on every scene with every seed, from one file.
//!
//! ```toml
//! presets = ["l2g-small", "barf-small"]   # names or files
//! scenes = ["builtin", "data/lego"]       # folders, or photos in the plane; left out: those of the presets
//! seeds = [0, 1, 2]                       # left out: those of the presets
//!
//! [set.optim]                             # for all
//! steps = 1000
//! [preset.barf-small.optim]               # for one, by the name of the preset or of its file without the ending
//! lr = 1e-3
//!
//! [clouds]                                # surfaces to measure distances from, by scene
//! scan24 = "stl024_total.ply"
//! [mesh]                                  # how surfaces are found, as by the options of `raygrad eval`; all may be left out
//! resolution = 128
//! threshold = 25.0
//! bounds = [-1.2, 1.2]
//! ```

use super::error::{ConfigError, Origin};
use super::layers::{Layered, When, nearest, unknown};
use super::leaves::{Leaf, leaves};
use crate::evaluation::MeshOptions;
use crate::scene::Layout;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::Value;

/// All runs of a sweep, by scene, then preset, then seed.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Stem of the file.
    pub name: String,
    pub cells: Vec<SweepCell>,
    /// Of some scenes, by name, the mesh or cloud that found surfaces are compared with.
    pub clouds: BTreeMap<String, PathBuf>,
    /// How these surfaces are found.
    pub mesh: MeshOptions,
}

/// One run.
#[derive(Clone, Debug)]
pub struct SweepCell {
    /// SCENE-PRESET-sSEED.
    pub name: String,
    pub preset: String,
    pub layered: Layered,
}

const LISTS: [&str; 3] = ["presets", "scenes", "seeds"];
const CLOUDS: &str = "clouds.";
const MESH: &str = "mesh.";
const OPTIONS: [&str; 3] = ["mesh.resolution", "mesh.threshold", "mesh.bounds"];

impl Sweep {
    /// Reads a file and checks everything that can be checked before a run: keys, values, presets, and that scenes and photos
    /// are there.
    ///
    /// # Errors
    /// What is wrong, with file, line and field.
    pub fn load(path: &Path) -> Result<Sweep, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.into(), source })?;
        let file = path.to_string_lossy();
        let (lists, rest): (Vec<Leaf>, Vec<Leaf>) =
            leaves(&file, &text)?.into_iter().partition(|l| LISTS.contains(&l.key.as_str()));
        let (clouds, rest): (Vec<Leaf>, Vec<Leaf>) = rest.into_iter().partition(|l| l.key.starts_with(CLOUDS));
        let (mesh, mut rest): (Vec<Leaf>, Vec<Leaf>) = rest.into_iter().partition(|l| l.key.starts_with(MESH));
        let mesh = mesh.iter().try_fold(MeshOptions::default(), with_option)?;
        let list = |key: &str| lists.iter().find(|l| l.key == key);
        let Some(presets) = list("presets") else {
            return Err(ConfigError::MissingOfSweep { file: file.into() });
        };
        let bases = bases(presets)?;
        let names: Vec<&str> = bases.iter().map(|b| b.name.as_str()).collect();
        // What is set for one preset wins over what is set for all, and of either what holds for some scenes over what holds for all.
        let when = |l: &Leaf| {
            let of_preset = |name: &&str| l.key.strip_prefix("preset.")?.strip_prefix(name)?.strip_prefix('.');
            let key = l.key.strip_prefix("set.").or_else(|| names.iter().find_map(of_preset)).unwrap_or_default();
            When::split(key).0
        };
        rest.sort_by_key(|l| (!l.key.starts_with("set."), when(l) != When::Always));
        let of_preset = |layered: Layered| rest.iter().try_fold(layered, |l, leaf| set(l, leaf, &names));
        let bases = bases.iter().cloned().map(of_preset).collect::<Result<Vec<Layered>, _>>()?;
        let scenes = values(list("scenes"), "the names of folders or photos", Value::is_str)?;
        let seeds = values(list("seeds"), "whole numbers", Value::is_integer)?;
        let place = |n: usize| [n / (bases.len() * seeds.len()), n / seeds.len() % bases.len(), n % seeds.len()];
        let mut cells: Vec<SweepCell> = vec![];
        for scene in &scenes {
            for base in &bases {
                for seed in &seeds {
                    let cell = cell(base, scene.clone(), seed.clone())?;
                    if let Some(first) = cells.iter().position(|c| c.name == cell.name) {
                        let (first, second) = (place(first), place(cells.len()));
                        let twice = (0..3).find(|i| first[*i] != second[*i]).map(|i| ["scenes", "presets", "seeds"][i]);
                        let message = format!("two runs would be called `{}`", cell.name);
                        return Err(refuse(twice.and_then(list).unwrap_or(presets), message));
                    }
                    cells.push(cell);
                }
            }
        }
        let scenes: Vec<String> = cells.iter().map(|c| c.layered.settings.scene_name()).collect();
        let known = |leaf: &Leaf, scene: &String| {
            if scenes.contains(scene) {
                return Ok(());
            }
            let meant = nearest(scene, scenes.iter().map(String::as_str));
            let meant = meant.map_or(String::new(), |n| format!("; did you mean `{n}`?"));
            Err(refuse(leaf, format!("no scene of this sweep is called `{scene}`{meant}")))
        };
        for leaf in &rest {
            if let When::On(scene) = when(leaf) {
                known(leaf, &scene)?;
            }
        }
        let name = path.file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
        let mut sweep = Sweep { name, cells, clouds: BTreeMap::new(), mesh };
        for leaf in &clouds {
            let scene = leaf.key[CLOUDS.len()..].to_string();
            if !sweep.is_in_space() {
                return Err(refuse(leaf, "this sweep is in the plane, where there are no surfaces".into()));
            }
            known(leaf, &scene)?;
            let Some(file) = leaf.value.as_str() else {
                return Err(refuse(leaf, format!("expected the name of a PLY file, found {}", leaf.value)));
            };
            sweep.clouds.insert(scene, file.into());
        }
        Ok(sweep)
    }

    /// Whether the runs are in space, and not in the plane.
    pub fn is_in_space(&self) -> bool {
        self.cells.iter().any(|c| c.layered.settings.scene.is_some())
    }
}

fn refuse(leaf: &Leaf, message: String) -> ConfigError {
    ConfigError::Value { origin: leaf.origin.clone(), key: leaf.key.clone(), message }
}

/// Options of meshes with one more of the file's.
fn with_option(options: MeshOptions, leaf: &Leaf) -> Result<MeshOptions, ConfigError> {
    let number = |v: &Value| v.as_float().or_else(|| v.as_integer().map(|i| i as f64));
    let numbers = || leaf.value.as_array()?.iter().map(number).collect::<Option<Vec<f64>>>();
    let (found, expected) = match &leaf.key[MESH.len()..] {
        "resolution" => {
            let cubes = leaf.value.as_integer().and_then(|i| usize::try_from(i).ok());
            (cubes.map(|cubes| options.with_cubes(cubes)), "a number of cubes along each side")
        }
        "threshold" => {
            (number(&leaf.value).map(|threshold| MeshOptions { threshold, ..options }), "the density of the surface")
        }
        "bounds" => (numbers().and_then(|bounds| options.within(&bounds)), "a list of 2 or 6 numbers"),
        _ => return Err(unknown(leaf.origin.clone(), &leaf.key, OPTIONS.map(String::from).iter())),
    };
    found.ok_or_else(|| refuse(leaf, format!("expected {expected}, found {}", leaf.value)))
}

/// The presets as they are; all of the plane, or all of space.
fn bases(presets: &Leaf) -> Result<Vec<Layered>, ConfigError> {
    let mut bases: Vec<Layered> = vec![];
    for name in values(Some(presets), "names of presets or files", Value::is_str)?.into_iter().flatten() {
        let name = name.0.as_str().unwrap_or_default().to_string();
        let base = Layered::load(&name).map_err(|error| match error {
            ConfigError::UnknownPreset { .. } | ConfigError::Read { .. } => refuse(presets, error.to_string()),
            other => other,
        })?;
        let first = bases.first().unwrap_or(&base);
        if first.settings.scene.is_some() != base.settings.scene.is_some() {
            let message = format!("`{}` and `{name}` do not compare: one is in space, one in the plane", first.name);
            return Err(refuse(presets, message));
        }
        bases.push(base);
    }
    Ok(bases)
}

/// A value of a list, and where the list stands.
type Listed = Option<(Value, Origin)>;

/// The values of a list; where it is left out, nothing once.
fn values(list: Option<&Leaf>, expected: &str, fits: fn(&Value) -> bool) -> Result<Vec<Listed>, ConfigError> {
    let Some(leaf) = list else { return Ok(vec![None]) };
    match leaf.value.as_array().filter(|a| !a.is_empty() && a.iter().all(fits)) {
        Some(values) => Ok(values.iter().map(|v| Some((v.clone(), leaf.origin.clone()))).collect()),
        None => Err(refuse(leaf, format!("expected a list of {expected}, found {}", leaf.value))),
    }
}

/// One value of `[set]` or `[preset.NAME]`, if it is for this preset.
fn set(mut layered: Layered, leaf: &Leaf, presets: &[&str]) -> Result<Layered, ConfigError> {
    let (origin, value) = (leaf.origin.clone(), leaf.value.clone());
    let apply = |layered: &mut Layered, key: &str| layered.apply(key, value, origin.clone());
    if let Some(key) = leaf.key.strip_prefix("set.") {
        apply(&mut layered, key)?;
        return Ok(layered);
    }
    let for_preset = leaf.key.strip_prefix("preset.");
    let named = |preset: &str| for_preset?.strip_prefix(preset)?.strip_prefix('.');
    if let Some(key) = named(&layered.name) {
        apply(&mut layered, key)?;
        return Ok(layered);
    }
    if presets.iter().any(|p| named(p).is_some()) {
        return Ok(layered);
    }
    Err(match for_preset {
        Some(rest) => {
            let written = rest.split('.').next().unwrap_or_default();
            let nearest = nearest(written, presets.iter().copied()).map(|n| format!("preset.{n}"));
            ConfigError::UnknownKey { origin, key: format!("preset.{written}"), nearest }
        }
        None => unknown(
            origin,
            &leaf.key,
            LISTS.map(String::from).iter().chain(&["set", "preset", "clouds", "mesh"].map(String::from)),
        ),
    })
}

fn cell(base: &Layered, scene: Listed, seed: Listed) -> Result<SweepCell, ConfigError> {
    let mut layered = base.clone();
    let key = if layered.settings.scene.is_some() { "scene.path" } else { "data.image" };
    for (key, listed) in [(key, scene), ("run.seed", seed)] {
        if let Some((value, origin)) = listed {
            layered.apply(key, value, origin)?;
        }
    }
    layered.validate()?;
    is_there(&layered)?;
    let settings = &layered.settings;
    let scene = settings.scene_name().replace(['/', '\\'], "_");
    let name = format!("{scene}-{}-s{}", base.name, settings.run.seed);
    Ok(SweepCell { name, preset: base.name.clone(), layered })
}

/// Refuses a scene or a photo that is not there.
fn is_there(layered: &Layered) -> Result<(), ConfigError> {
    match &layered.settings.scene {
        Some(scene) if scene.path != "builtin" && scene.layout == "auto" => {
            Layout::of(Path::new(&scene.path)).map_err(|e| layered.refuse("scene.path", e.to_string()))?;
        }
        None if layered.settings.data.image != "builtin" => {
            let image = &layered.settings.data.image;
            std::fs::metadata(image).map_err(|e| layered.refuse("data.image", format!("cannot read {image}: {e}")))?;
        }
        _ => {}
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(text: &str) -> Result<Sweep, ConfigError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("grid.toml");
        std::fs::write(&path, text).unwrap();
        Sweep::load(&path)
    }

    #[test]
    fn cells_are_the_product_with_what_is_set() {
        let text = "presets = [\"barf-small\", \"l2g-small\"]\nscenes = [\"builtin\"]\nseeds = [3, 4]\n\
                    [set.optim]\nsteps = 7\n[preset.l2g-small]\noptim.lr = 0.5\noptim.steps = 8\n";
        let sweep = load(text).unwrap();
        assert!(sweep.is_in_space() && sweep.name == "grid");
        let found = sweep.cells.iter().map(|c| {
            let s = &c.layered.settings;
            (c.name.as_str(), s.optim.steps, s.optim.lr == 0.5, s.run.seed)
        });
        let expected = [
            ("builtin-barf-small-s3", 7, false, 3),
            ("builtin-barf-small-s4", 7, false, 4),
            ("builtin-l2g-small-s3", 8, true, 3),
            ("builtin-l2g-small-s4", 8, true, 4),
        ];
        assert_eq!(found.collect::<Vec<_>>(), expected);
        let alone = load("presets = [\"planar-l2g-small\"]\n").unwrap();
        assert_eq!(alone.cells.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["builtin-planar-l2g-small-s0"]);
        assert!(!alone.is_in_space());
    }

    /// What holds for some scenes wins over what holds for all, in whatever order they stand, and a preset over all.
    #[test]
    fn settings_for_some_scenes_win() {
        let steps = |rest: &str| {
            let text = format!("presets = [\"barf-small\", \"l2g-small\"]\nscenes = [\"builtin\"]\n{rest}");
            load(&text).unwrap().cells.iter().map(|c| c.layered.settings.optim.steps).collect::<Vec<_>>()
        };
        let (all, some) = ("[set.optim]\nsteps = 30\n", "[set.on.builtin.optim]\nsteps = 20\n");
        assert_eq!(steps(&format!("{all}{some}")), [20, 20]);
        assert_eq!(steps(&format!("{some}{all}")), [20, 20]);
        let one = "[preset.l2g-small.optim]\nsteps = 10\n";
        assert_eq!(steps(&format!("{one}{some}{all}")), [20, 10]);
        assert_eq!(steps(&format!("[preset.l2g-small.on.builtin.optim]\nsteps = 9\n{one}{all}")), [30, 9]);
    }

    #[test]
    fn bad_files_are_refused_with_line_and_field() {
        for (text, expected) in [
            ("seeds = [1]\n", &["missing `presets`"][..]),
            (
                "presets = [\"barf-small\"]\n[set.on.builtn.optim]\nlr = 1e-3\n",
                &["grid.toml:3", "no scene of this sweep is called `builtn`; did you mean `builtin`?"],
            ),
            ("presets = []\n", &["grid.toml:1: `presets`", "expected a list of names of presets or files"]),
            ("presets = [\"barf-smal\"]\n", &["grid.toml:1: `presets`", "did you mean `barf-small`?"]),
            ("presets = [\"mine.toml\"]\n", &["grid.toml:1: `presets`", "mine.toml"]),
            ("presets = [\"barf-small\", \"planar-l2g\"]\n", &["grid.toml:1: `presets`", "do not compare"]),
            (
                "seeds = [1]\npresets = [\"barf-small\", \"barf-small\"]\n",
                &["grid.toml:2: `presets`: two runs would be called `builtin-barf-small-s1`"],
            ),
            (
                "presets = [\"barf-small\", \"l2g-small\"]\nseeds = [1, 0, 1]\n",
                &["grid.toml:2: `seeds`: two runs would be called `builtin-barf-small-s1`"],
            ),
            (
                "seeds = [1]\npresets = [\"barf-small\"]\nscenes = [\"builtin\", \"builtin\"]\n",
                &["grid.toml:3: `scenes`: two runs would be called `builtin-barf-small-s1`"],
            ),
            ("presets = [\"barf-small\"]\nseeds = [0, \"x\"]\n", &["grid.toml:2: `seeds`", "whole numbers"]),
            ("presets = [\"barf-small\"]\nseeds = [-1]\n", &["grid.toml:2: `run.seed`", "0 to 4294967295"]),
            ("presets = [\"barf-small\"]\nseed = [0]\n", &["grid.toml:2: unknown key `seed`", "did you mean `seeds`?"]),
            ("presets = [\"barf-small\"]\nscenes = [\"/no\"]\n", &["grid.toml:2: `scene.path`", "/no"]),
            ("presets = [\"planar-l2g\"]\nscenes = [\"no.png\"]\n", &["grid.toml:2: `data.image`", "no.png"]),
            (
                "presets = [\"barf-small\"]\n[set.optim]\nstesp = 3\n",
                &["grid.toml:3: unknown key `optim.stesp`", "did you mean `optim.steps`?"],
            ),
            ("presets = [\"barf-small\"]\n[set.optim]\nsteps = 0\n", &["grid.toml:3: `optim.steps`", "1 or more"]),
            (
                "presets = [\"barf-small\"]\n[preset.barf-smal.optim]\nsteps = 3\n",
                &["grid.toml:3: unknown key `preset.barf-smal`", "did you mean `preset.barf-small`?"],
            ),
            (
                "presets = [\"barf-small\"]\n[clouds]\nbuiltn = \"a.ply\"\n",
                &["grid.toml:3: `clouds.builtn`", "did you mean `builtin`?"],
            ),
            (
                "presets = [\"barf-small\"]\n[clouds]\nbuiltin = 3\n",
                &["grid.toml:3", "the name of a PLY file, found 3"],
            ),
            ("presets = [\"barf-small\"]\n[mesh]\nbounds = [1]\n", &["grid.toml:3: `mesh.bounds`", "2 or 6 numbers"]),
            ("presets = [\"barf-small\"]\n[mesh]\nresolution = -1\n", &["grid.toml:3", "a number of cubes"]),
            ("presets = [\"barf-small\"]\n[mesh]\nthresold = 1\n", &["did you mean `mesh.threshold`?"]),
            ("presets = [\"planar-l2g\"]\n[clouds]\nbuiltin = \"a.ply\"\n", &["grid.toml:3", "in the plane"]),
            ("presets = [\n", &["not valid TOML"]),
        ] {
            let message = load(text).unwrap_err().to_string();
            assert!(expected.iter().all(|part| message.contains(part)), "{text}: {message}");
        }
    }
}
