//! Scenes whose files are damaged, missing, misnamed or contradict each other.

mod json;

use super::*;
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use std::fs;
use std::io::Write;
use tempfile::TempDir;

#[test]
fn resizing_scales_each_axis_by_itself() {
    let phone = Intrinsics {
        fx: 1606.5,
        fy: 1606.5,
        cx: 960.0,
        cy: 540.0,
        height: 1080,
        width: 1920,
        distortion: Some([0.1, 0.0, 0.0, 0.0]),
    };
    let small = phone.resized(480, 640);
    assert_eq!([small.fx, small.fy, small.cx, small.cy], [535.5, 714.0, 320.0, 240.0]);
    assert_eq!((small.height, small.width, small.distortion), (480, 640, phone.distortion));
}

#[track_caller]
fn refused(root: &Path, options: &LoadOptions, parts: &[&str]) {
    let error = load(root, options, &|_, _| ()).map(|s| s.layout).unwrap_err().to_string();
    for part in parts {
        assert!(error.contains(part), "expected `{part}` in: {error}");
    }
}

fn all() -> LoadOptions {
    LoadOptions::default()
}

fn sized(height: usize, width: usize) -> LoadOptions {
    LoadOptions { size: Some([height, width]), ..all() }
}

/// An image all of whose pixels say which one it is.
fn save(path: &Path, i: usize, [height, width]: [u32; 2]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    RgbImage::from_pixel(width, height, Rgb([i as u8, 100, 200])).save(path).unwrap();
}

fn shown(view: &View) -> usize {
    usize::from(view.pixels[0][0])
}

/// The bytes of a NumPy file.
fn npy(shape: &str, values: &[f64]) -> Vec<u8> {
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}), }}");
    let header = format!("{header:<117}\n");
    let data = values.iter().flat_map(|x| x.to_le_bytes());
    b"\x93NUMPY\x01\0\x76\0".iter().copied().chain(header.into_bytes()).chain(data).collect()
}

/// A DTU scan of 12 cameras, the x of whose centres in mm is their number, for images of 24 x 32.
fn dtu_cameras(root: &Path, focal_x: [f64; 2]) {
    dtu_cameras_in(root, focal_x, 0.0, [300.0, 0.0]);
}

/// The same with a skew, and the radius and depth of the object.
fn dtu_cameras_in(root: &Path, focal_x: [f64; 2], skew: f64, [radius, away]: [f64; 2]) {
    let file = fs::File::create(root.join("cameras.npz")).unwrap();
    let mut archive = zip::ZipWriter::new(file);
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let [f, cx] = focal_x;
    for i in 0..12 {
        let x = f64::from(i);
        let world = [f, skew, cx, -f * x, 0.0, f, 12.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let scale: [f64; 16] = std::array::from_fn(|k| match k {
            15 => 1.0,
            11 => away,
            _ if k % 5 == 0 => radius,
            _ => 0.0,
        });
        for (name, values) in [("world", world), ("scale", scale)] {
            archive.start_file(format!("{name}_mat_{i}.npy"), stored).unwrap();
            archive.write_all(&npy("4, 4", &values)).unwrap();
        }
    }
    archive.finish().unwrap();
}

fn dtu() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    dtu_cameras(dir.path(), [40.0, 16.0]);
    (0..12).for_each(|i| save(&dir.path().join(format!("image/{i:06}.png")), i, [24, 32]));
    dir
}

/// Every view's number in its picture is that of its camera.
#[track_caller]
fn paired(scene: &Scene, count: usize) {
    let views: Vec<&View> = scene.train.iter().chain(&scene.test).collect();
    assert_eq!(views.len(), count);
    for view in views {
        let x = scene.frame.unload(&view.pose.unwrap()).center().x;
        assert!((x - shown(view) as f64).abs() < 1e-6, "{}: {x}", view.name);
    }
}

