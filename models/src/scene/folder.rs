//! A folder of images of which nothing else is known: no poses, and a focal length from the options, from EXIF, or guessed.
//!
//! Photos are turned as EXIF says. The last tenth of the sorted images is for testing. Depths are inverse, from 1 on, as for
//! forward-facing captures.

use super::picture::{file_name, images_in, numbered, upright};
use super::{DepthRange, Entry, Intrinsics, Listing, LoadOptions, SceneError, WorldFrame, enough_to_split, last_tenth};
use std::path::{Path, PathBuf};

/// Focal length as a multiple of the longer side where nothing tells: a field of view of 45 degrees.
const GUESS: f64 = 1.2;
/// Longer side of the frame that EXIF's equivalent focal length refers to, in mm.
const FULL_FRAME: f64 = 36.0;

/// The folder `images` in it, or itself.
fn folder(root: &Path) -> PathBuf {
    let inner = root.join("images");
    if inner.is_dir() { inner } else { root.into() }
}

pub(super) fn lacks(root: &Path) -> Option<String> {
    let empty = images_in(&folder(root)).is_ok_and(|found| found.is_empty());
    empty.then(|| "no PNG or JPEG images in it or in `images`".to_string())
}

pub(super) fn list(root: &Path, options: &LoadOptions) -> Result<Listing, SceneError> {
    let mut images = images_in(&folder(root))?;
    // 2.jpg comes before 10.jpg.
    _ = numbered(&mut images);
    enough_to_split(root, images.len())?;
    let mut notes = vec!["no poses are known".to_string()];
    let mut guessed = 0;
    let mut entries = vec![];
    for image in images {
        let ([height, width], turn) = upright(&image)?;
        let longer = height.max(width) as f64;
        let focal = options.focal.or_else(|| equivalent_focal(&image).map(|mm| mm / FULL_FRAME * longer));
        guessed += usize::from(focal.is_none());
        let f = focal.unwrap_or(GUESS * longer);
        if !(f > 0.0 && f.is_finite()) {
            return Err(SceneError::Field {
                path: image,
                field: "focal length".into(),
                expected: "a positive number of pixels".into(),
                found: f.to_string(),
            });
        }
        let (cx, cy) = (width as f64 / 2.0, height as f64 / 2.0);
        let intrinsics = Intrinsics { fx: f, fy: f, cx, cy, height, width, distortion: None };
        entries.push(Entry { name: file_name(&image), image, turn, mask: None, depth: None, intrinsics, pose: None });
    }
    if guessed > 0 {
        notes.push(format!("the focal length of {guessed} images is a guess: {GUESS} times the longer side"));
    }
    let (train, test) = last_tenth(entries);
    let depth = DepthRange::Inverse { near: 1.0 };
    Ok(Listing { train, val: None, test, depth, frame: WorldFrame::identity(), notes })
}

/// EXIF's focal length for a frame of 36 x 24 mm.
fn equivalent_focal(image: &Path) -> Option<f64> {
    let file = std::fs::File::open(image).ok()?;
    let exif = exif::Reader::new().read_from_container(&mut std::io::BufReader::new(file)).ok()?;
    let field = exif.get_field(exif::Tag::FocalLengthIn35mmFilm, exif::In::PRIMARY)?;
    field.value.get_uint(0).filter(|mm| *mm > 0).map(f64::from)
}
