//! Reading reference surfaces: PLY files (Turk 1994) of triangles, polygons or points alone, text or little endian
//! binary.
//!
//! A file says in its head which elements it has and which numbers each of them; what is neither a vertex' position nor
//! a face's corners is skipped. Not a crate: the kept one brings features into the GPU backend's build.

use super::mesh::Mesh;
use std::path::{Path, PathBuf};

/// A file that is no surface.
#[derive(Debug, thiserror::Error)]
pub enum MeshFileError {
    #[error("cannot read the mesh {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("the mesh {} is no readable PLY file: {problem}", .path.display())]
    Format { path: PathBuf, problem: String },
}

impl Mesh {
    /// A mesh, or a cloud of points as a mesh without triangles. Polygons are cut into triangles from their first
    /// corner.
    ///
    /// # Errors
    /// If the file cannot be read, is no PLY in text or little endian binary, has no vertices with finite `x`, `y`,
    /// `z`, or faces with corners it lacks.
    pub fn read_ply(path: &Path) -> Result<Mesh, MeshFileError> {
        let bytes = std::fs::read(path).map_err(|source| MeshFileError::Read { path: path.into(), source })?;
        parse(&bytes).map_err(|problem| MeshFileError::Format { path: path.into(), problem })
    }
}

/// A type of number.
#[derive(Clone, Copy, Debug)]
enum Number {
    Signed(usize),
    Unsigned(usize),
    Float,
    Double,
}

impl Number {
    fn from_name(name: &str) -> Result<Number, String> {
        match name {
            "char" | "int8" => Ok(Number::Signed(1)),
            "short" | "int16" => Ok(Number::Signed(2)),
            "int" | "int32" => Ok(Number::Signed(4)),
            "uchar" | "uint8" => Ok(Number::Unsigned(1)),
            "ushort" | "uint16" => Ok(Number::Unsigned(2)),
            "uint" | "uint32" => Ok(Number::Unsigned(4)),
            "float" | "float32" => Ok(Number::Float),
            "double" | "float64" => Ok(Number::Double),
            other => Err(format!("its head names the unknown type `{other}`")),
        }
    }
    fn size(self) -> usize {
        match self {
            Number::Signed(n) | Number::Unsigned(n) => n,
            Number::Float => 4,
            Number::Double => 8,
        }
    }
    fn value(self, bytes: &[u8]) -> f64 {
        let mut all = [0u8; 8];
        all[..bytes.len()].copy_from_slice(bytes);
        let bits = u64::from_le_bytes(all);
        match self {
            // Shifted up and down again, so that the sign is that of the few bytes.
            Number::Signed(n) => ((bits << (64 - 8 * n)) as i64 >> (64 - 8 * n)) as f64,
            Number::Unsigned(_) => bits as f64,
            Number::Float => f64::from(f32::from_bits(bits as u32)),
            Number::Double => f64::from_bits(bits),
        }
    }
}