#[test]
fn dtu_images_go_with_the_cameras_of_their_number() {
    let dir = dtu();
    paired(&load(dir.path(), &all(), &|_, _| ()).unwrap(), 12);
    fs::remove_file(dir.path().join("image/000003.png")).unwrap();
    let scene = load(dir.path(), &all(), &|_, _| ()).unwrap();
    paired(&scene, 11);
    assert_eq!(scene.test.iter().map(shown).collect::<Vec<_>>(), [0, 8]);
    // Names that are no numbers go by position, so none may be missing.
    for i in (0..12).filter(|i| *i != 3) {
        let image = |name: String| dir.path().join("image").join(name);
        fs::rename(image(format!("{i:06}.png")), image(format!("rect_{i:03}.png"))).unwrap();
    }
    refused(dir.path(), &all(), &["cameras.npz", "has 12 cameras", "has 11 images"]);
    save(&dir.path().join("image/rect_003.png"), 3, [24, 32]);
    paired(&load(dir.path(), &all(), &|_, _| ()).unwrap(), 12);
}

#[test]
fn dtu_splits() {
    let dir = dtu();
    let with = |dtu_split| LoadOptions { dtu_split, ..all() };
    let scene = load(dir.path(), &with(DtuSplit::All), &|_, _| ()).unwrap();
    assert_eq!((scene.train.len(), scene.test.len()), (12, 12));
    refused(dir.path(), &with(DtuSplit::PixelNerf), &["cameras.npz", "split pixelnerf", "000025.png"]);
    let numbers: Vec<usize> = (0..49).collect();
    let [train, test] = DtuSplit::PixelNerf.of(&numbers);
    assert_eq!((train, test.len()), (vec![25, 22, 28, 40, 44, 48, 0, 8, 13], 25));
    assert!(test.contains(&1) && !test.contains(&3) && !test.contains(&21) && !test.contains(&39));
    let [train, test] = DtuSplit::PixelNerfReduced.of(&numbers);
    assert_eq!((train.len(), test.len()), (18, 16));
    assert!(!train.iter().any(|n| test.contains(n)));
    let [train, test] = DtuSplit::default().of(&numbers);
    assert_eq!((train.len(), test), (42, vec![0, 8, 16, 24, 32, 40, 48]));
    assert!(DtuSplit::ALL.iter().all(|s| DtuSplit::from_name(s.name()) == Some(*s)));
}

/// White to the right of column 12 of 16, with one grey pixel; the image has 32 columns.
#[test]
fn masks_and_depths_of_another_size() {
    let dir = dtu();
    let mask = dir.path().join("mask/001.png");
    fs::create_dir_all(mask.parent().unwrap()).unwrap();
    GrayImage::from_fn(16, 12, |x, y| {
        Luma([if x < 12 {
            0
        } else if (x, y) == (14, 6) {
            254
        } else {
            255
        }])
    })
    .save(&mask)
    .unwrap();
    let scene = load(dir.path(), &all(), &|_, _| ()).unwrap();
    let mask_of = |scene: &Scene| scene.train[0].mask.clone().unwrap();
    let row = |i: usize| (0..32).filter(|j| mask_of(&scene)[i * 32 + j]).collect::<Vec<_>>();
    assert_eq!(row(0), [25, 26, 27, 28, 29, 30, 31]);
    // The lookups of columns 27 to 30 touch the grey one.
    assert_eq!(row(12), [25, 26, 31]);
    GrayImage::new(16, 16).save(&mask).unwrap();
    refused(dir.path(), &all(), &["001.png", "`size`", "24 x 32", "16 x 16"]);
}

#[test]
fn dtu_scans_beside_their_masks_and_depths() {
    let dir = tempfile::tempdir().unwrap();
    let scan = dir.path().join("rs_dtu_4/DTU/scan1");
    fs::create_dir_all(&scan).unwrap();
    dtu_cameras(&scan, [40.0, 16.0]);
    (0..12).for_each(|i| save(&scan.join(format!("image/{i:06}.png")), i, [24, 32]));
    let masks = dir.path().join("submission_data/idrmasks/scan1");
    (0..12).for_each(|i| save(&masks.join(format!("{i:03}.png")), 255, [24, 32]));
    let odd = scan.join("image/../../scan1");
    for root in [&scan, &odd] {
        let scene = load(root, &all(), &|_, _| ()).unwrap();
        assert!(scene.train.iter().all(|v| v.mask.is_some()), "{}", root.display());
    }
}

#[test]
fn dtu_cameras_for_images_of_another_size() {
    let dir = dtu();
    dtu_cameras(dir.path(), [20.0, 7.9]);
    refused(dir.path(), &all(), &["cameras.npz", "world_mat_", "(7.9, 12.0)", "another size"]);
    // Five eighths of 32 columns.
    dtu_cameras(dir.path(), [20.0, 20.0]);
    refused(dir.path(), &all(), &["world_mat_", "another size"]);
}

