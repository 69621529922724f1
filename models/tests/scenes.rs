//! Bad scenes: one clear message each, that names the file and the field.

use image::{Rgb, RgbImage};
use raygrad::scene::make_scene::{MakeOptions, make_scene};
use raygrad::scene::{DepthRange, Layout, LoadOptions, load};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A made scene in a folder of its own.
struct Made {
    _dir: TempDir,
    root: PathBuf,
}

impl Made {
    fn blender() -> Made {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("scene");
        make_scene(&root, &MakeOptions { views: 12, size: 12, seed: 1 }, &|_, _| ()).unwrap();
        Made { _dir: dir, root }
    }

    /// The same as one `transforms.json` with all training images.
    fn transforms() -> Made {
        let made = Made::blender();
        let mut json = read(&made.root.join("transforms_train.json"));
        for frame in json["frames"].as_array_mut().unwrap() {
            frame.as_object_mut().unwrap().remove("depth_file_path");
        }
        write(&made.root.join("transforms.json"), &json);
        for split in ["train", "val", "test"] {
            std::fs::remove_file(made.root.join(format!("transforms_{split}.json"))).unwrap();
        }
        made
    }

    fn change(&self, file: &str, change: impl FnOnce(&mut Value)) -> &Made {
        let path = self.root.join(file);
        let mut json = read(&path);
        change(&mut json);
        write(&path, &json);
        self
    }

    #[track_caller]
    fn refused(&self, options: &LoadOptions, parts: &[&str]) {
        let error = load(&self.root, options, &|_, _| ()).map(|s| s.layout).unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "expected `{part}` in: {error}");
        }
    }
}

fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn write(path: &Path, json: &Value) {
    std::fs::write(path, json.to_string()).unwrap();
}

fn all() -> LoadOptions {
    LoadOptions::default()
}

#[test]
fn missing_images_and_fields() {
    let made = Made::blender();
    std::fs::remove_file(made.root.join("train/r_3.png")).unwrap();
    made.refused(&all(), &["transforms_train.json", "frames[3].file_path", "r_3.png", "not there"]);
    let made = Made::blender();
    made.change("transforms_val.json", |j| _ = j.as_object_mut().unwrap().remove("camera_angle_x"));
    made.refused(&all(), &["transforms_val.json", "`fl_x`", "camera_angle_x"]);
    let made = Made::blender();
    made.change("transforms_test.json", |j| j["frames"][1]["transform_matrix"] = json!([[1, 0, 0, 0]]));
    made.refused(&all(), &["transforms_test.json", "frames[1].transform_matrix", "3 or 4 rows"]);
    let made = Made::blender();
    std::fs::write(made.root.join("val/r_0.png"), b"\x89PNG\r\n\x1a\nnothing").unwrap();
    made.refused(&all(), &["r_0.png", "not a readable PNG or JPEG"]);
    let made = Made::transforms();
    made.change("transforms.json", |j| _ = j.as_object_mut().unwrap().remove("camera_angle_x"));
    made.refused(&all(), &["transforms.json", "`fl_x`", "camera_angle_x"]);
}

#[test]
fn poses_that_are_none() {
    let made = Made::blender();
    let path = made.root.join("transforms_train.json");
    let text = std::fs::read_to_string(&path).unwrap();
    made.change("transforms_train.json", |j| j["frames"][2]["transform_matrix"][0][0] = json!(3.0));
    made.refused(&all(), &["transforms_train.json", "frames[2].transform_matrix", "expected a rotation"]);
    // As Python writes it.
    let at = text.find("\"transform_matrix\"").unwrap();
    let digits = at + text[at..].find(|c: char| c.is_ascii_digit()).unwrap();
    std::fs::write(&path, format!("{}NaN, {}", &text[..digits], &text[digits..])).unwrap();
    made.refused(&all(), &["transforms_train.json", "frames[0].transform_matrix"]);
}

#[test]
fn sizes_and_counts() {
    let made = Made::blender();
    let odd = made.root.join("train/r_7.png");
    RgbImage::from_pixel(24, 24, Rgb([1, 2, 3])).save(&odd).unwrap();
    made.change("transforms_train.json", |j| {
        for frame in j["frames"].as_array_mut().unwrap() {
            frame.as_object_mut().unwrap().remove("depth_file_path");
        }
    });
    made.refused(&all(), &["r_7.png", "24 x 24", "12 x 12", "set a size"]);
    let scene = load(&made.root, &LoadOptions { size: Some([6, 8]), ..all() }, &|_, _| ()).unwrap();
    assert!(scene.train.iter().all(|v| v.pixels.len() == 6 * 8));
    let made = Made::transforms();
    made.change("transforms.json", |j| j["frames"].as_array_mut().unwrap().truncate(9));
    made.refused(&all(), &["has 9 images", "10 are needed"]);
    made.refused(&LoadOptions { layout: Some(Layout::Folder), ..all() }, &["folder (no PNG or JPEG images"]);
}

#[test]
fn depth_ranges() {
    let made = Made::blender();
    for (depth, expected) in [
        (DepthRange::Metric { near: 3.0, far: 3.0 }, "near 3, far 3"),
        (DepthRange::Metric { near: 0.0, far: 3.0 }, "near 0, far 3"),
        (DepthRange::Metric { near: 1.0, far: f64::INFINITY }, "far inf"),
        (DepthRange::Inverse { near: f64::NAN }, "near NaN"),
    ] {
        made.refused(&LoadOptions { depth: Some(depth), ..all() }, &["0 < near < far", expected]);
    }
}