/// One property of an element: a number, or a list with its length before it.
struct Property {
    name: String,
    length: Option<Number>,
    number: Number,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

/// Gives the numbers of the body, one after the other.
enum Body<'a> {
    Text(std::str::SplitAsciiWhitespace<'a>),
    Binary(&'a [u8]),
}

impl Body<'_> {
    fn next(&mut self, number: Number) -> Result<f64, String> {
        match self {
            Body::Text(words) => {
                let word = words.next().ok_or("it ends before its last element")?;
                word.parse().map_err(|_| format!("it has `{word}` where a number belongs"))
            }
            Body::Binary(rest) => {
                let (bytes, after) = rest.split_at_checked(number.size()).ok_or("it ends before its last element")?;
                *rest = after;
                Ok(number.value(bytes))
            }
        }
    }

    /// The values of a property.
    fn values(&mut self, property: &Property) -> Result<Vec<f64>, String> {
        let length = property.length.map_or(Ok(1.0), |n| self.next(n))?;
        (0..length as usize).map(|_| self.next(property.number)).collect()
    }
}

fn parse(bytes: &[u8]) -> Result<Mesh, String> {
    let (elements, mut body) = head(bytes)?;
    let mut mesh = Mesh::default();
    let mut faces: Vec<Vec<f64>> = vec![];
    // Elements without properties take no room, however many there are said to be.
    for element in elements.iter().filter(|e| !e.properties.is_empty()) {
        for _ in 0..element.count {
            let mut position = [f64::NAN; 3];
            for property in &element.properties {
                let values = body.values(property)?;
                match (element.name.as_str(), property.name.as_str()) {
                    ("vertex", axis @ ("x" | "y" | "z")) => {
                        position[usize::from(axis.as_bytes()[0] - b'x')] = values.first().copied().unwrap_or(f64::NAN);
                    }
                    ("face", "vertex_indices" | "vertex_index") => faces.push(values),
                    _ => {}
                }
            }
            if element.name == "vertex" {
                mesh.vertices.push(position);
            }
        }
    }
    if mesh.vertices.is_empty() {
        return Err("it has no vertices".into());
    }
    if let Some(i) = mesh.vertices.iter().position(|v| v.iter().any(|x| !x.is_finite())) {
        return Err(format!("vertex {i} has no finite x, y and z"));
    }
    let count = mesh.vertices.len();
    for (i, corners) in faces.iter().enumerate() {
        let is_vertex = |c: &f64| c.fract() == 0.0 && (0.0..count as f64).contains(c);
        if let Some(bad) = corners.iter().find(|c| !is_vertex(c)) {
            return Err(format!("face {i} has the corner {bad}, and there are {count} vertices"));
        }
        let at = |j: usize| corners[j] as u32;
        mesh.triangles.extend((2..corners.len()).map(|j| [at(0), at(j - 1), at(j)]));
    }
    Ok(mesh)
}

/// The elements the head tells of, and what follows it.
fn head(bytes: &[u8]) -> Result<(Vec<Element>, Body<'_>), String> {
    let (mut elements, mut binary, mut rest) = (Vec::<Element>::new(), None, bytes);
    let mut first = true;
    loop {
        let end = rest.iter().position(|b| *b == b'\n').ok_or("its head has no end")?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| "its head is no text")?;
        rest = &rest[end + 1..];
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        if std::mem::take(&mut first) {
            if words != ["ply"] {
                return Err("its first line is not `ply`".into());
            }
            continue;
        }
        match words[..] {
            ["format", "ascii", _] => binary = Some(false),
            ["format", "binary_little_endian", _] => binary = Some(true),
            ["format", other, ..] => return Err(format!("its format is `{other}`, not ascii or binary_little_endian")),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("`{line}` has no count"))?;
                elements.push(Element { name: name.into(), count, properties: vec![] });
            }
            ["property", ref property @ ..] => {
                let element = elements.last_mut().ok_or("its head has a property before any element")?;
                let (name, length, number) = match *property {
                    ["list", length, number, name] => (name, Some(Number::from_name(length)?), number),
                    [number, name] => (name, None, number),
                    _ => return Err(format!("its head has the line `{line}`")),
                };
                element.properties.push(Property { name: name.into(), length, number: Number::from_name(number)? });
            }
            ["end_header"] => break,
            [] | ["comment" | "obj_info", ..] => {}
            _ => return Err(format!("its head has the line `{line}`")),
        }
    }
    let body = if binary.ok_or("its head has no format")? {
        Body::Binary(rest)
    } else {
        Body::Text(std::str::from_utf8(rest).map_err(|_| "its body is no text")?.split_ascii_whitespace())
    };
    Ok((elements, body))
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
        assert!(corners("3 0 1 -1").unwrap_err().contains("the corner -1"));
        assert!(read(&format!("{head}end_header\n0 0 0 9\n")).is_err());
        assert!(read("solid no ply\n").unwrap_err().contains("`ply`"));
        assert!(read("ply\nformat binary_big_endian 1.0\nend_header\n").unwrap_err().contains("big_endian"));
        assert!(read("ply\nelement vertex 1\nproperty half x\nend_header\n").unwrap_err().contains("`half`"));
        let flat = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n0 0\n";
        assert!(read(flat).unwrap_err().contains("vertex 0"));
    }
}
