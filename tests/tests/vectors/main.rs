//! Numbers of the reference implementations (BARF, L2G-NeRF), in the f64 reference, with the f64 tolerances of the files.
//! Set `RAYGRAD_DATA` to the folder that holds `vectors`; without it the tests only say that they were skipped.

mod evaluation;
mod fits;
mod inn;
mod networks;
mod planar;
mod primitives;
mod rendering;
mod scenes;
mod space;
