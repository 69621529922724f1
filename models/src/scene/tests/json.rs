//! Scenes described by JSON files.

use super::*;

/// A scene as one `transforms.json`, of 12 images of 12 x 16.
fn transforms(change: impl FnOnce(&mut Value)) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let frame = |i: usize| {
        save(&dir.path().join(format!("images/{i:02}.png")), i, [12, 16]);
        let x = i as f64;
        json!({ "file_path": format!("images/{i:02}.png"),
            "transform_matrix": [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]] })
    };
    let mut json = json!({ "fl_x": 20.0, "w": 16, "h": 12, "frames": (0..12).map(frame).collect::<Vec<_>>() });
    change(&mut json);
    fs::write(dir.path().join("transforms.json"), json.to_string()).unwrap();
    dir
}

#[test]
fn cameras_of_transforms_that_make_no_sense() {
    let set = |field: &'static str, value: Value| transforms(move |j| j[field] = value);
    let in_frame = |field: &'static str, value: Value| transforms(move |j| j["frames"][3][field] = value);
    assert_eq!(load(transforms(|_| ()).path(), &all(), &|_, _| ()).unwrap().train.len(), 10);
    for (dir, parts) in [
        (set("fl_x", json!("20")), &["`fl_x`: invalid type"][..]),
        (in_frame("cx", json!([8])), &["`frames[3].cx`: invalid type"]),
        (set("is_fisheye", json!(true)), &["`is_fisheye`"]),
        (in_frame("camera_model", json!("OPENCV_FISHEYE")), &["`frames[3].camera_model`", "OPENCV_FISHEYE"]),
        (set("camera_angle_x", json!(3.5)), &["`camera_angle_x`", "between 0 and pi", "3.5"]),
        (set("h", json!(16)), &["`w`", "12 x 16", "16 x 16"]),
        (set("cx", json!(16.5)), &["`cx`", "inside the image", "16.5"]),
        (in_frame("cy", json!(-1)), &["`frames[3].cy`", "inside the image"]),
        (in_frame("fl_y", json!(0)), &["`frames[3].fl_y`", "positive focal length"]),
        (set("fl_x", json!(1e300)), &["`fl_x`", "positive focal length"]),
        (set("frames", json!([])), &["`frames`", "at least one frame"]),
        (
            transforms(|j| j["frames"][2]["transform_matrix"][1][3] = json!(-1e16)),
            &["frames[2].transform_matrix", "1e15"],
        ),
    ] {
        refused(dir.path(), &all(), &[&["transforms.json"], parts].concat());
    }
}

#[test]
fn intrinsics_of_blender_scenes_count() {
    let dir = transforms(|j| {
        j["camera_angle_x"] = json!(1.0);
        j["cx"] = json!(7.0);
        j["k1"] = json!(0.01);
    });
    fs::rename(dir.path().join("transforms.json"), dir.path().join("transforms_train.json")).unwrap();
    let scene = load(dir.path(), &all(), &|_, _| ()).unwrap();
    let c = scene.train[0].intrinsics;
    assert_eq!((scene.layout, [c.fx, c.fy, c.cx, c.cy]), (Layout::Blender, [20.0, 20.0, 7.0, 6.0]));
    assert_eq!(scene.train[0].removed_distortion, Some([0.01, 0.0, 0.0, 0.0]));
}

#[test]
fn angles_of_either_axis() {
    let of = |change: fn(&mut Value)| {
        let dir = transforms(change);
        let camera = load(dir.path(), &all(), &|_, _| ()).unwrap().train[0].intrinsics;
        [camera.fx, camera.fy]
    };
    let wide = |j: &mut Value| {
        j.as_object_mut().unwrap().remove("fl_x");
        (j["camera_angle_x"], j["camera_angle_y"]) = (json!(0.7), json!(1.2));
    };
    let [fx, fy] = of(wide);
    assert!((fx - 8.0 / 0.35f64.tan()).abs() < 1e-9 && (fy - 6.0 / 0.6f64.tan()).abs() < 1e-9, "{fx} {fy}");
    assert_eq!(of(|j| j["camera_angle_y"] = json!(1.2)), [20.0, 20.0], "focal lengths in pixels win");
    refused(
        transforms(|j| j["camera_angle_y"] = json!(-1.0)).path(),
        &all(),
        &["`camera_angle_y`", "between 0 and pi"],
    );
}

#[test]
fn names_of_images() {
    // Endings in capitals, names with dots and no ending, and what macOS leaves beside files.
    let dir = transforms(|j| {
        j["frames"][2]["file_path"] = json!("images/02.PNG");
        j["frames"][3]["file_path"] = json!("images/03.left");
    });
    let image = |name: &str| dir.path().join("images").join(name);
    fs::rename(image("02.png"), image("02.PNG")).unwrap();
    fs::rename(image("03.png"), image("03.left.png")).unwrap();
    fs::write(image("._04.png"), "no image").unwrap();
    assert_eq!(load(dir.path(), &all(), &|_, _| ()).unwrap().train.len(), 10);
    let text = fs::read_to_string(dir.path().join("transforms.json")).unwrap();
    fs::write(dir.path().join("transforms.json"), format!("\u{feff}{text}")).unwrap();
    assert_eq!(load(dir.path(), &all(), &|_, _| ()).unwrap().train.len(), 10);
    let folder = LoadOptions { layout: Some(Layout::Folder), ..all() };
    let photos = load(&dir.path().join("images"), &folder, &|_, _| ()).unwrap();
    assert_eq!(photos.train.len() + photos.test.len(), 12);
}

#[test]
fn the_same_image_twice() {
    let dir = transforms(|j| j["frames"][5] = j["frames"][6].clone());
    refused(dir.path(), &all(), &["images/06.png", "twice"]);
}

#[test]
fn images_of_another_shape() {
    let dir = transforms(|j| _ = j.as_object_mut().unwrap().remove("h"));
    save(&dir.path().join("images/05.png"), 5, [16, 16]);
    for options in [all(), sized(6, 8)] {
        refused(dir.path(), &options, &["05.png", "16 x 16", "01.png", "12 x 16", "another shape"]);
    }
    // The same shape in another size: only where one is asked for.
    save(&dir.path().join("images/05.png"), 5, [24, 32]);
    refused(dir.path(), &all(), &["05.png", "24 x 32", "set a size"]);
    assert_eq!(load(dir.path(), &sized(6, 8), &|_, _| ()).unwrap().train.len(), 10);
}

#[test]
fn depths_that_are_not_the_images() {
    let dir = transforms(|j| j["frames"][2]["depth_file_path"] = json!("depth.npy"));
    let path = dir.path().join("depth.npy");
    for shape in ["0, 0", "0, 16", "3, 50"] {
        fs::write(&path, npy(shape, &[1.0; 150])).unwrap();
        refused(dir.path(), &all(), &["depth.npy", "`size`", "12 x 16", &shape.replace(", ", " x ")]);
    }
    fs::write(&path, npy("3, 4", &[1.0; 12])).unwrap();
    load(dir.path(), &all(), &|_, _| ()).unwrap();
}
