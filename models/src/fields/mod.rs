//! Fields: functions of space that are learned while frames are registered to them.

mod initial;
mod neural_image;
mod radiance;

pub use neural_image::NeuralImage;
pub use radiance::{Radiance, RadianceField};
