//! Pictures of a run: patches, reconstructions with outlines, warp fields, and the animation over training.

mod animation;
mod canvas;
mod planar;

pub use animation::{animate, animate_at};
pub use canvas::{Canvas, PATCH_COLORS, patch_color};
pub use planar::{View, outlined, patch_row, tile, warp_field};

/// A picture that could not be encoded or decoded.
#[derive(Debug, thiserror::Error)]
#[error("cannot encode a picture: {0}")]
pub struct PictureError(pub String);
