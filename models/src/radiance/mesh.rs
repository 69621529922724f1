//! The surface of a learned scene: where its density crosses a threshold, in the world of the scene's files.

use super::data::SpaceDataError;
use super::explorer::Explorer;
use crate::Error;
use crate::evaluation::{Mesh, MeshError, MeshOptions};
use crate::training::Training;
use nalgebra::Vector3;

impl Explorer {
    /// Marching cubes over the density. Bounds are those of the loaded world, that of the true poses, and the threshold is in
    /// its inverse lengths; vertices come in the world and unit of the scene's files. `progress` hears how many of how many
    /// densities are there.
    ///
    /// # Errors
    /// If the options make no grid, or nothing in it, or all of it, is denser than the threshold, or the field lives in
    /// normalised device coordinates.
    pub fn mesh(&mut self, options: &MeshOptions, progress: &dyn Fn(usize, usize)) -> Result<Mesh, Error> {
        if self.settings.train.as_ref().is_some_and(|t| t.ndc) {
            return Err(MeshError::DeviceCoordinates.into());
        }
        let poses = self.poses()?;
        let similarity = self.data.similarity(&poses).map_err(SpaceDataError::from)?;
        let (mut done, all) = (0, options.points.iter().product());
        let mut mesh = Mesh::extract(options, |points| {
            let learned = |p: &[f64; 3]| similarity.point_to_learned(&Vector3::from(*p)).map(|x| x as f32).into();
            let densities = self.density(&points.iter().map(learned).collect::<Vec<[f32; 3]>>())?;
            done += points.len();
            progress(done, all);
            // A length of the learned world is `scale` of the true one.
            Ok(densities.into_iter().map(|d| (f64::from(d) / similarity.scale) as f32).collect())
        })?;
        let frame = self.data.scene.frame;
        mesh.vertices.iter_mut().for_each(|v| *v = frame.unload_point(&Vector3::from(*v)).into());
        self.learner().check_finite("a vertex", mesh.vertices.as_flattened())?;
        Ok(mesh)
    }
}
