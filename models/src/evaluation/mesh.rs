//! A surface of constant density as triangles: marching cubes (Lorensen and Cline 1987).
//!
//! Densities are taken at the corners of a grid of cubes. Where an edge of a cube has one end above the threshold and
//! one below, the surface cuts it, at the point where linear interpolation meets the threshold. How the cuts of one
//! cube join up follows from its faces alone: on each face a line goes from the cut where its outline enters the dense
//! side to the next, so that two cubes that share a face agree and the surface has no holes. The table of all 256 cases
//! is made from that rule, see [`Table`].

use std::collections::HashMap;

/// Where and how finely to look for a surface, in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshOptions {
    /// Least x, y, z.
    pub low: [f64; 3],
    /// Largest x, y, z.
    pub high: [f64; 3],
    /// Grid points along each axis, at least two.
    pub points: [usize; 3],
    /// The density of the surface.
    pub threshold: f64,
}

impl Default for MeshOptions {
    /// The published programs' grid: 129 points a side over -1.2..=1.2, threshold 25.
    fn default() -> MeshOptions {
        MeshOptions { low: [-1.2; 3], high: [1.2; 3], points: [129; 3], threshold: 25.0 }
    }
}

impl MeshOptions {
    /// The same within bounds: the least and the largest number along each axis, or three such pairs; none where there are as many
    /// as neither.
    pub fn within(self, bounds: &[f64]) -> Option<MeshOptions> {
        let (low, high) = match *bounds {
            [low, high] => ([low; 3], [high; 3]),
            [x0, x1, y0, y1, z0, z1] => ([x0, y0, z0], [x1, y1, z1]),
            _ => return None,
        };
        Some(MeshOptions { low, high, ..self })
    }

    /// The same with so many cubes along each side.
    pub fn with_cubes(self, cubes: usize) -> MeshOptions {
        MeshOptions { points: [cubes.saturating_add(1); 3], ..self }
    }
}

/// Triangles over shared vertices, in world units; seen from outside their corners go counterclockwise.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    pub vertices: Vec<[f64; 3]>,
    /// Indices of three vertices each.
    pub triangles: Vec<[u32; 3]>,
}

/// Why there is no mesh.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    #[error("the mesh's bounds are empty or not finite along {axis}: {low} to {high}")]
    Bounds { axis: char, low: f64, high: f64 },
    #[error("the mesh's grid has {points} points along {axis}; it needs at least 2, and at most {MOST} in all")]
    Points { axis: char, points: usize },
    #[error("the threshold {threshold} of the mesh is not finite")]
    Threshold { threshold: f64 },
    #[error("{wanted} densities were asked for and {found} came back")]
    Count { wanted: usize, found: usize },
    #[error("the density at ({}, {}, {}) is not finite: {density}", .at[0], .at[1], .at[2])]
    NotFinite { at: [f64; 3], density: f32 },
    #[error(
        "no density within the mesh's bounds lies above the threshold {threshold}: the largest is {largest}; \
         lower the threshold, or look elsewhere"
    )]
    Empty { threshold: f64, largest: f64 },
    #[error(
        "every density within the mesh's bounds lies above the threshold {threshold}: the least is {least}; \
         raise the threshold, or widen the bounds"
    )]
    Full { threshold: f64, least: f64 },
    #[error("the densities could not be computed: {0}")]
    Density(#[source] Box<dyn std::error::Error + Send + Sync>),
    #[error(
        "this run's field lives in normalised device coordinates (`train.ndc`), where densities are in no unit of the \
         world: there is no mesh of it"
    )]
    DeviceCoordinates,
    #[error("the mesh has no surface to take points from")]
    NoSurface,
}

/// Grid points in all, so that their densities fit in 2 GB.
const MOST: usize = 1 << 29;
/// Points a call of the density function gets.
const CHUNK: usize = 16384;

/// What a density function says when it fails.
pub type DensityError = Box<dyn std::error::Error + Send + Sync>;

impl MeshOptions {
    pub fn check(&self) -> Result<(), MeshError> {
        let finite = |i: usize| self.low[i].is_finite() && self.high[i].is_finite() && self.low[i] < self.high[i];
        for (i, axis) in ['x', 'y', 'z'].into_iter().enumerate() {
            if !finite(i) {
                return Err(MeshError::Bounds { axis, low: self.low[i], high: self.high[i] });
            }
            let all = self.points.iter().try_fold(1usize, |n, p| n.checked_mul(*p)).unwrap_or(usize::MAX);
            if self.points[i] < 2 || all > MOST {
                return Err(MeshError::Points { axis, points: self.points[i] });
            }
        }
        let threshold = self.threshold;
        if threshold.is_finite() { Ok(()) } else { Err(MeshError::Threshold { threshold }) }
    }

