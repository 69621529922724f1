//! Registration in space: cameras find their poses while a radiance field is learned from their images.

pub mod model;
pub mod rays;

pub use model::{NotInSpace, RadianceModel};
