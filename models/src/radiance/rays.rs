//! Rays of cameras, and where along them samples lie.
//!
//! Pixel (row, column) looks through `X = ((column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1)`; a rough pose `[R | t]` (world
//! to camera) puts that at `R^T (X - t)` and the camera's centre at `-R^T t`. A warp moves both; the ray runs from the
//! moved centre o towards the moved pixel, and its sample at depth z is `o + z d`, `d` not normalised: z is a depth along
//! the optical axis.

use crate::warps::Points;
use raygrad_compiler::functions::matrix::{apply, apply_affine, invert_pose, split_pose};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::{Axis, Tensor};

/// Rows and columns of the images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageSize {
    pub height: usize,
    pub width: usize,
}

impl ImageSize {
    pub fn pixels(self) -> usize {
        self.height * self.width
    }

    /// Numbers of the pixels in the middles of `side` x `side` equal parts, or of all rows or columns where there are fewer.
    pub fn grid(self, side: usize) -> Vec<u32> {
        let middles = |size: usize| {
            let parts = side.min(size);
            (0..parts).map(move |i| (2 * i + 1) * size / (2 * parts))
        };
        middles(self.height).flat_map(|row| middles(self.width).map(move |c| (row * self.width + c) as u32)).collect()
    }
}

/// Pixels and centres of cameras of which rough poses are known.
#[derive(Clone, Debug)]
pub struct Cameras {
    pub pixels: Points,
    pub centers: Points,
}

impl Cameras {
    /// `index`: pixel numbers (row by row) along `point`. `intrinsics`: fx, fy, cx, cy; `pose`: `(3, 4)`, along `frame` where
    /// there are several cameras.
    pub fn new(
        frame: &Axis,
        point: &Axis,
        index: &Tensor,
        size: ImageSize,
        intrinsics: &Tensor,
        pose: &Tensor,
    ) -> Cameras {
        let index = index.to_f32();
        // Half a pixel more keeps the quotient away from whole numbers, where rounding would decide.
        let row = ((&index + 0.5) * (1.0 / size.width as f64)).floor();
        let column = index - &row * size.width as f64;
        let position = concat([&column, &row]) + 0.5;
        let xy = (position - intrinsics.slice(2..4)) / intrinsics.slice(0..2);
        let from_camera = invert_pose(pose);
        let plane = concat([&xy, &Tensor::scalar(1.0)]);
        let (_, center) = split_pose(&from_camera);
        let points =
            |position, first| Points { frame: frame.clone(), point: point.clone(), xy: xy.clone(), position, first };
        Cameras { pixels: points(apply_affine(&from_camera, &plane), 0), centers: points(center, point.size()) }
    }
}

/// Rays: an origin and a direction of three channels each.
#[derive(Clone, Debug)]
pub struct Rays {
    pub origin: Tensor,
    /// Not normalised.
    pub direction: Tensor,
}

impl Rays {
    /// From mapped centres through mapped pixels.
    pub fn through(center: &Tensor, pixel: &Tensor) -> Rays {
        Rays { origin: center.clone(), direction: pixel - center }
    }
    pub fn length(&self) -> Tensor {
        (&self.direction * &self.direction).sum_channels().sqrt()
    }
    pub fn at(&self, depth: &Tensor) -> Tensor {
        &self.origin + depth * &self.direction
    }
}

/// Depth of the near plane of normalised device coordinates.
const NEAR: f64 = 1.0;
/// The farthest that a depth is taken back from normalised device coordinates: so much short of 1.
const FARTHEST: f64 = 1e-6;

/// Normalised device coordinates (Mildenhall et al., NeRF, ECCV 2020, appendix C), here of cameras that look along +z from
/// before the plane z = n = 1: a point (x, y, z) is at `(fx/cx x/z, fy/cy y/z, 1 - 2n/z)`, and what a camera sees from the plane
/// to infinity is a cube. Rays are rays there:
///
/// ```text
/// p = o + (n - o_z) / d_z d     o' = (fx/cx p_x/n, fy/cy p_y/n, -1)
/// d' = (fx/cx (d_x/d_z - p_x/n), fy/cy (d_y/d_z - p_y/n), 2)
/// ```
///
/// with depths from 0 (the plane) to 1 (infinity).
impl Rays {
    /// The same rays in normalised device coordinates of a lens (fx, fy, cx, cy).
    pub fn to_ndc(&self, intrinsics: &Tensor) -> Rays {
        let scale = intrinsics.slice(0..2) / intrinsics.slice(2..4);
        let slope = self.direction.slice(0..2) / self.direction.ch(2);
        let at = (self.origin.slice(0..2) + (NEAR - self.origin.ch(2)) * &slope) * (1.0 / NEAR);
        let origin = concat([&(&scale * &at), &Tensor::scalar(-1.0)]);
        Rays { origin, direction: concat([&(scale * (slope - at)), &Tensor::scalar(2.0)]) }
    }

    /// The depth along these rays of what lies at `depth` along the same rays in normalised device coordinates.
    pub fn depth_of_ndc(&self, depth: &Tensor) -> Tensor {
        let z = NEAR / (1.0 - depth).max(&Tensor::scalar(FARTHEST));
        (z - self.origin.ch(2)) / self.direction.ch(2)
    }
}

/// Depth range of Blender scenes, as parts of the largest distance between two cameras: 2 and 6 of 8.
pub const NEAR_PART: f64 = 0.25;
pub const FAR_PART: f64 = 0.75;

/// Near and far from the spread of cameras with `poses` along `frame`: a quarter and three quarters of the largest distance
/// between two of their centres. Nothing is differentiated through them.
pub fn range_of(poses: &Tensor, frame: &Axis) -> (Tensor, Tensor) {
    let (rotation, translation) = split_pose(poses);
    let center = -apply(&rotation.transpose(), &translation);
    let other = Axis::new("other", frame.size());
    let apart = &center - center.take(&Tensor::index(&other), frame);
    let largest = (&apart * &apart).sum_channels().max_over(&[frame, &other]).sqrt().stop_gradient();
    (&largest * NEAR_PART, largest * FAR_PART)
}