    fn coordinate(&self, axis: usize, i: usize) -> f64 {
        let share = i as f64 / (self.points[axis] - 1) as f64;
        self.low[axis] + (self.high[axis] - self.low[axis]) * share
    }

    /// World coordinates of grid point `index`, z fastest.
    fn point(&self, index: usize) -> [f64; 3] {
        let [_, ny, nz] = self.points;
        [self.coordinate(0, index / (ny * nz)), self.coordinate(1, index / nz % ny), self.coordinate(2, index % nz)]
    }
}

impl Mesh {
    /// The surface where the density crosses the threshold. `density` gets points in world units, at most 16384 at a
    /// time, and gives one density each. The surface ends where the bounds cut through what is dense.
    ///
    /// # Errors
    /// If the options make no grid, `density` fails or gives something that is no density, or the whole grid lies on
    /// one side of the threshold.
    pub fn extract(
        options: &MeshOptions,
        mut density: impl FnMut(&[[f64; 3]]) -> Result<Vec<f32>, DensityError>,
    ) -> Result<Mesh, MeshError> {
        options.check()?;
        let count: usize = options.points.iter().product();
        let mut field: Vec<f32> = Vec::with_capacity(count);
        while field.len() < count {
            let wanted = CHUNK.min(count - field.len());
            let points: Vec<[f64; 3]> = (field.len()..field.len() + wanted).map(|i| options.point(i)).collect();
            let found = density(&points).map_err(MeshError::Density)?;
            if found.len() != wanted {
                return Err(MeshError::Count { wanted, found: found.len() });
            }
            if let Some(i) = found.iter().position(|d| !d.is_finite()) {
                return Err(MeshError::NotFinite { at: points[i], density: found[i] });
            }
            field.extend(found);
        }
        let threshold = options.threshold;
        let extreme = |better: fn(f32, f32) -> f32| f64::from(field.iter().copied().reduce(better).unwrap_or(0.0));
        let (least, largest) = (extreme(f32::min), extreme(f32::max));
        match (largest > threshold, least > threshold) {
            (false, _) => Err(MeshError::Empty { threshold, largest }),
            (_, true) => Err(MeshError::Full { threshold, least }),
            _ => Ok(march(options, &field)),
        }
    }

    /// Surface area, in squared world units.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|i| self.triangle_area(i)).sum()
    }

    /// Area of one triangle.
    pub(super) fn triangle_area(&self, triangle: usize) -> f64 {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a)).norm() / 2.0
    }

    /// Corners of one triangle.
    pub(super) fn corners(&self, triangle: usize) -> [nalgebra::Vector3<f64>; 3] {
        self.triangles[triangle].map(|v| nalgebra::Vector3::from(self.vertices[v as usize]))
    }
}

/// Corners of a cube are numbered by bits, x, y, z. An edge is named by its lower corner and its axis.
type Edge = (usize, usize);

/// For each set of dense corners, the triangles between the cut edges.
struct Table(Vec<Vec<[Edge; 3]>>);

impl Table {
    fn new() -> Table {
        Table((0..256).map(|dense| triangulate(&loops(dense))).collect())
    }
}

/// Corners of the six faces, counterclockwise seen from outside.
fn faces() -> [[usize; 4]; 6] {
    std::array::from_fn(|i| {
        let (axis, upper) = (i / 2, i % 2 == 1);
        let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
        let base = if upper { 1 << axis } else { 0 };
        // u, v and the axis are a right-handed frame, so this order is counterclockwise seen along the axis from above.
        let face = [base, base + u, base + u + v, base + v];
        if upper { face } else { [face[0], face[3], face[2], face[1]] }
    })
}

/// The edge between two neighbouring corners.
fn edge(a: usize, b: usize) -> Edge {
    (a.min(b), (a ^ b).trailing_zeros() as usize)
}

