//! The Chamfer distance between a mesh and a reference surface.
//!
//! Points are drawn evenly over each surface. Accuracy is the mean distance from the mesh to the nearest reference
//! point, completeness the mean the other way round; the Chamfer distance is the mean of the two. Distances above a
//! limit are left out, as DTU's evaluation does with its 20 mm.

use super::mesh::{Mesh, MeshError};
use crate::data::Random;
use rayon::prelude::*;
use rstar::RTree;

/// Distances between two clouds of points, in their unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chamfer {
    /// Mean distance from the mesh to the reference.
    pub accuracy: f64,
    /// Mean distance from the reference to the mesh.
    pub completeness: f64,
}

impl Chamfer {
    /// The symmetric distance: the mean of both directions.
    pub fn mean(&self) -> f64 {
        (self.accuracy + self.completeness) / 2.0
    }
}

/// Clouds of points that cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CloudError {
    #[error("the {which} has no points")]
    Empty { which: &'static str },
    #[error("point {index} of the {which} is not finite: {point:?}")]
    NotFinite { which: &'static str, index: usize, point: [f64; 3] },
    #[error("no point of the {which} has a neighbour within {limit}")]
    Far { which: &'static str, limit: f64 },
}

impl Mesh {
    /// `count` points drawn evenly over the surface, the same for the same `seed`. Two surfaces to be compared are drawn
    /// from with two seeds, so that their points do not match by construction.
    ///
    /// # Errors
    /// If the mesh has no surface.
    pub fn sample(&self, count: usize, seed: u32) -> Result<Vec<[f64; 3]>, MeshError> {
        let mut sum = 0.0;
        let areas = (0..self.triangles.len()).map(|i| self.triangle_area(i));
        let upto: Vec<f64> = areas
            .map(|a| {
                sum += a;
                sum
            })
            .collect();
        if !(sum > 0.0 && sum.is_finite()) {
            return Err(MeshError::NoSurface);
        }
        let mut random = Random::new(seed, "surface");
        let point = |_| {
            let place = random.uniform() * sum;
            let triangle = upto.partition_point(|u| *u <= place).min(upto.len() - 1);
            let [a, b, c] = self.corners(triangle);
            // The root makes the density even (Osada et al. 2002).
            let (r, s) = (random.uniform().sqrt(), random.uniform());
            (a * (1.0 - r) + b * (r * (1.0 - s)) + c * (r * s)).into()
        };
        Ok((0..count).map(point).collect())
    }
}

/// Distances between points of a mesh and of a reference, in both directions. Distances above `limit` are left out.
///
/// # Errors
/// If either cloud is empty, has a point that is not finite, or lies wholly farther than `limit` from the other.
pub fn chamfer(mesh: &[[f64; 3]], reference: &[[f64; 3]], limit: Option<f64>) -> Result<Chamfer, CloudError> {
    for (which, cloud) in [("mesh", mesh), ("reference", reference)] {
        if cloud.is_empty() {
            return Err(CloudError::Empty { which });
        }
        if let Some(index) = cloud.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
            return Err(CloudError::NotFinite { which, index, point: cloud[index] });
        }
    }
    let limit = limit.unwrap_or(f64::INFINITY);
    let accuracy = mean_distance(mesh, reference, limit).ok_or(CloudError::Far { which: "mesh", limit })?;
    let completeness = mean_distance(reference, mesh, limit).ok_or(CloudError::Far { which: "reference", limit })?;
    Ok(Chamfer { accuracy, completeness })
}

/// Mean distance to the nearest point of `to`; nothing if all are above the limit.
fn mean_distance(from: &[[f64; 3]], to: &[[f64; 3]], limit: f64) -> Option<f64> {
    let tree = RTree::bulk_load(to.to_vec());
    let squared = |p: &[f64; 3]| {
        let nearest = tree.nearest_neighbor(*p)?;
        Some(p.iter().zip(nearest).map(|(a, b)| (a - b).powi(2)).sum::<f64>())
    };
    // Collected in order, so the sum is the same for any number of threads.
    let distances: Vec<f64> = from.par_iter().filter_map(|p| squared(p).map(f64::sqrt)).collect();
    let kept: Vec<f64> = distances.into_iter().filter(|d| *d <= limit).collect();
    (!kept.is_empty()).then(|| kept.iter().sum::<f64>() / kept.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles over the square (0, 0)..(side, side) at height z.
    fn square(side: f64, z: f64) -> Mesh {
        let vertices = vec![[0.0, 0.0, z], [side, 0.0, z], [side, side, z], [0.0, side, z]];
        Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }
    }

    #[test]
    fn distances_against_every_pair() {
        let mut random = Random::new(1, "cloud");
        let mut cloud = |n| -> Vec<[f64; 3]> { (0..n).map(|_| std::array::from_fn(|_| random.uniform())).collect() };
        let (a, mut b) = (cloud(300), cloud(200));
        b.push(b[0]);
        let slow = |from: &[[f64; 3]], to: &[[f64; 3]]| {
            let distance =
                |p: &[f64; 3], q: &[f64; 3]| p.iter().zip(q).map(|(x, y)| (x - y).powi(2)).sum::<f64>().sqrt();
            let nearest = |p: &[f64; 3]| to.iter().map(|q| distance(p, q)).fold(f64::INFINITY, f64::min);
            from.iter().map(nearest).sum::<f64>() / from.len() as f64
        };
        let found = chamfer(&a, &b, None).unwrap();
        assert!((found.accuracy - slow(&a, &b)).abs() < 1e-12);
        assert!((found.completeness - slow(&b, &a)).abs() < 1e-12);
        assert_eq!(found.mean(), (found.accuracy + found.completeness) / 2.0);
    }

    #[test]
    fn two_squares_lie_their_distance_apart() {
        let (a, b) = (square(1.0, 0.0).sample(20_000, 0).unwrap(), square(1.0, 0.2).sample(20_000, 1).unwrap());
        assert!((chamfer(&a, &b, None).unwrap().mean() - 0.2).abs() < 1e-3);
        assert!(a.iter().all(|p| p[2] == 0.0 && (0.0..=1.0).contains(&p[0])));
        let mean_x = a.iter().map(|p| p[0]).sum::<f64>() / a.len() as f64;
        assert!((mean_x - 0.5).abs() < 0.01, "points lie unevenly: {mean_x}");
        assert_eq!(a, square(1.0, 0.0).sample(20_000, 0).unwrap());
        assert_ne!(a, square(1.0, 0.0).sample(20_000, 1).unwrap());
        // What lies beyond the limit does not count.
        let mut far = b.clone();
        far.push([100.0, 0.0, 0.0]);
        assert!((chamfer(&a, &far, Some(20.0)).unwrap().mean() - 0.2).abs() < 1e-3);
        assert_eq!(chamfer(&a, &b, Some(0.1)).unwrap_err(), CloudError::Far { which: "mesh", limit: 0.1 });
    }

    #[test]
    fn nothing_to_compare_is_refused() {
        assert!(matches!(Mesh::default().sample(5, 0), Err(MeshError::NoSurface)));
        assert!(matches!(square(0.0, 1.0).sample(5, 0), Err(MeshError::NoSurface)));
        assert_eq!(chamfer(&[], &[[0.0; 3]], None).unwrap_err(), CloudError::Empty { which: "mesh" });
        let broken = chamfer(&[[0.0; 3]], &[[0.0; 3], [0.0, f64::NAN, 0.0]], None).unwrap_err();
        assert!(broken.to_string().contains("point 1 of the reference"), "{broken}");
    }
}
