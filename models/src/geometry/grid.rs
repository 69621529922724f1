//! The planar pixel grid.
//!
//! With m = max(H, W): x(j) = ((j + 0.5) / W * 2 - 1) * W / m and y(i) likewise with H, so both directions have one unit
//! and the longer side spans (-1, 1). Points are (x, y), row by row.

use super::Transform;

/// A picture of `height` x `width` pixels and the patch cut from its middle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    pub height: usize,
    pub width: usize,
    /// Rows and columns of the patch, both even.
    pub crop: [usize; 2],
}

impl Grid {
    fn longer(&self) -> f64 {
        self.height.max(self.width) as f64
    }
    /// First row and column of the patch.
    pub fn crop_start(&self) -> [usize; 2] {
        [self.height / 2 - self.crop[0] / 2, self.width / 2 - self.crop[1] / 2]
    }
    /// Pixels of a patch.
    pub fn crop_pixels(&self) -> usize {
        self.crop[0] * self.crop[1]
    }
    /// Coordinates of a pixel, which may lie between or outside the pixels.
    pub fn point(&self, row: f64, column: f64) -> [f64; 2] {
        let (h, w, m) = (self.height as f64, self.width as f64, self.longer());
        [((column + 0.5) / w * 2.0 - 1.0) * w / m, ((row + 0.5) / h * 2.0 - 1.0) * h / m]
    }
    /// Column and row of a point: the inverse of [`Grid::point`].
    pub fn pixel(&self, p: [f64; 2]) -> [f64; 2] {
        let (h, w, m) = (self.height as f64, self.width as f64, self.longer());
        [(p[0] * m / w + 1.0) / 2.0 * w - 0.5, (p[1] * m / h + 1.0) / 2.0 * h - 0.5]
    }
    /// The point in coordinates that span (-1, 1) in both directions, as image lookups take them.
    pub fn lookup(&self, p: [f64; 2]) -> [f64; 2] {
        let m = self.longer();
        [p[0] * m / self.width as f64, p[1] * m / self.height as f64]
    }
    /// All points of the picture, row by row.
    pub fn points(&self) -> Vec<[f64; 2]> {
        self.points_of([0, 0], [self.height, self.width])
    }
    /// All points of the patch, row by row.
    pub fn crop_points(&self) -> Vec<[f64; 2]> {
        self.points_of(self.crop_start(), self.crop)
    }
    fn points_of(&self, start: [usize; 2], size: [usize; 2]) -> Vec<[f64; 2]> {
        let pixel = |i: usize| self.point((start[0] + i / size[1]) as f64, (start[1] + i % size[1]) as f64);
        (0..size[0] * size[1]).map(pixel).collect()
    }
    /// Corners of the patch, (x0, y0), (x0, y1), (x1, y1), (x1, y0), the far ones one past the last pixel.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let [y0, x0] = self.crop_start().map(|n| n as f64);
        let [y1, x1] = [y0 + self.crop[0] as f64, x0 + self.crop[1] as f64];
        [self.point(y0, x0), self.point(y1, x0), self.point(y1, x1), self.point(y0, x1)]
    }
    /// Pixel coordinates (column, row) of the warped corners.
    pub fn warped_corners(&self, warp: &Transform) -> [[f64; 2]; 4] {
        self.corners().map(|c| self.pixel(warp.apply(c)))
    }
    /// Mean distance in pixels between the corners under two transforms.
    pub fn corner_error(&self, a: &Transform, b: &Transform) -> f64 {
        let (a, b) = (self.warped_corners(a), self.warped_corners(b));
        a.iter().zip(&b).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).sum::<f64>() / 4.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAT: Grid = Grid { height: 360, width: 480, crop: [180, 180] };

    #[test]
    fn pixel_and_point_are_inverse_and_the_crop_is_the_papers() {
        let [x, y] = CAT.pixel(CAT.point(17.25, 301.5));
        assert!((x - 301.5).abs() < 1e-9 && (y - 17.25).abs() < 1e-9);
        assert_eq!(CAT.crop_start(), [90, 150]);
        let girl = Grid { height: 595, width: 512, crop: [260, 260] };
        assert_eq!(girl.crop_start(), [167, 126]);
        assert_eq!(CAT.crop_points()[0], CAT.point(90.0, 150.0));
    }

    /// The check at the end of section 5.5 of the method's specification.
    #[test]
    fn corners_under_a_composed_perturbation() {
        let h = Transform::sl3(&[0.05, -0.02, 0.1, 0.03, 0.04, -0.06, 0.2, -0.1]);
        let warp = Transform::translation([0.05, -0.1]) * Transform::rotation(0.3) * h;
        let expected = [[187.7064, 21.8988], [138.5957, 226.9230], [336.1006, 277.6415], [365.9316, 98.1656]];
        for (found, expected) in CAT.warped_corners(&warp).iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-4, "{found} instead of {expected}");
        }
        assert!((CAT.corner_error(&warp, &Transform::identity()) - 42.2575).abs() < 1e-4);
    }
}