#[test]
fn skewed_dtu_cameras() {
    let dir = dtu();
    // The shift at the upper and lower edge, 12 rows from the middle.
    dtu_cameras_in(dir.path(), [40.0, 16.0], 2.0, [300.0, 0.0]);
    refused(dir.path(), &all(), &["cameras.npz", "world_mat_", "skew of 2.000", "up to 0.6"]);
    dtu_cameras_in(dir.path(), [40.0, 16.0], -1.0, [300.0, 0.0]);
    assert_eq!(load(dir.path(), &all(), &|_, _| ()).unwrap().train.len(), 10);
}

#[test]
fn depths_of_dtu_and_of_captures_in_other_units() {
    let dir = dtu();
    let scene = |radius, away| {
        dtu_cameras_in(dir.path(), [40.0, 16.0], 0.0, [radius, away]);
        load(dir.path(), &all(), &|_, _| ()).unwrap()
    };
    let range = |scene: &Scene, expected: [f64; 2]| {
        let DepthRange::Metric { near, far } = scene.depth else { panic!("{:?}", scene.depth) };
        assert!((near - expected[0]).abs() < 1e-9 && (far - expected[1]).abs() < 1e-9, "{near} {far}");
    };
    let mm = scene(300.0, 700.0);
    range(&mm, [1.2, 5.2]);
    assert!(mm.notes.is_empty());
    // Centres of x 0 to 11, an object of radius 2 at (0, 0, 60).
    let other = scene(2.0, 60.0);
    range(&other, [29.0, 1.0 + 60_f64.hypot(11.0) / 2.0]);
    assert!(other.notes[0].contains("30.000 to 30.500 radii"), "{}", other.notes[0]);
    // Cameras amid it.
    range(&scene(2000.0, 0.0), [0.1, 1.0 + 11.0 / 2000.0]);
}

#[test]
fn archives_are_checked() {
    let dir = dtu();
    let path = dir.path().join("cameras.npz");
    let mut bytes = fs::read(&path).unwrap();
    // A digit of the first matrix.
    let start = bytes.windows(6).position(|w| w == b"\x93NUMPY").unwrap() + 128;
    bytes[start] ^= 1;
    fs::write(&path, bytes).unwrap();
    refused(dir.path(), &all(), &["cameras.npz", "world_mat_0", "checksum"]);
}

/// Twelve cameras in a row whose x is their number, with pictures called like `name`.
fn llff(name: impl Fn(usize) -> String) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut names: Vec<(String, usize)> = (0..12).map(|i| (name(i), i)).collect();
    names.iter().for_each(|(name, i)| save(&dir.path().join("images").join(name), *i, [12, 16]));
    names.sort();
    let mut values = vec![];
    for (_, i) in &names {
        // Columns down, right, back, centre, sizes.
        let rows = [[0.0, 1.0, 0.0, *i as f64, 12.0], [-1.0, 0.0, 0.0, 0.0, 16.0], [0.0, 0.0, 1.0, 0.0, 20.0]];
        values.extend(rows.iter().flatten());
        values.extend([1.0, 9.0]);
    }
    fs::write(dir.path().join("poses_bounds.npy"), npy("12, 17", &values)).unwrap();
    dir
}

#[test]
fn rows_of_llff_are_in_the_plain_order_of_names() {
    paired(&load(llff(|i| format!("{i}.png")).path(), &all(), &|_, _| ()).unwrap(), 12);
    paired(&load(llff(|i| format!("IMG_{i:03}.png")).path(), &all(), &|_, _| ()).unwrap(), 12);
}

#[test]
fn cameras_for_images_of_another_shape() {
    let dir = llff(|i| format!("{i}.png"));
    (0..12).for_each(|i| save(&dir.path().join(format!("images/{i}.png")), i, [16, 12]));
    refused(dir.path(), &all(), &["poses_bounds.npy", "row 0", "16 x 12", "12 x 16"]);
    // Halves of sides that are no whole numbers.
    (0..12).for_each(|i| save(&dir.path().join(format!("images/{i}.png")), i, [5, 7]));
    assert_eq!(load(dir.path(), &all(), &|_, _| ()).unwrap().train.len(), 11);
}

