//! Cameras of real scenes as the official loaders parse them, and every real scene loading.

use raygrad::scene::{DepthRange, Intrinsics, Layout, LoadOptions, Scene, View, load};
use raygrad_tests::vectors::{Case, cases};
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A folder of the data; `None`, with a message, where `RAYGRAD_DATA` is not set.
fn folder(name: &str) -> Option<PathBuf> {
    match std::env::var("RAYGRAD_DATA") {
        Ok(data) => Some(PathBuf::from(data).join(name)),
        Err(_) => {
            eprintln!("skipped: RAYGRAD_DATA is not set, so there is no scene `{name}`");
            None
        }
    }
}

/// As few views as possible, small.
fn few() -> LoadOptions {
    LoadOptions { train_limit: Some(5), val_limit: Some(0), test_limit: Some(0), ..LoadOptions::default() }
}

#[track_caller]
fn scene(name: &str, options: &LoadOptions) -> Option<Scene> {
    folder(name).map(|folder| load(&folder, options, &|_, _| ()).unwrap_or_else(|e| panic!("{e}")))
}

fn matrix(c: &Intrinsics) -> [f64; 9] {
    [c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]
}

fn check(case: &Case, views: &[View]) {
    let pose = |v: &View| v.pose.expect("a pose").to_rows();
    case.check("pose", &views.iter().flat_map(pose).collect::<Vec<_>>());
    case.check("intr", &views.iter().flat_map(|v| matrix(&v.intrinsics)).collect::<Vec<_>>());
}

#[test]
fn blender_cameras() {
    for case in cases("blender_lego_poses") {
        let Some(scene) = scene("blender/lego", &LoadOptions { test_limit: Some(5), ..few() }) else { return };
        check(&case, if case.text("split") == "test" { &scene.test } else { &scene.train });
    }
}

#[test]
fn llff_cameras() {
    for case in cases("llff_fern_poses") {
        let options = LoadOptions { size: Some([480, 640]), published_rotations: true, ..few() };
        let Some(scene) = scene("llff/fern", &options) else { return };
        check(&case, &scene.train);
        // The exact rotations are near the published ones.
        let exact = load(&scene.root, &LoadOptions { published_rotations: false, ..options }, &|_, _| ()).unwrap();
        for (a, b) in exact.train.iter().zip(&scene.train) {
            let (a, b) = (a.pose.unwrap(), b.pose.unwrap());
            assert!(a.rigidity_error() < 1e-9 && b.rigidity_error() > 1e-9);
            assert!((a.rotation - b.rotation).norm() < 0.02);
        }
    }
}

/// The official loader is run with a scale of 300 in place of the scene's own, so centres are rescaled here.
#[test]
fn dtu_cameras() {
    for case in cases("dtu_scan_cameras") {
        let Some(scene) = scene("dtu/dtu_scan24", &LoadOptions { train_limit: None, ..few() }) else { return };
        let first = load(&scene.root, &LoadOptions { test_limit: None, ..few() }, &|_, _| ()).unwrap().test;
        // Views 0, 8, ... are the test views, so the first five are those and the first four of training.
        let views: Vec<&View> = first.iter().take(1).chain(&scene.train).take(5).collect();
        let rescale = 1.0 / (300.0 * scene.frame.scale);
        let rows = |v: &&View| {
            let mut pose = v.pose.expect("a pose");
            pose.translation *= rescale;
            pose.to_rows()
        };
        case.check("pose_w2c", &views.iter().flat_map(rows).collect::<Vec<_>>());
        let found: Vec<f64> = views.iter().flat_map(|v| matrix(&v.intrinsics)).collect();
        // The official decomposition is in single precision: about seven digits of 700 pixels.
        case.check_within("intr", &found, 1e-3);
        case.check("num_views", &[(scene.train.len() + first.len()) as f64]);
    }
}

/// What every loaded scene must satisfy.
#[track_caller]
fn sound(scene: &Scene, [height, width]: [usize; 2], counts: [usize; 3]) {
    assert_eq!([scene.train.len(), scene.val.len(), scene.test.len()], counts, "{}", scene.root.display());
    for view in scene.train.iter().chain(&scene.val).chain(&scene.test) {
        assert_eq!((view.intrinsics.height, view.intrinsics.width), (height, width));
        assert_eq!(view.pixels.len(), height * width);
        assert!(view.rgb().iter().all(|c| (0.0..=1.0).contains(c)), "{}", view.name);
        assert!(view.mask.as_ref().is_none_or(|m| m.len() == height * width));
        let pose = view.pose.expect("a pose");
        assert!(pose.rigidity_error() < 1e-3, "{}", view.name);
    }
}

