//! Data of the experiments: photos, perturbations, and the random numbers of the host.

pub mod initial;
pub mod perturbation;
pub mod photo;
pub mod random;

pub use initial::initial_values;
pub use perturbation::{Perturbation, PerturbationError};
pub use photo::{Photo, PhotoError};
pub use random::Random;
