//! A shear of the learned world against a turn of all cameras.
//!
//! Cameras that look along +z from near the plane z = 0 hardly tell two worlds apart: one, and the same with every slice z
//! shifted in proportion to z, seen by cameras that have all turned after it about their own centres. What lies on a camera's
//! axis stays there; elsewhere pixels move by the second order of their distance from it. A descent that moves cameras and
//! field apart goes along such a valley only as fast as the field is learned anew. With the two numbers of a shear (a, b) as
//! trained parameters it goes there at once:
//!
//! ```text
//! field point = (x + a z, y + b z, z)     every camera turns about its centre so that (0, 0, 1) becomes (-a, -b, 1) / n
//! ```
//!
//! with n = sqrt(1 + a^2 + b^2). Poses are those of the turned cameras, in the world before the shear. The numbers learn at the
//! warp's rate.

use super::rays::Rays;
use raygrad_compiler::functions::matrix::{apply, invert_pose, join_affine, matmul, split_pose};
use raygrad_compiler::functions::mlp::{Init, Parameter};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Shape, Tensor};

/// The parameter, `[] x 2`.
pub const SHEAR: &str = "world.shear";

/// What is trained of the shear.
#[derive(Clone, Debug)]
pub struct Shear {
    pub parameter: Option<Parameter>,
}

impl Shear {
    pub fn new(trained: bool) -> Shear {
        Shear { parameter: trained.then(|| Parameter::new(SHEAR, Shape::new(&[], 2), Init::Zero)) }
    }

    /// Points of the world as the field has them.
    pub fn of_field(&self, points: &Tensor) -> Tensor {
        let Some(Parameter { tensor: shear, .. }) = &self.parameter else { return points.clone() };
        let z = points.ch(2);
        concat([&(points.slice(0..2) + &z * shear), &z])
    }

    /// Rays of cameras that have turned.
    pub fn turned(&self, rays: Rays) -> Rays {
        match self.turn() {
            Some(turn) => Rays { direction: apply(&turn, &rays.direction), ..rays },
            None => rays,
        }
    }

    /// `found`, poses `(3, 4)` after which the `rough` ones make whole poses, of cameras that have turned.
    pub fn turned_pose(&self, found: &Tensor, rough: &Tensor) -> Tensor {
        let Some(turn) = self.turn() else { return found.clone() };
        let ((rotation, translation), (_, start)) = (split_pose(found), split_pose(&invert_pose(rough)));
        let center = apply(&rotation.transpose(), &(&start - translation));
        let rotation = matmul(&rotation, &turn.transpose());
        join_affine(&rotation, &(start - apply(&rotation, &center)))
    }

    /// The smallest rotation that makes (0, 0, 1) what it shall be: I + V + V^2 / (1 + 1/n), with V the cross product with
    /// (b, -a, 0) / n.
    fn turn(&self) -> Option<Tensor> {
        let shear = &self.parameter.as_ref()?.tensor;
        let cos = 1.0 / ((shear * shear).sum_channels() + 1.0).sqrt();
        let axis = shear * &cos;
        let (a, b) = (axis.ch(0), axis.ch(1));
        let share = 1.0 / (&cos + 1.0);
        let (aa, ab, bb) = (1.0 - &share * &a * &a, -share.clone() * &a * &b, 1.0 - &share * &b * &b);
        Some(concat([&aa, &ab, &-&a, &ab, &bb, &-&b, &a, &b, &cos]).reshape((3, 3)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::radiance::rays::{Cameras, ImageSize};
    use raygrad_compiler::Axis;
    use raygrad_compiler::functions::lie::se3_exp;
    use raygrad_compiler::functions::matrix::compose_poses;
    use raygrad_compiler::reference::{Array, Bindings, evaluate};

    const SIZE: ImageSize = ImageSize { height: 3, width: 5 };

    fn camera(pose: &Tensor) -> Rays {
        let (frame, point) = (Axis::new("frame", 1), Axis::new("point", 15));
        let lens = Tensor::constant(&[6.0, 5.0, 2.5, 1.5]);
        let cameras = Cameras::new(&frame, &point, &Tensor::index(&point), SIZE, &lens, pose);
        Rays::through(&cameras.centers.position, &cameras.pixels.position)
    }

    fn values(shear: &Shear, what: &[Tensor]) -> Vec<Vec<f64>> {
        let shape = shear.parameter.as_ref().unwrap().tensor.shape().clone();
        let bound: Bindings = [(SHEAR.to_string(), Array::floats(&shape, vec![0.2, -0.1]))].into_iter().collect();
        evaluate(what, &bound).unwrap().iter().map(|a| a.f().to_vec()).collect()
    }

    fn apart(a: &[f64], b: &[f64]) -> f64 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// The turned rays are those of the turned poses, wherever cameras start.
    #[test]
    fn poses_turn_with_their_rays() {
        let shear = Shear::new(true);
        let found = se3_exp(&Tensor::constant(&[0.1, -0.3, 0.2, 0.5, -0.6, 0.7]));
        for start in [[0.0; 6], [0.4, 0.1, -0.2, -1.0, 2.0, 0.3]] {
            let rough = se3_exp(&Tensor::constant(&start));
            let rays = shear.turned(camera(&compose_poses(&rough, &found)));
            let posed = camera(&compose_poses(&rough, &shear.turned_pose(&found, &rough)));
            let still = camera(&compose_poses(&rough, &found));
            let all = values(&shear, &[rays.origin, posed.origin, rays.direction, posed.direction, still.direction]);
            let [origin, expected_origin, direction, expected, before] = &all[..] else { panic!("five values") };
            assert!(apart(origin, expected_origin) < 1e-12 && apart(direction, expected) < 1e-12);
            assert!(apart(direction, before) > 0.1, "nothing turned");
        }
    }

    /// In the field's world the axis of a camera in the plane z = 0 stays where it was; rays off it move by less, the less the
    /// nearer they are.
    #[test]
    fn what_cameras_see_hardly_moves() {
        let shear = Shear::new(true);
        let rays = camera(&se3_exp(&Tensor::constant(&[0.0, 0.0, 0.0, 1.0, -2.0, 0.0])));
        let turned = shear.turned(rays.clone());
        let slope = |d: &Tensor| d.slice(0..2) / d.ch(2);
        let (before, after) = (slope(&rays.direction), slope(&shear.of_field(&turned.direction)));
        let all = values(&shear, &[before, after, rays.origin.clone(), shear.of_field(&rays.origin)]);
        assert!(apart(&all[2], &all[3]) < 1e-12, "centres stay");
        let moved: Vec<f64> = all[0].chunks(2).zip(all[1].chunks(2)).map(|(a, b)| apart(a, b)).collect();
        assert!(moved[7] < 1e-12, "the middle stays: {moved:?}");
        // One pixel off the axis is 1/6, two are 1/3.
        assert!(moved[8] < 0.2 / 36.0 + 0.01 && moved[9] < 4.0 * moved[8] && moved[9] > moved[8], "{moved:?}");
    }
}