/// Closed lines around the dense corners, each a list of cut edges.
fn loops(dense: usize) -> Vec<Vec<Edge>> {
    let is_dense = |corner: usize| dense >> corner & 1 == 1;
    let mut next: Vec<(Edge, Edge)> = vec![];
    for face in faces() {
        for i in 0..4 {
            let (a, b) = (face[i], face[(i + 1) % 4]);
            if is_dense(a) || !is_dense(b) {
                continue;
            }
            // The outline of the face enters the dense side between a and b; it leaves it after the dense corners.
            let run = (1..4).find(|n| !is_dense(face[(i + 1 + n) % 4])).unwrap_or(3);
            let leaves = edge(face[(i + run) % 4], face[(i + run + 1) % 4]);
            next.push((edge(a, b), leaves));
        }
    }
    // Every cut edge lies on two faces, entered on one and left on the other: the lines close.
    let mut all = vec![];
    while let Some((first, mut at)) = next.pop() {
        let mut line = vec![first];
        while at != first {
            line.push(at);
            let Some(i) = next.iter().position(|(from, _)| *from == at) else { break };
            at = next.swap_remove(i).1;
        }
        all.push(line);
    }
    all
}

/// Fans of triangles. The corner all triangles of a fan share is the one with the fewest diagonals inside a face of the
/// cube, where the neighbour could have the same diagonal.
fn triangulate(loops: &[Vec<Edge>]) -> Vec<[Edge; 3]> {
    let on_face = |a: Edge, b: Edge| {
        let corners = |(corner, axis): Edge| [corner, corner | 1 << axis];
        faces().iter().any(|f| corners(a).iter().chain(&corners(b)).all(|c| f.contains(c)))
    };
    let mut triangles = vec![];
    for line in loops {
        let n = line.len();
        let cost = |start: usize| (2..n - 1).filter(|i| on_face(line[start], line[(start + i) % n])).count();
        let start = (0..n).min_by_key(|s| cost(*s)).unwrap_or(0);
        triangles.extend((1..n - 1).map(|i| [line[start], line[(start + i) % n], line[(start + i + 1) % n]]));
    }
    triangles
}

fn march(options: &MeshOptions, field: &[f32]) -> Mesh {
    let table = Table::new();
    let [nx, ny, nz] = options.points;
    let strides = [ny * nz, nz, 1];
    let offset = |corner: usize| (0..3).filter(|i| corner >> i & 1 == 1).map(|i| strides[i]).sum::<usize>();
    let offsets: [usize; 8] = std::array::from_fn(offset);
    let mut mesh = Mesh::default();
    // Vertices by grid edge, so that neighbouring cubes share them.
    let mut known: HashMap<(usize, usize), u32> = HashMap::new();
    for (x, y) in (0..nx - 1).flat_map(|x| (0..ny - 1).map(move |y| (x, y))) {
        // No later cube touches edges more than a layer back.
        if y == 0 {
            known.retain(|(lower, _), _| *lower >= x * strides[0]);
        }
        for z in 0..nz - 1 {
            let base = x * strides[0] + y * strides[1] + z;
            let is_dense = |corner: &usize| f64::from(field[base + offsets[*corner]]) > options.threshold;
            let dense = (0..8).filter(is_dense).map(|corner| 1 << corner).sum::<usize>();
            for triangle in &table.0[dense] {
                let corners = triangle.map(|(corner, axis)| {
                    let lower = base + offsets[corner];
                    *known.entry((lower, axis)).or_insert_with(|| {
                        mesh.vertices.push(cut(options, field, lower, axis, strides[axis]));
                        (mesh.vertices.len() - 1) as u32
                    })
                });
                mesh.triangles.push(corners);
            }
        }
    }
    mesh
}

