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
    assert!(error("base = \"planar-l2g\"\n\n[optim]\nstep = 3\n").contains("mine.toml:4: unknown key `optim.step`"));
    assert!(error("base = \"planar-l2g\"\n[optim\n").contains("mine.toml:2: not valid TOML"));
    assert!(error("[data]\npatches = 5\n").contains("missing `data.image`"));
    let mine = write("base = \"planar-barf\"\n[optim]\nsteps = 7\n").unwrap();
    assert_eq!((mine.settings.optim.steps, mine.name.as_str()), (7, "mine"));
}

#[test]
fn scenes_have_values_of_their_own() {
    let numbers = |preset: &str, scene: &str, set: &[&str]| {
        let mut l = Layered::load(preset).unwrap();
        set.iter().for_each(|s| l.set(s).unwrap());
        l.set_text("scene.path", scene, Origin::Option("--data".into()));
        l.validate().unwrap();
        (l.settings.noise.rotation, l.settings.noise.translation, l.settings.loss.alignment)
    };
    // The noise of the L2G-NeRF supplement, Table 2; its weights, Table 3; those of INN's, Tables 1 and 2.
    assert_eq!(numbers("l2g-blender", "data/chair", &[]), (0.01, 0.4, 1e2));
    assert_eq!(numbers("barf-blender", "data/ship", &[]), (0.09, 0.7, 1e2));
    assert_eq!(numbers("l2g-small", "data/lego", &[]), (0.07, 0.5, 1e2));
    assert_eq!(numbers("l2g-blender", "data/mine", &[]), (0.03, 0.3, 1e2));
    assert_eq!(numbers("l2g-blender", "data/chair", &["noise.rotation=0.5"]), (0.5, 0.4, 1e2));
    assert_eq!(numbers("barf-blender-original", "data/chair", &[]).0, 0.15);
    for (preset, scene, alignment) in [
        ("l2g-llff", "fern", 1e2),
        ("l2g-llff", "flower", 1e3),
        ("l2g-llff", "trex", 1e5),
        ("l2g-noglobal-llff", "trex", 0.0),
        ("inn-llff", "fern", 1e4),
        ("inn-llff", "fortress", 1e5),
        ("inn-llff", "trex", 1e4),
        ("multi-inn-llff", "room", 1e3),
        ("inn-dtu", "dtu_scan24", 1e4),
        ("inn-dtu", "dtu_scan114", 1e2),
        ("inn-dtu", "scan118", 1e3),
        ("l2g-dtu", "scan118", 1e2),
    ] {
        assert_eq!(numbers(preset, scene, &[]).2, alignment, "{preset} on {scene}");
    }
    let mut l = Layered::load("l2g-blender").unwrap();
    let error = l.set("on.lego.scene.path=other").unwrap_err().to_string();
    assert!(error.contains("cannot say which one it is"), "{error}");
    assert!(l.set("on.lego.optim.stesp=3").unwrap_err().to_string().contains("did you mean `optim.steps`?"));
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
    let own = |l: &Layered| l.of_scene().iter().filter(|(key, _)| key.starts_with("optim.")).count();
    let scene = |l: &mut Layered, path: &str| l.set(&format!("scene.path={path}")).unwrap();
    assert_eq!((numbers(&l), own(&l)), ((9, 0.5), 0));
    scene(&mut l, &path("photos"));
    assert_eq!((numbers(&l), own(&l)), ((7, 0.25), 7));
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
    assert_eq!(own(&plain), 0);
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
