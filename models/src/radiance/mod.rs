//! Registration in space: cameras find their poses while a radiance field is learned from their images.

pub mod data;
pub mod explorer;
pub mod model;
pub mod rays;
pub mod results;

pub use data::SpaceData;
pub use explorer::{Explorer, Rendered};
pub use model::{NotInSpace, RadianceModel};
