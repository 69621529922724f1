//! Registration in space: cameras find their poses while a radiance field is learned from their images.

pub mod data;
mod error_map;
pub mod evaluate;
pub mod explorer;
mod export;
mod lens;
mod mesh;
pub mod model;
mod novel_views;
pub mod rays;
mod relocalise;
mod rendering;
pub mod results;
pub mod shear;

pub use data::SpaceData;
pub use explorer::{Explorer, Rendered};
pub use model::{NotInSpace, RadianceModel};
pub use novel_views::NovelViews;