#[test]
fn not_a_scene_at_all() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("thesis.tex"), "text").unwrap();
    let error = load(dir.path(), &all(), &|_, _| ()).unwrap_err().to_string();
    for part in [
        "is not a scene",
        "blender (no transforms_train.json)",
        "transforms (no transforms.json)",
        "dtu (no cameras_sphere.npz or cameras.npz)",
        "llff (no poses_bounds.npy)",
        "colmap (no sparse/0/cameras.bin or .txt)",
        "folder (no PNG or JPEG images",
    ] {
        assert!(error.contains(part), "expected `{part}` in: {error}");
    }
    let nowhere = load(&dir.path().join("nowhere"), &all(), &|_, _| ()).unwrap_err().to_string();
    assert!(nowhere.contains("nowhere") && nowhere.contains("cannot read"), "{nowhere}");
    for (file, part) in [("poses_bounds.npy", "not a NumPy file"), ("cameras.npz", "not a NumPy archive")] {
        let folder = dir.path().join(file.replace('.', "_"));
        std::fs::create_dir_all(folder.join("image")).unwrap();
        std::fs::write(folder.join(file), b"nothing").unwrap();
        let error = load(&folder, &all(), &|_, _| ()).unwrap_err().to_string();
        assert!(error.contains(file) && error.contains(part), "{error}");
    }
}

/// The text form of COLMAP's files, with lens distortion, an image without observations, and points.
#[test]
fn a_colmap_model_in_text() {
    let made = Made::blender();
    let sparse = made.root.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::rename(made.root.join("train"), made.root.join("images")).unwrap();
    let blender = read(&made.root.join("transforms_train.json"));
    std::fs::write(sparse.join("cameras.txt"), "# cameras\n3 OPENCV 24 24 33.4 33.4 12 12 0.01 0 0 0\n").unwrap();
    let mut images = "# images\n".to_string();
    for (i, frame) in blender["frames"].as_array().unwrap().iter().enumerate() {
        let m = |r: usize, c: usize| frame["transform_matrix"][r][c].as_f64().unwrap();
        let flip = nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, -1.0, -1.0));
        let rotation = flip * nalgebra::Matrix3::from_fn(|r, c| m(c, r));
        let t = -(rotation * nalgebra::Vector3::from_fn(|r, _| m(r, 3)));
        let q = nalgebra::UnitQuaternion::from_matrix(&rotation);
        images += &format!("{i} {} {} {} {} {} {} {} 3 r_{i}.png\n", q.w, q.i, q.j, q.k, t.x, t.y, t.z);
        images += if i == 1 { "\n" } else { "1.0 2.0 -1\n" };
    }
    std::fs::write(sparse.join("images.txt"), &images).unwrap();
    std::fs::write(sparse.join("points3D.txt"), "7 0.0 0.0 0.5 255 0 0 0.3 0 1 4 2\n").unwrap();
    let options = LoadOptions { layout: Some(Layout::Colmap), ..all() };
    let scene = load(&made.root, &options, &|_, _| ()).unwrap();
    assert_eq!([scene.train.len(), scene.test.len()], [10, 2]);
    assert_eq!(scene.train[0].removed_distortion, Some([0.01, 0.0, 0.0, 0.0]));
    assert!((scene.train[0].intrinsics.fx - 16.7).abs() < 1e-9);
    // The poses lead back to those of the JSON file; names sort as texts: r_0, r_1, r_10, ...
    let back = scene.frame.unload(&scene.train[1].pose.unwrap()).center();
    let expected = |r: usize| blender["frames"][10]["transform_matrix"][r][3].as_f64().unwrap();
    assert_eq!(scene.train[1].name, "r_10.png");
    assert!((0..3).all(|r| (back[r] - expected(r)).abs() < 1e-9), "{back}");

    for (camera, part) in
        [("3 PINHOLE 24 30 33 33 12 12", "12 x 12"), ("3 PINHOLE 24 24 33 33 12 30", "principal point")]
    {
        std::fs::write(sparse.join("cameras.txt"), camera).unwrap();
        made.refused(&options, &["images.txt", "camera 3 of image r_0.png", part]);
    }
    std::fs::write(sparse.join("cameras.txt"), "3 PINHOLE 24 24 33 33 12 12\n").unwrap();
    std::fs::write(sparse.join("images.txt"), images.replacen("3 r_4.png", "9 r_4.png", 1)).unwrap();
    made.refused(&options, &["images.txt", "image r_4.png", "found 9"]);
    std::fs::write(sparse.join("cameras.txt"), "3 FISHEYE 24 24 33.4 12 12 0\n").unwrap();
    made.refused(&options, &["cameras.txt", "camera 3", "FISHEYE", "SIMPLE_RADIAL"]);
}

#[test]
fn a_folder_of_images() {
    let made = Made::blender();
    let photos = made.root.join("train");
    for depth in std::fs::read_dir(&photos).unwrap().map(|f| f.unwrap().path()) {
        if depth.extension().is_some_and(|e| e == "npy") {
            std::fs::remove_file(depth).unwrap();
        }
    }
    let scene = load(&photos, &all(), &|_, _| ()).unwrap();
    assert_eq!((scene.layout, scene.train.len(), scene.test.len()), (Layout::Folder, 11, 1));
    assert!(scene.train.iter().all(|v| v.pose.is_none() && v.intrinsics.fx == 1.2 * 12.0));
    assert!(scene.notes.iter().any(|n| n.contains("guess")));
    let known = load(&photos, &LoadOptions { focal: Some(30.0), ..all() }, &|_, _| ()).unwrap();
    assert!(known.train[0].intrinsics.fx == 30.0 && known.notes.iter().all(|n| !n.contains("guess")));
    assert_eq!(
        load(&photos, &LoadOptions { focal: Some(-1.0), ..all() }, &|_, _| ())
            .unwrap_err()
            .to_string()
            .matches("focal length")
            .count(),
        1
    );
}
