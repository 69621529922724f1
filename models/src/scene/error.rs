//! What can be wrong with a scene.

use super::Layout;
use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    #[error("cannot read {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{} is not a readable PNG or JPEG image: {source}", .path.display())]
    Decode { path: PathBuf, source: image::ImageError },
    #[error("{}: {message}", .path.display())]
    Format { path: PathBuf, message: String },
    #[error("{}: `{field}`: expected {expected}, found {found}", .path.display())]
    Field { path: PathBuf, field: String, expected: String, found: String },
    #[error("{}: `{field}` names the image {}, which is not there", .path.display(), .image.display())]
    MissingImage { path: PathBuf, field: String, image: PathBuf },
    #[error(
        "{} has {} x {} pixels (height x width), but {} has {} x {}; set a size to bring all images to it",
        .path.display(), .found[0], .found[1], .first.display(), .expected[0], .expected[1]
    )]
    MixedSizes { path: PathBuf, found: [usize; 2], first: PathBuf, expected: [usize; 2] },
    #[error(
        "{} has {} x {} pixels (height x width), but {} has {} x {}, another shape: crop the images to one",
        .path.display(), .found[0], .found[1], .first.display(), .expected[0], .expected[1]
    )]
    MixedShapes { path: PathBuf, found: [usize; 2], first: PathBuf, expected: [usize; 2] },
    #[error("{} has {found} images; {least} are needed to set some aside for testing", .root.display())]
    TooFew { root: PathBuf, found: usize, least: usize },
    #[error("the depth range of {from} is not usable: expected 0 < near < far, found near {near}, far {far}")]
    Depth { from: String, near: f64, far: f64 },
    #[error("{} is not a scene; tried {}", .root.display(), lacking(.tried))]
    NotAScene { root: PathBuf, tried: Vec<(Layout, String)> },
}

fn lacking(tried: &[(Layout, String)]) -> String {
    tried.iter().map(|(layout, lacks)| format!("{layout} ({lacks})")).collect::<Vec<_>>().join(", ")
}
