//! An RGB picture to draw antialiased lines on.

use super::PictureError;
use image::{ExtendedColorType, ImageEncoder, Rgb, RgbImage, codecs::png::PngEncoder};

/// Colours that tell patches apart: those of the papers' figures.
pub const PATCH_COLORS: [[u8; 3]; 5] =
    [[0xff, 0x00, 0x00], [0x40, 0xaf, 0xff], [0x93, 0x14, 0xff], [0xff, 0xd7, 0x00], [0x00, 0xff, 0x00]];

/// Colour of the nth patch; they repeat after five.
pub fn patch_color(patch: usize) -> [u8; 3] {
    PATCH_COLORS[patch % PATCH_COLORS.len()]
}

#[derive(Clone, Debug, PartialEq)]
pub struct Canvas(pub RgbImage);

impl Canvas {
    pub fn new(width: usize, height: usize, color: [u8; 3]) -> Canvas {
        Canvas(RgbImage::from_pixel(width as u32, height as u32, Rgb(color)))
    }

    /// From colours in 0..=1, row by row, three a pixel. Bytes are truncated, as the papers' pictures are.
    pub fn from_colors(width: usize, height: usize, rgb: &[f32]) -> Canvas {
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0) as u8;
        let mut canvas = Canvas::new(width, height, [0; 3]);
        for (pixel, rgb) in canvas.0.pixels_mut().zip(rgb.as_chunks::<3>().0) {
            *pixel = Rgb(rgb.map(byte));
        }
        canvas
    }

    pub fn width(&self) -> usize {
        self.0.width() as usize
    }
    pub fn height(&self) -> usize {
        self.0.height() as usize
    }

    /// Copies `other` so that its first pixel comes to (x, y); what does not fit is cut off.
    pub fn paste(&mut self, other: &Canvas, x: usize, y: usize) {
        image::imageops::replace(&mut self.0, &other.0, x as i64, y as i64);
    }

    /// The picture within a frame `border` pixels wide.
    pub fn framed(&self, border: usize, color: [u8; 3]) -> Canvas {
        let mut out = Canvas::new(self.width() + 2 * border, self.height() + 2 * border, color);
        out.paste(self, border, border);
        out
    }

    /// A straight line between pixel coordinates (column, row), with centres at whole numbers. Ends that are not finite
    /// are left out; parts outside the picture are cut off.
    pub fn line(&mut self, a: [f64; 2], b: [f64; 2], width: f64, color: [u8; 3]) {
        if !a.iter().chain(&b).all(|v| v.is_finite()) {
            return;
        }
        let reach = width / 2.0 + 1.0;
        let span = |axis: usize, size: usize| {
            let (low, high) = (a[axis].min(b[axis]) - reach, a[axis].max(b[axis]) + reach);
            low.max(0.0) as u32..(high + 1.0).clamp(0.0, size as f64) as u32
        };
        let (d, columns) = ([b[0] - a[0], b[1] - a[1]], span(0, self.width()));
        let squared = (d[0] * d[0] + d[1] * d[1]).max(1e-12);
        for row in span(1, self.height()) {
            for column in columns.clone() {
                let p = [f64::from(column) - a[0], f64::from(row) - a[1]];
                let t = ((p[0] * d[0] + p[1] * d[1]) / squared).clamp(0.0, 1.0);
                let distance = (p[0] - t * d[0]).hypot(p[1] - t * d[1]);
                self.blend(column, row, color, (width / 2.0 + 0.5 - distance).clamp(0.0, 1.0));
            }
        }
    }

    /// A closed line through `corners`.
    pub fn outline(&mut self, corners: &[[f64; 2]], width: f64, color: [u8; 3]) {
        for (i, a) in corners.iter().enumerate() {
            self.line(*a, corners[(i + 1) % corners.len()], width, color);
        }
    }

    fn blend(&mut self, column: u32, row: u32, color: [u8; 3], share: f64) {
        let pixel = self.0.get_pixel_mut(column, row);
        for (old, new) in pixel.0.iter_mut().zip(color) {
            *old = (f64::from(*old) * (1.0 - share) + f64::from(new) * share).round() as u8;
        }
    }

    pub fn to_png(&self) -> Result<Vec<u8>, PictureError> {
        let mut bytes = vec![];
        let encoder = PngEncoder::new(&mut bytes);
        encoder
            .write_image(self.0.as_raw(), self.0.width(), self.0.height(), ExtendedColorType::Rgb8)
            .map_err(|e| PictureError(e.to_string()))?;
        Ok(bytes)
    }

    pub fn from_png(bytes: &[u8]) -> Result<Canvas, PictureError> {
        let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png);
        image.map(|i| Canvas(i.to_rgb8())).map_err(|e| PictureError(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_stay_inside_and_survive_nonsense() {
        let mut c = Canvas::new(8, 6, [0; 3]);
        c.outline(&[[-50.0, 2.0], [1e12, 2.0], [f64::NAN, 0.0], [3.0, f64::INFINITY]], 1.0, [255, 0, 0]);
        assert_eq!(c.0.get_pixel(4, 2).0, [255, 0, 0]);
        assert_eq!(c.0.get_pixel(4, 5).0, [0, 0, 0]);
        assert_eq!(Canvas::from_png(&c.to_png().unwrap()).unwrap(), c);
    }
}
