//! Fields: functions of space that are learned while frames are registered to them.

mod neural_image;

pub use neural_image::NeuralImage;
