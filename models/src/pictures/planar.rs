//! The pictures of planar registration.

use super::canvas::{Canvas, patch_color};
use crate::geometry::{Grid, Transform};

/// Width of frames around patches and of the estimated outlines, as in the papers' figures.
const BORDER: usize = 3;
/// Space between tiles.
const GAP: usize = 6;
const PAPER: [u8; 3] = [255; 3];

/// A raster of `width` x `height` pixels over the whole of a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct View {
    pub grid: Grid,
    pub width: usize,
    pub height: usize,
}

impl View {
    /// The grid's own pixels.
    pub fn full(grid: Grid) -> View {
        View { grid, width: grid.width, height: grid.height }
    }
    /// The grid reduced so that no side has more than `longest` pixels.
    pub fn within(grid: Grid, longest: usize) -> View {
        let scale = (longest as f64 / grid.width.max(grid.height) as f64).min(1.0);
        let side = |n: usize| ((n as f64 * scale).round() as usize).max(1);
        View { grid, width: side(grid.width), height: side(grid.height) }
    }
    /// Field points at the centres of the pixels, row by row, two numbers a pixel.
    pub fn points(&self) -> Vec<f32> {
        let (v, h) = (self.grid.height as f64 / self.height as f64, self.grid.width as f64 / self.width as f64);
        let point = |i: usize| {
            let (row, column) = ((i / self.width) as f64, (i % self.width) as f64);
            self.grid.point((row + 0.5) * v - 0.5, (column + 0.5) * h - 0.5).map(|x| x as f32)
        };
        (0..self.width * self.height).flat_map(point).collect()
    }
    fn corners(&self, warp: &Transform) -> [[f64; 2]; 4] {
        let (h, v) = (self.width as f64 / self.grid.width as f64, self.height as f64 / self.grid.height as f64);
        self.grid.warped_corners(warp).map(|[x, y]| [(x + 0.5) * h - 0.5, (y + 0.5) * v - 0.5])
    }
}

/// The learned picture (three colours a pixel of the view) with the patches where they were found, thick, and where they
/// belong, thin and lighter.
pub fn outlined(view: &View, rgb: &[f32], estimated: &[Transform], truth: &[Transform]) -> Canvas {
    let mut canvas = Canvas::from_colors(view.width, view.height, rgb);
    for (patch, warp) in estimated.iter().enumerate() {
        canvas.outline(&view.corners(warp), BORDER as f64, patch_color(patch));
    }
    for (patch, warp) in truth.iter().enumerate() {
        let light = patch_color(patch).map(|c| c / 2 + 127);
        canvas.outline(&view.corners(warp), 1.0, light);
    }
    canvas
}

/// All patches side by side in frames of their colours; `rgb` holds them one after the other.
pub fn patch_row(grid: &Grid, rgb: &[f32]) -> Canvas {
    let [rows, columns] = grid.crop;
    let patches = rgb.chunks(3 * rows * columns).enumerate();
    let framed = patches.map(|(i, p)| Canvas::from_colors(columns, rows, p).framed(BORDER, patch_color(i)));
    tile(&[framed.collect()])
}

/// Field points as colours, red (x + 1) / 2 and green (y + 1) / 2; `xy` holds two numbers a pixel, patch by patch.
pub fn warp_field(grid: &Grid, xy: &[f32]) -> Canvas {
    let rgb: Vec<f32> =
        xy.as_chunks::<2>().0.iter().flat_map(|[x, y]| [(x + 1.0) / 2.0, (y + 1.0) / 2.0, 0.0]).collect();
    patch_row(grid, &rgb)
}

/// Rows of pictures on white.
pub fn tile(rows: &[Vec<Canvas>]) -> Canvas {
    let row_width = |row: &Vec<Canvas>| row.iter().map(|c| c.width() + GAP).sum::<usize>().saturating_sub(GAP);
    let row_height = |row: &Vec<Canvas>| row.iter().map(Canvas::height).max().unwrap_or(0);
    let width = rows.iter().map(row_width).max().unwrap_or(0).max(1);
    let height = rows.iter().map(|r| row_height(r) + GAP).sum::<usize>().saturating_sub(GAP).max(1);
    let mut out = Canvas::new(width, height, PAPER);
    let mut y = 0;
    for row in rows {
        let mut x = 0;
        for canvas in row {
            out.paste(canvas, x, y);
            x += canvas.width() + GAP;
        }
        y += row_height(row) + GAP;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_view_has_the_points_of_the_grid() {
        let grid = Grid { height: 12, width: 16, crop: [4, 6] };
        let expected: Vec<f32> = grid.points().concat().iter().map(|x| *x as f32).collect();
        let found = View::full(grid).points();
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6));
        let small = View::within(grid, 8);
        assert_eq!((small.width, small.height, small.points().len()), (8, 6, 96));
        let row = patch_row(&grid, &[0.5; 2 * 24 * 3]);
        assert_eq!((row.width(), row.height()), (2 * 12 + GAP, 10));
    }
}
