//! Photos: loading, and sampling at warped coordinates.

use crate::scene::jpeg;
use image::{DynamicImage, ImageDecoder, ImageReader};
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// The photo inside the library: "Chelsea", 451 x 300, CC0.
const BUILTIN: &[u8] = include_bytes!("../../../assets/chelsea.png");

/// An RGB picture with values in 0..=1, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    pub height: usize,
    pub width: usize,
    pub rgb: Vec<[f32; 3]>,
}

/// Why a photo could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    #[error("cannot read the image {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{} is not a readable PNG or JPEG image: {source}", .path.display())]
    Decode { path: PathBuf, source: image::ImageError },
    #[error("{}: a damaged JPEG image: {damage}", .path.display())]
    Damaged { path: PathBuf, damage: String },
    #[error(
        "the image {} has {width} x {height} pixels (width x height), fewer than the patches of {} x {}",
        .path.display(), .crop[1], .crop[0]
    )]
    Small { path: PathBuf, width: usize, height: usize, crop: [usize; 2] },
}

impl Photo {
    /// Loads a file, turned as its EXIF data say, or the built-in photo for `builtin`. Transparency is not looked at.
    pub fn load(image: &str) -> Result<Photo, PhotoError> {
        let path = Path::new(image);
        let bytes = match image {
            "builtin" => BUILTIN.to_vec(),
            _ => std::fs::read(path).map_err(|source| PhotoError::Read { path: path.into(), source })?,
        };
        if let Some(damage) = jpeg::damage(&bytes) {
            return Err(PhotoError::Damaged { path: path.into(), damage });
        }
        let decode = |bytes| {
            let mut decoder = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?.into_decoder()?;
            let turn = decoder.orientation()?;
            let mut decoded = DynamicImage::from_decoder(decoder)?;
            decoded.apply_orientation(turn);
            Ok(decoded)
        };
        let decoded: Result<DynamicImage, image::ImageError> = decode(bytes);
        let rgb = decoded.map_err(|source| PhotoError::Decode { path: path.into(), source })?.to_rgb8();
        let (width, height) = (rgb.width() as usize, rgb.height() as usize);
        let rgb = rgb.pixels().map(|p| p.0.map(|byte| f32::from(byte) / 255.0)).collect();
        Ok(Photo { height, width, rgb })
    }

    /// What tells its pixels from others: BLAKE3 in hexadecimal digits.
    pub fn digest(&self) -> String {
        let mut hasher = blake3::Hasher::new();
        for rgb in &self.rgb {
            hasher.update(&rgb.map(|x| (x * 255.0).round() as u8));
        }
        hasher.update(&(self.width as u64).to_le_bytes());
        hasher.finalize().to_hex().to_string()
    }

    /// Refuses a photo that is smaller than the patches (rows, columns) to be cut from it.
    pub fn at_least(self, crop: [usize; 2], image: &str) -> Result<Photo, PhotoError> {
        if self.height < crop[0] || self.width < crop[1] {
            return Err(PhotoError::Small { path: image.into(), width: self.width, height: self.height, crop });
        }
        Ok(self)
    }

    /// Bilinear lookup at (x, y), each side spanning (-1, 1) from edge to edge of the picture; zero outside.
    pub fn sample(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let column = ((x + 1.0) * self.width as f64 - 1.0) / 2.0;
        let row = ((y + 1.0) * self.height as f64 - 1.0) / 2.0;
        let (i, j) = (row.floor(), column.floor());
        let (v, u) = (row - i, column - j);
        let mut sum = [0.0; 3];
        for (di, dj, weight) in
            [(0.0, 0.0, (1.0 - v) * (1.0 - u)), (0.0, 1.0, (1.0 - v) * u), (1.0, 0.0, v * (1.0 - u)), (1.0, 1.0, v * u)]
        {
            if let Some(rgb) = self.pixel(i + di, j + dj) {
                for (s, c) in sum.iter_mut().zip(rgb) {
                    *s += weight * f64::from(c);
                }
            }
        }
        sum
    }

    fn pixel(&self, row: f64, column: f64) -> Option<[f32; 3]> {
        let inside = row >= 0.0 && column >= 0.0 && row < self.height as f64 && column < self.width as f64;
        inside.then(|| self.rgb[row as usize * self.width + column as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_photos_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("photo.jpg");
        let image = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8, y as u8, (x * y) as u8]));
        image.save(&path).unwrap();
        let whole = Photo::load(&path.to_string_lossy()).unwrap();
        assert_eq!((whole.width, whole.height), (64, 48));
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = Photo::load(&path.to_string_lossy()).unwrap_err().to_string();
        assert!(error.contains("photo.jpg: a damaged JPEG image"), "{error}");
    }

    #[test]
    fn the_builtin_photo_loads_and_samples_at_pixel_centres() {
        let p = Photo::load("builtin").unwrap();
        assert_eq!((p.width, p.height), (451, 300));
        let centre = |i: usize, n: usize| (i as f64 + 0.5) / n as f64 * 2.0 - 1.0;
        let found = p.sample([centre(17, 451), centre(200, 300)]);
        let expected = p.rgb[200 * 451 + 17];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - f64::from(b)).abs() < 1e-5));
        assert_eq!(p.sample([3.0, 0.0]), [0.0; 3]);
    }

    #[test]
    fn bad_photos_say_what_is_wrong() {
        let missing = Photo::load("no/such/photo.png").unwrap_err().to_string();
        assert!(missing.contains("no/such/photo.png"), "{missing}");
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("noise.png");
        std::fs::write(&path, b"\x89PNG\r\n\x1a\nnothing").unwrap();
        let corrupt = Photo::load(path.to_str().unwrap()).unwrap_err().to_string();
        assert!(corrupt.contains("not a readable PNG or JPEG"), "{corrupt}");
    }
}
