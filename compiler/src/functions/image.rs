//! Bilinear lookup in an image, zero outside.
//!
//! Pixel (column, row) has its centre at integer coordinates, so `x` runs from 0 to `width - 1`. A corner of the
//! interpolation cell outside the image counts as 0.

use super::expect_width;
use crate::graph::{Axis, Tensor, function};

/// An image as a table: pixel (column, row) at position `row * width + column` of the axis `texel`.
#[derive(Clone, Debug)]
pub struct ImageTable {
    pub pixels: Tensor,
    pub texel: Axis,
    pub width: usize,
    pub height: usize,
}

impl ImageTable {
    /// The image at `at`: two channels, x (columns) and y (rows), in pixels. Differentiable in the coordinates, and in
    /// the pixels if they are trained.
    #[track_caller]
    pub fn bilinear(&self, at: &Tensor) -> Tensor {
        let called = function("bilinear");
        if let Err(bad) = expect_width(&called, "coordinates", at, 2) {
            return bad;
        }
        if self.texel.size() != self.width * self.height || !self.pixels.axes().contains(&self.texel) {
            let problem = format!("{} is no table of {} x {} pixels", self.pixels.shape(), self.width, self.height);
            let hint = format!("the axis `{}` has one element a pixel", self.texel.name());
            return called.misfit(&[&self.pixels], problem, hint);
        }
        let low = at.floor();
        let high = &low + 1.0;
        let far = at - &low;
        let near = 1.0 - &far;
        let mut sum: Option<Tensor> = None;
        for (x, x_share) in [(low.ch(0), near.ch(0)), (high.ch(0), far.ch(0))] {
            for (y, y_share) in [(low.ch(1), near.ch(1)), (high.ch(1), far.ch(1))] {
                let part = self.pixel(&x, &y) * (&x_share * y_share);
                sum = Some(match sum {
                    Some(sum) => sum + part,
                    None => part,
                });
            }
        }
        sum.unwrap_or_else(|| self.pixels.clone())
    }

    /// The pixel at whole coordinates, 0 outside.
    #[track_caller]
    fn pixel(&self, x: &Tensor, y: &Tensor) -> Tensor {
        let (right, bottom) = (self.width as f64 - 1.0, self.height as f64 - 1.0);
        let (column, row) = (x.clamp(0.0, right), y.clamp(0.0, bottom));
        let inside = column.equal(x).bit_and(&row.equal(y));
        let index = row.to_u32().wrapping_mul(&Tensor::integers(&[self.width as u32])).wrapping_add(&column.to_u32());
        inside.select(&self.pixels.take(&index, &self.texel), &Tensor::scalar(0.0))
    }
}

/// Pixel coordinates of points in isotropic coordinates, where the longer side of the image spans -1 to 1:
/// `((g + 1) size - 1) / 2` with `g_x = x m / width`, `g_y = y m / height`, `m` the longer side. Pixel centres of the
/// normalised grid fall on whole numbers.
#[track_caller]
pub fn isotropic_to_pixels(points: &Tensor, width: usize, height: usize) -> Tensor {
    let _called = function("isotropic_to_pixels");
    let half = width.max(height) as f64 / 2.0;
    points * half + Tensor::constant(&[(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0])
}