/// Where the surface cuts the grid edge from point `lower` along `axis`.
fn cut(options: &MeshOptions, field: &[f32], lower: usize, axis: usize, stride: usize) -> [f64; 3] {
    let (a, b) = (f64::from(field[lower]), f64::from(field[lower + stride]));
    let (mut from, to) = (options.point(lower), options.point(lower + stride));
    // One end is above the threshold and one is not, so they differ.
    from[axis] += (to[axis] - from[axis]) * (options.threshold - a) / (b - a);
    from
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Random;

    /// Every directed edge of a triangle is met by its reverse: the surface is closed and evenly oriented.
    fn assert_closed(mesh: &Mesh) {
        let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
        for t in &mesh.triangles {
            for i in 0..3 {
                let (a, b) = (t[i], t[(i + 1) % 3]);
                *edges.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
            }
        }
        assert!(edges.values().all(|n| *n == 0), "the surface has holes or turned triangles");
    }

    fn volume(mesh: &Mesh) -> f64 {
        let tetrahedron = |i| {
            let [a, b, c] = mesh.corners(i);
            a.dot(&b.cross(&c)) / 6.0
        };
        (0..mesh.triangles.len()).map(tetrahedron).sum()
    }

    /// A ball of radius 0.8 about (0.1, 0, -0.1), in a density of 25 at its surface that falls by 50 a unit.
    fn ball(points: &[[f64; 3]]) -> Result<Vec<f32>, DensityError> {
        let radius = |p: &[f64; 3]| ((p[0] - 0.1).powi(2) + p[1].powi(2) + (p[2] + 0.1).powi(2)).sqrt();
        Ok(points.iter().map(|p| (25.0 + 50.0 * (0.8 - radius(p))) as f32).collect())
    }

    #[test]
    fn a_ball_has_its_size_and_place() {
        let options = MeshOptions { points: [33, 40, 37], ..Default::default() };
        let mesh = Mesh::extract(&options, ball).unwrap();
        assert_closed(&mesh);
        for v in &mesh.vertices {
            let r = ((v[0] - 0.1).powi(2) + v[1].powi(2) + (v[2] + 0.1).powi(2)).sqrt();
            assert!((r - 0.8).abs() < 2e-3, "a vertex at radius {r}");
        }
        let sphere = 4.0 * std::f64::consts::PI * 0.64;
        assert!((mesh.area() / sphere - 1.0).abs() < 0.01, "{}", mesh.area());
        // Positive: triangles look outward.
        assert!((volume(&mesh) / (sphere * 0.8 / 3.0) - 1.0).abs() < 0.02, "{}", volume(&mesh));
    }

    #[test]
    fn all_cases_join_without_holes() {
        // Random corners with sparse borders meet every case of the table, ambiguous faces included.
        let options = MeshOptions { low: [0.0; 3], high: [1.0; 3], points: [24; 3], threshold: 0.5 };
        let mut random = Random::new(0, "cases");
        let border = |p: &[f64; 3]| p.iter().any(|x| *x == 0.0 || *x == 1.0);
        let mesh = Mesh::extract(&options, |points| {
            Ok(points.iter().map(|p| if border(p) { 0.0 } else { random.uniform() as f32 }).collect())
        });
        let mesh = mesh.unwrap();
        assert!(mesh.triangles.len() > 10_000);
        assert_closed(&mesh);
        assert!(volume(&mesh) > 0.0);
        let table = Table::new();
        assert!(table.0[0].is_empty() && table.0[255].is_empty());
        assert!((1..255).all(|i| !table.0[i].is_empty()));
        // One corner, one edge, one side of a cube.
        assert_eq!((table.0[1].len(), table.0[3].len(), table.0[0b1111].len()), (1, 2, 2));
    }

    #[test]
    fn nothing_dense_and_nonsense_are_refused() {
        let refuse = |options: MeshOptions| Mesh::extract(&options, ball).unwrap_err().to_string();
        let small = MeshOptions { points: [5; 3], ..Default::default() };
        let empty = refuse(MeshOptions { threshold: 1000.0, ..small });
        assert!(empty.contains("threshold 1000") && empty.contains("the largest is 5"), "{empty}");
        assert!(refuse(MeshOptions { threshold: -1e4, ..small }).contains("raise the threshold"));
        assert!(refuse(MeshOptions { points: [5, 1, 5], ..small }).contains("1 points along y"));
        assert!(refuse(MeshOptions { points: [1 << 20; 3], ..small }).contains("points along x"));
        assert!(refuse(MeshOptions { low: [0.0, 0.0, 3.0], ..small }).contains("along z"));
        assert!(refuse(MeshOptions { threshold: f64::NAN, ..small }).contains("threshold NaN"));
        let short = Mesh::extract(&small, |_| Ok(vec![1.0])).unwrap_err();
        assert!(matches!(short, MeshError::Count { wanted: 125, found: 1 }));
        let broken = Mesh::extract(&small, |p| Ok(vec![f32::NAN; p.len()])).unwrap_err();
        assert!(broken.to_string().contains("(-1.2, -1.2, -1.2)"), "{broken}");
        let failed = Mesh::extract(&small, |_| Err("no device".into())).unwrap_err();
        assert!(failed.to_string().contains("no device"));
    }
}
