//! The mesh options of `raygrad eval`.

use crate::progress::bar;
use clap::{ArgGroup, Args};
use raygrad::Error;
use raygrad::evaluation::{Mesh, MeshOptions, chamfer};
use raygrad::radiance::Explorer;
use raygrad::scene::Layout;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Points drawn from either surface for the Chamfer distance.
const POINTS: usize = 100_000;
/// DTU's evaluation leaves out distances above this, in millimetres.
const DTU_LIMIT: f64 = 20.0;
/// The options that ask for a surface; the others say how it is made.
const WANTED: &str = "surface";

#[derive(Args)]
#[command(group = ArgGroup::new(WANTED).args(["mesh", "cloud"]).multiple(true))]
pub struct SurfaceArgs {
    /// Write the surface as a mesh (`.ply` or `.obj`), in the world of the scene's files.
    #[arg(long, value_name = "FILE", value_parser = mesh_file)]
    mesh: Option<PathBuf>,
    /// Print the Chamfer distance between the surface and this mesh or cloud of points (`.ply`).
    #[arg(long, value_name = "PLY")]
    cloud: Option<PathBuf>,
    /// Cubes along each side of the mesh's grid.
    #[arg(long, value_name = "N", requires = WANTED, default_value_t = MeshOptions::default().points[0] - 1)]
    mesh_resolution: usize,
    /// Density of the surface, in inverse lengths of the true world.
    #[arg(long, value_name = "DENSITY", requires = WANTED, default_value_t = MeshOptions::default().threshold)]
    mesh_threshold: f64,
    /// Where to look: LOW,HIGH along each axis, or three such pairs; in units of the loaded scene.
    #[arg(
        long,
        value_name = "LOW,HIGH",
        requires = WANTED,
        value_delimiter = ',',
        allow_hyphen_values = true,
        default_value = "-1.2,1.2"
    )]
    mesh_bounds: Vec<f64>,
}

/// What was found of the surface.
#[derive(Serialize)]
pub struct Surface {
    vertices: usize,
    triangles: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chamfer: Option<Distances>,
}

/// In the unit of the scene's files.
#[derive(Serialize)]
pub struct Distances {
    accuracy: f64,
    completeness: f64,
    pub mean: f64,
}

fn mesh_file(name: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(name);
    let known = path.extension().is_some_and(|e| e == "ply" || e == "obj");
    if known { Ok(path) } else { Err("expected a name ending in `.ply` or `.obj`".to_string()) }
}

/// Points of a surface: the vertices where there is nothing else.
fn points(mesh: &Mesh, seed: u32) -> Result<Vec<[f64; 3]>, Error> {
    if mesh.triangles.is_empty() { Ok(mesh.vertices.clone()) } else { Ok(mesh.sample(POINTS, seed)?) }
}

fn found_mesh(explorer: &mut Explorer, options: &MeshOptions) -> Result<Mesh, Error> {
    let shown = bar("meshing", "points");
    let mesh = explorer.mesh(options, &|done, all| shown.show(done, all));
    shown.finish();
    mesh
}

fn distances(mesh: &Mesh, reference: &Mesh, layout: Layout) -> Result<Distances, Error> {
    let limit = (layout == Layout::Dtu).then_some(DTU_LIMIT);
    let found = chamfer(&points(mesh, 0)?, &points(reference, 1)?, limit)?;
    Ok(Distances { accuracy: found.accuracy, completeness: found.completeness, mean: found.mean() })
}

/// The Chamfer distance between a run's surface and a reference.
pub fn distance_to(explorer: &mut Explorer, options: &MeshOptions, reference: &Mesh) -> Result<f64, Error> {
    let mesh = found_mesh(explorer, options)?;
    Ok(distances(&mesh, reference, explorer.data.scene.layout)?.mean)
}

impl SurfaceArgs {
    /// The file that the mesh is to be written to.
    pub fn mesh_file(&self) -> &Option<PathBuf> {
        &self.mesh
    }

    pub fn wanted(&self) -> bool {
        self.mesh.is_some() || self.cloud.is_some()
    }

    /// The reference and the grid, looked at before anything is computed.
    pub fn checked(&self) -> Result<(Option<Mesh>, MeshOptions), Error> {
        let options = MeshOptions { threshold: self.mesh_threshold, ..MeshOptions::default() };
        let Some(options) = options.with_cubes(self.mesh_resolution).within(&self.mesh_bounds) else {
            return Err(Error::from(raygrad::config::ConfigError::Value {
                origin: raygrad::config::Origin::Option("--mesh-bounds".into()),
                key: "mesh-bounds".into(),
                message: format!("expected 2 or 6 numbers, found {}", self.mesh_bounds.len()),
            }));
        };
        options.check()?;
        Ok((self.cloud.as_deref().map(Mesh::read_ply).transpose()?, options))
    }

    pub fn run(
        &self,
        explorer: &mut Explorer,
        (reference, options): &(Option<Mesh>, MeshOptions),
    ) -> Result<Surface, Error> {
        let mesh = found_mesh(explorer, options)?;
        if let Some(path) = &self.mesh {
            mesh.write(path)?;
        }
        let distances = reference.as_ref().map(|reference| distances(&mesh, reference, explorer.data.scene.layout));
        Ok(Surface { vertices: mesh.vertices.len(), triangles: mesh.triangles.len(), chamfer: distances.transpose()? })
    }

    /// For people.
    pub fn text(&self, found: &Surface) -> String {
        let file = self.mesh.as_deref().map_or(String::new(), |p: &Path| format!(" in {}", p.display()));
        let mut text = format!("mesh          {} triangles{file}\n", found.triangles);
        if let Some(Distances { accuracy, completeness, mean }) = found.chamfer {
            text += &format!("chamfer       {mean:.4} (accuracy {accuracy:.4}, completeness {completeness:.4})\n");
        }
        text
    }
}
