//! Meshes as files: Wavefront OBJ (text) and PLY (binary, little endian).

use super::mesh::Mesh;
use crate::run::files::{WriteError, write_atomically};
use std::fmt::Write;
use std::path::Path;

impl Mesh {
    /// As Wavefront OBJ: `v x y z` a vertex, `f a b c` a triangle, counted from one.
    pub fn to_obj(&self) -> String {
        let mut out = String::new();
        // Writing to a string cannot fail.
        for [x, y, z] in &self.vertices {
            let _ = writeln!(out, "v {x} {y} {z}");
        }
        for [a, b, c] in self.triangles.iter().map(|t| t.map(|i| i + 1)) {
            let _ = writeln!(out, "f {a} {b} {c}");
        }
        out
    }

    /// As binary PLY with vertices in doubles.
    pub fn to_ply(&self) -> Vec<u8> {
        let (vertices, faces) = (self.vertices.len(), self.triangles.len());
        let mut out = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty double x\nproperty double y\n\
             property double z\nelement face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        .into_bytes();
        out.extend(self.vertices.iter().flatten().flat_map(|x| x.to_le_bytes()));
        for triangle in &self.triangles {
            out.push(3);
            out.extend(triangle.iter().flat_map(|i| i.to_le_bytes()));
        }
        out
    }

    /// Writes PLY where the name ends in `.ply`, else OBJ.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), WriteError> {
        let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
        write_atomically(path, &if is_ply { self.to_ply() } else { self.to_obj().into_bytes() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_hold_the_mesh() {
        let mesh = Mesh {
            vertices: vec![[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [0.0, -2.0, 1e-3], [0.25, 0.0, 9.0]],
            triangles: vec![[0, 1, 2], [1, 3, 2]],
        };
        assert_eq!(mesh.to_obj(), "v 0 0 0\nv 1.5 0 0\nv 0 -2 0.001\nv 0.25 0 9\nf 1 2 3\nf 2 4 3\n");
        let ply = mesh.to_ply();
        let body = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert_eq!(ply.len() - body, 4 * 24 + 2 * 13);
        assert_eq!(f64::from_le_bytes(ply[body + 24..body + 32].try_into().unwrap()), 1.5);
        assert_eq!(ply[body + 96], 3);
        assert_eq!(i32::from_le_bytes(ply[body + 114..body + 118].try_into().unwrap()), 3);
        let dir = tempfile::tempdir().unwrap();
        mesh.write(&dir.path().join("a.ply")).unwrap();
        mesh.write(&dir.path().join("a.obj")).unwrap();
        assert_eq!(std::fs::read(dir.path().join("a.ply")).unwrap(), ply);
        assert!(mesh.write(&dir.path().join("no/such/folder.obj")).is_err());
    }
}
