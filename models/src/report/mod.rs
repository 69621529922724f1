//! `report.html`: one file with plots, pictures and settings, readable anywhere without a network.

mod html;
mod plots;

pub use html::{Picture, Report, duration, median};
pub use plots::{Curve, PlotError, plot};