fn small(size: [usize; 2]) -> LoadOptions {
    LoadOptions { size: Some(size), ..LoadOptions::default() }
}

#[test]
fn blender_scenes_load() {
    for (name, counts) in [("lego", [20, 4, 3]), ("Scar", [20, 4, 3])] {
        let options =
            LoadOptions { train_limit: Some(20), val_limit: Some(4), test_limit: Some(3), ..small([100, 100]) };
        let Some(scene) = scene(&format!("blender/{name}"), &options) else { return };
        sound(&scene, [100, 100], counts);
        assert_eq!(scene.depth, DepthRange::Metric { near: 2.0, far: 6.0 });
        // Corners of the images are background.
        assert!(scene.train.iter().all(|v| v.rgb()[..3] == [1.0; 3] && v.foreground().unwrap()[0] == 0.0));
    }
}

#[test]
fn fern_loads() {
    let Some(scene) = scene("llff/fern", &small([90, 120])) else { return };
    sound(&scene, [90, 120], [18, 2, 2]);
    assert_eq!((scene.layout, scene.depth), (Layout::Llff, DepthRange::Inverse { near: 1.0 }));
    assert_eq!(scene.test[1].name, "IMG_4045.jpg");
    let center = scene.train.iter().map(|v| v.pose.unwrap().center()).sum::<nalgebra::Vector3<f64>>() / 18.0;
    assert!(center.norm() < 0.1, "{center}");
}

#[test]
fn scan24_loads() {
    let Some(scene) = scene("dtu/dtu_scan24", &small([75, 100])) else { return };
    sound(&scene, [75, 100], [42, 7, 7]);
    let DepthRange::Metric { near, far } = scene.depth else { panic!("{:?}", scene.depth) };
    assert!((near - 1.558).abs() < 1e-3 && (far / near - 13.0 / 3.0).abs() < 1e-9);
    let mask = scene.train[0].foreground().unwrap();
    let share = mask.iter().sum::<f32>() / mask.len() as f32;
    assert!((0.05..0.9).contains(&share), "{share}");
}

#[test]
fn fox_loads() {
    let heard = AtomicUsize::new(0);
    let Some(folder) = folder("fox") else { return };
    let progress = |_: usize, all: usize| {
        assert_eq!(all, 67);
        heard.fetch_add(1, Ordering::Relaxed);
    };
    let scene = load(&folder, &small([160, 90]), &progress).unwrap();
    assert_eq!(heard.into_inner(), 67);
    sound(&scene, [160, 90], [58, 9, 9]);
    assert!(scene.train[0].removed_distortion.is_some() && scene.train[0].intrinsics.distortion.is_none());
    let center = |v: &View| v.pose.unwrap().center().norm();
    let mean = scene.train.iter().map(center).sum::<f64>() / 58.0;
    assert!((mean - 4.0).abs() < 0.2, "{mean}");
}

/// The same images, reconstructed once, in two layouts: the same cameras up to a similarity, so distances between centres
/// are proportional.
#[test]
fn bird_loads_from_colmap_and_from_llff() {
    let options = LoadOptions { layout: Some(Layout::Colmap), ..small([68, 120]) };
    let Some(colmap) = scene("colmap/bird", &options) else { return };
    let size = colmap.train[0].intrinsics;
    sound(&colmap, [size.height, size.width], [161, 23, 23]);
    assert!(matches!(colmap.depth, DepthRange::Inverse { near } if near > 0.1 && near < 4.0), "{:?}", colmap.depth);
    let llff = scene("colmap/bird", &LoadOptions { layout: None, ..options }).unwrap();
    assert_eq!(llff.layout, Layout::Llff);
    let all = |s: &Scene| {
        let mut views: Vec<View> = s.train.iter().chain(&s.test).cloned().collect();
        views.sort_by(|a, b| a.name.cmp(&b.name));
        views
    };
    let distance =
        |views: &[View], i: usize| (views[i].pose.unwrap().center() - views[0].pose.unwrap().center()).norm();
    let (a, b) = (all(&colmap), all(&llff));
    let ratio = distance(&a, 100) / distance(&b, 100);
    for i in 1..184 {
        let found = distance(&a, i) / distance(&b, i);
        assert!((found / ratio - 1.0).abs() < 1e-3, "view {i}: {found} is not {ratio}");
        // Poses of both lead back to COLMAP's own frame, in LLFF's file as in the model.
        let (x, y) = (colmap.frame.unload(&a[i].pose.unwrap()), llff.frame.unload(&b[i].pose.unwrap()));
        assert!((x.center() - y.center()).norm() < 1e-3, "view {i}");
        assert!((x.rotation - y.rotation).norm() < 1e-3, "view {i}");
    }
}