#[test]
fn llff_in_full_resolution() {
    let dir = llff(|i| format!("{i:03}.png"));
    let folder = |name: &str| dir.path().join(name);
    for i in 0..12 {
        save(&folder(&format!("images_8/{i:03}.png")), 100 + i, [3, 4]);
        save(&folder(&format!("images_4/{i:03}.png")), 200 + i, [6, 8]);
    }
    assert_eq!(shown(&load(dir.path(), &sized(3, 4), &|_, _| ()).unwrap().train[0]), 0);
    fs::remove_dir_all(folder("images")).unwrap();
    let scene = load(dir.path(), &sized(3, 4), &|_, _| ()).unwrap();
    assert_eq!((shown(&scene.train[0]), scene.train[0].intrinsics.fx), (200, 5.0));
}

#[test]
fn arrays_of_impossible_shapes() {
    let dir = llff(|i| format!("{i:03}.png"));
    let path = dir.path().join("poses_bounds.npy");
    for (shape, part) in [
        ("4294967296, 4294967296", "[4294967296, 4294967296]"),
        ("12, 17", "found 8 bytes"),
        ("0, 17", "rows of 17 numbers"),
    ] {
        fs::write(&path, npy(shape, &[1.0])).unwrap();
        refused(dir.path(), &all(), &["poses_bounds.npy", part]);
    }
}

/// Twelve photos, left half dark, right half bright, in JPEG.
fn photos() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    for i in 0..12 {
        let photo = RgbImage::from_fn(48, 32, |x, _| Rgb([if x < 24 { 20 } else { 220 }; 3]));
        photo.save(dir.path().join(format!("{i}.jpg"))).unwrap();
    }
    dir
}

#[test]
fn damaged_photos() {
    let dir = photos();
    let path = dir.path().join("4.jpg");
    let whole = fs::read(&path).unwrap();
    fs::write(&path, [&whole[..], &[0; 999]].concat()).unwrap();
    load(dir.path(), &all(), &|_, _| ()).unwrap();
    fs::write(&path, &whole[..whole.len() - 40]).unwrap();
    refused(dir.path(), &all(), &["4.jpg", "damaged JPEG"]);
}

#[test]
fn photos_are_turned_as_exif_says() {
    let dir = photos();
    for i in 0..12 {
        // One entry of EXIF: tag 0x112, orientation, 6.
        let exif = b"\xff\xe1\0\x22Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
        let path = dir.path().join(format!("{i}.jpg"));
        let whole = fs::read(&path).unwrap();
        fs::write(&path, [&whole[..2], exif, &whole[2..]].concat()).unwrap();
    }
    let scene = load(dir.path(), &all(), &|_, _| ()).unwrap();
    let view = &scene.train[0];
    assert_eq!((view.intrinsics.height, view.intrinsics.width), (48, 32));
    assert!(view.pixels[0][0] < 40 && view.pixels[31][0] < 40 && view.pixels[47 * 32][0] > 200);
    // In the order of numbers.
    assert_eq!([&scene.train[2].name, &scene.train[10].name], ["2.jpg", "10.jpg"]);
}

/// The text form of COLMAP, written with or without the empty lines of images that observe nothing.
#[test]
fn empty_lines_of_colmap() {
    let dir = tempfile::tempdir().unwrap();
    let sparse = dir.path().join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    fs::write(sparse.join("cameras.txt"), "1 PINHOLE 16 12 20 20 8 6\n").unwrap();
    fs::write(sparse.join("points3D.txt"), "").unwrap();
    (0..12).for_each(|i| save(&dir.path().join(format!("images/{i:02}.png")), i, [12, 16]));
    let image = |i: i32| format!("{i} 1 0 0 0 {} 0 0 1 {i:02}.png\n", -i);
    let seen = "12 3 -1 4 5 6 1 2 -1 7 8 9\n";
    for text in [
        (0..12).map(image).collect::<String>(),
        "\n".to_string() + &(0..12).map(|i| image(i) + "\n").collect::<String>(),
        (0..12).map(|i| image(i) + if i % 3 == 0 { "" } else { seen }).collect(),
    ] {
        fs::write(sparse.join("images.txt"), text).unwrap();
        paired(&load(dir.path(), &all(), &|_, _| ()).unwrap(), 12);
    }
    fs::write(sparse.join("images.txt"), "3 1 0 0 0 0 0 0 1\n").unwrap();
    refused(dir.path(), &all(), &["images.txt", "line 1, name"]);
}
