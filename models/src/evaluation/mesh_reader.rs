//! Reading reference surfaces: PLY files of triangles, polygons or points alone, text or binary.

use super::mesh::Mesh;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, Property, PropertyAccess, PropertyAccessResult};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// A file that is no surface.
#[derive(Debug, thiserror::Error)]
pub enum MeshFileError {
    #[error("cannot read the mesh {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("the mesh {} is no readable PLY file: {problem}", .path.display())]
    Format { path: PathBuf, problem: String },
}

/// A vertex as it is read; NaN where the file does not say.
struct Vertex([f64; 3]);

impl PropertyAccess for Vertex {
    fn new() -> Vertex {
        Vertex([f64::NAN; 3])
    }
    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        let Some(i) = ["x", "y", "z"].iter().position(|axis| *axis == name) else {
            return PropertyAccessResult::Ignored;
        };
        self.0[i] = match value {
            Property::Float(v) => f64::from(v),
            Property::Double(v) => v,
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

/// Corners of a polygon.
struct Face(Vec<u32>);

impl PropertyAccess for Face {
    fn new() -> Face {
        Face(vec![])
    }
    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        let Some(corners) = value.to_u32_list() else { return PropertyAccessResult::UnsupportedType };
        self.0 = corners;
        PropertyAccessResult::Set
    }
}

impl Mesh {
    /// A mesh, or a cloud of points as a mesh without triangles. Polygons are cut into triangles from their first corner.
    ///
    /// # Errors
    /// If the file cannot be read, is no PLY, has no vertices with finite `x`, `y`, `z`, or faces with corners it lacks.
    pub fn read_ply(path: &Path) -> Result<Mesh, MeshFileError> {
        let file = std::fs::File::open(path).map_err(|source| MeshFileError::Read { path: path.into(), source })?;
        parse(BufReader::new(file)).map_err(|problem| MeshFileError::Format { path: path.into(), problem })
    }
}

fn parse(source: impl BufRead) -> Result<Mesh, String> {
    let mut reader = Reader::new(source);
    let vertices = Parser::<Vertex>::new();
    let header = vertices.read_header(&mut reader).map_err(|e| e.to_string())?;
    let (mut mesh, mut faces) = (Mesh::default(), vec![]);
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => {
                let found = vertices.read_payload_for_element(&mut reader, element, &header);
                mesh.vertices = found.map_err(|e| e.to_string())?.into_iter().map(|v| v.0).collect();
            }
            "face" => {
                let found = Parser::<Face>::new().read_payload_for_element(&mut reader, element, &header);
                faces = found.map_err(|e| e.to_string())?;
            }
            _ => {
                let other = Parser::<DefaultElement>::new();
                other.read_payload_for_element(&mut reader, element, &header).map_err(|e| e.to_string())?;
            }
        }
    }
    if mesh.vertices.is_empty() {
        return Err("it has no vertices".into());
    }
    if let Some(i) = mesh.vertices.iter().position(|v| v.iter().any(|x| !x.is_finite())) {
        return Err(format!("vertex {i} has no finite x, y and z as floats or doubles"));
    }
    for (i, Face(corners)) in faces.into_iter().enumerate() {
        if let Some(bad) = corners.iter().find(|c| **c as usize >= mesh.vertices.len()) {
            return Err(format!("face {i} has the corner {bad}, and there are {} vertices", mesh.vertices.len()));
        }
        mesh.triangles.extend((2..corners.len()).map(|j| [corners[0], corners[j - 1], corners[j]]));
    }
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Mesh, String> {
        parse(text.as_bytes())
    }

    #[test]
    fn what_is_written_reads_back() {
        let mesh = Mesh {
            vertices: vec![[0.0, 0.1, 0.0], [1.5, 0.0, 0.0], [0.0, -2.0, 1e-3], [0.25, 0.0, 9.0]],
            triangles: vec![[0, 1, 2], [1, 3, 2]],
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.ply");
        mesh.write(&path).unwrap();
        assert_eq!(Mesh::read_ply(&path).unwrap(), mesh);
        let missing = Mesh::read_ply(&dir.path().join("b.ply")).unwrap_err().to_string();
        assert!(missing.contains("b.ply"), "{missing}");
    }

    #[test]
    fn clouds_and_polygons_in_text() {
        let head = "ply\nformat ascii 1.0\ncomment a scan\nelement vertex 4\nproperty float x\nproperty float y\n\
                    property float z\nproperty uchar red\n";
        let points = "0 0 0 9\n1 0 0 9\n1 1 0 9\n0 1 0.5 9\n";
        let cloud = read(&format!("{head}end_header\n{points}")).unwrap();
        assert_eq!((cloud.vertices[3], cloud.triangles.len()), ([0.0, 1.0, 0.5], 0));
        let list = "element face 1\nproperty list uchar int vertex_index\nend_header\n";
        let square = read(&format!("{head}{list}{points}4 0 1 2 3\n")).unwrap();
        assert_eq!(square.triangles, [[0, 1, 2], [0, 2, 3]]);
        let corners = |line: &str| read(&format!("{head}{list}{points}{line}\n"));
        assert!(corners("3 0 1 4").unwrap_err().contains("face 0 has the corner 4"));
        assert!(corners("3 0 1 -1").is_err());
        assert!(read(&format!("{head}end_header\n0 0 0 9\n")).is_err());
        assert!(read("solid no ply").is_err());
        let flat = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n0 0\n";
        assert!(read(flat).unwrap_err().contains("vertex 0"));
    }
}
