//! How near a rendered picture or depth map is to the true one.
//!
//! PSNR is `-10 log10 MSE` on float pictures, without clamping or rounding. SSIM (Wang et al. 2004) takes an 11 x 11
//! Gaussian window of deviation 1.5 with zeros outside the picture, per channel, and averages over all pixels, borders
//! included; so it is defined for every size, and differs near borders from libraries that crop or mirror. LPIPS has a
//! file of its own.

use rayon::prelude::*;

/// Pictures or depth maps that cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ImageError {
    #[error("{what} has {found} values, not the {expected} of {width} x {height} pixels (width x height)")]
    Length { what: &'static str, width: usize, height: usize, expected: usize, found: usize },
    #[error(
        "the pictures have {} x {} and {} x {} pixels (width x height); they must be of one size",
        .a[0], .a[1], .b[0], .b[1]
    )]
    Sizes { a: [usize; 2], b: [usize; 2] },
    #[error("{what} has no pixels")]
    Empty { what: &'static str },
    #[error("{what} is not finite at row {row}, column {column}")]
    NotFinite { what: &'static str, row: usize, column: usize },
    #[error(
        "a picture of {width} x {height} pixels (width x height) is too small for LPIPS, which needs {least} x {least}"
    )]
    Small { width: usize, height: usize, least: usize },
    #[error("no pixel of the depth map is valid")]
    NoDepth,
}

/// A picture with values in 0..=1, row by row, three a pixel: finite and not empty.
#[derive(Clone, Copy, Debug)]
pub struct Picture<'a> {
    width: usize,
    height: usize,
    rgb: &'a [f32],
}

impl<'a> Picture<'a> {
    /// # Errors
    /// If `rgb` is empty, does not have three values a pixel, or holds something that is not finite.
    pub fn new(width: usize, height: usize, rgb: &'a [f32]) -> Result<Picture<'a>, ImageError> {
        let (what, expected) = ("the picture", 3 * width * height);
        if rgb.len() != expected {
            return Err(ImageError::Length { what, width, height, expected, found: rgb.len() });
        }
        if expected == 0 {
            return Err(ImageError::Empty { what });
        }
        match rgb.iter().position(|x| !x.is_finite()) {
            Some(i) => Err(ImageError::NotFinite { what, row: i / 3 / width, column: i / 3 % width }),
            None => Ok(Picture { width, height, rgb }),
        }
    }

    pub fn width(&self) -> usize {
        self.width
    }
    pub fn height(&self) -> usize {
        self.height
    }
    /// Values row by row, three a pixel.
    pub fn rgb(&self) -> &'a [f32] {
        self.rgb
    }

    /// One channel, row by row.
    pub(super) fn channel(&self, channel: usize) -> Vec<f64> {
        self.rgb.iter().skip(channel).step_by(3).map(|x| f64::from(*x)).collect()
    }

    /// The picture where `mask` is one, white where it is zero; the values of a masked metric, which is taken over the
    /// full frame of two pictures treated so. One mask value a pixel.
    ///
    /// # Errors
    /// If the mask has another number of pixels.
    pub fn on_white(&self, mask: &[f32]) -> Result<Vec<f32>, ImageError> {
        let (width, height, expected) = (self.width, self.height, self.width * self.height);
        if mask.len() != expected {
            return Err(ImageError::Length { what: "the mask", width, height, expected, found: mask.len() });
        }
        Ok(self.rgb.iter().enumerate().map(|(i, x)| x * mask[i / 3] + (1.0 - mask[i / 3])).collect())
    }
}

pub(super) fn same_size(a: &Picture, b: &Picture) -> Result<(), ImageError> {
    let (a, b) = ([a.width, a.height], [b.width, b.height]);
    if a == b { Ok(()) } else { Err(ImageError::Sizes { a, b }) }
}

/// Mean squared error over pixels and channels.
///
/// # Errors
/// If the pictures differ in size.
pub fn mse(a: &Picture, b: &Picture) -> Result<f64, ImageError> {
    same_size(a, b)?;
    let squares = a.rgb.iter().zip(b.rgb).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
    Ok(squares.sum::<f64>() / a.rgb.len() as f64)
}

/// Peak signal-to-noise ratio in dB; infinite for equal pictures.
///
/// # Errors
/// If the pictures differ in size.
pub fn psnr(a: &Picture, b: &Picture) -> Result<f64, ImageError> {
    Ok(-10.0 * mse(a, b)?.log10())
}

const WINDOW: usize = 11;
const DEVIATION: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Structural similarity, one for equal pictures.
///
/// # Errors
/// If the pictures differ in size.
pub fn ssim(a: &Picture, b: &Picture) -> Result<f64, ImageError> {
    same_size(a, b)?;
    let kernel = gaussian();
    let (w, h) = (a.width, a.height);
    let sums: Vec<f64> = (0..3usize)
        .into_par_iter()
        .map(|channel| {
            let (x, y) = (a.channel(channel), b.channel(channel));
            let mean = |f: &dyn Fn(usize) -> f64| blurred(&(0..w * h).map(f).collect::<Vec<f64>>(), w, h, &kernel);
            let (mx, my) = (mean(&|i| x[i]), mean(&|i| y[i]));
            let (xx, yy, xy) = (mean(&|i| x[i] * x[i]), mean(&|i| y[i] * y[i]), mean(&|i| x[i] * y[i]));
            let of_pixel = |i: usize| {
                let (mean_squares, mean_product) = (mx[i] * mx[i] + my[i] * my[i], mx[i] * my[i]);
                let (variances, covariance) = (xx[i] + yy[i] - mean_squares, xy[i] - mean_product);
                (2.0 * mean_product + C1) * (2.0 * covariance + C2) / ((mean_squares + C1) * (variances + C2))
            };
            (0..w * h).map(of_pixel).sum()
        })
        .collect();
    Ok(sums.iter().sum::<f64>() / (3 * w * h) as f64)
}

fn gaussian() -> [f64; WINDOW] {
    let weight = |i: usize| {
        let x = i as f64 - (WINDOW / 2) as f64;
        (-x * x / (2.0 * DEVIATION * DEVIATION)).exp()
    };
    let sum: f64 = (0..WINDOW).map(weight).sum();
    std::array::from_fn(|i| weight(i) / sum)
}

/// Convolution with the window, along rows and then along columns, with zeros outside.
fn blurred(x: &[f64], width: usize, height: usize, kernel: &[f64; WINDOW]) -> Vec<f64> {
    let half = WINDOW / 2;
    let along = |x: &[f64], position: &dyn Fn(usize) -> usize, length: usize, stride: usize| -> Vec<f64> {
        let at = |i: usize| {
            let (p, base) = (position(i), i - position(i) * stride);
            let inside = p.saturating_sub(half)..(p + half + 1).min(length);
            inside.map(|q| kernel[q + half - p] * x[base + q * stride]).sum()
        };
        (0..x.len()).map(at).collect()
    };
    let rows = along(x, &|i| i % width, width, 1);
    along(&rows, &|i| i / width, height, width)
}

/// Errors of a depth map, in the unit of the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthErrors {
    /// Mean absolute difference.
    pub abs: f64,
    /// Root mean square difference.
    pub rms: f64,
}

/// Compares `scale` times a rendered depth map with the true one where `valid` is true, pixel by pixel.
///
/// `scale` is that of the alignment ([`Similarity::scale`](super::Similarity)). As in INN's code the absolute
/// differences are divided by the number of valid pixels plus 1e-6.
///
/// # Errors
/// If the three lists differ in length, no pixel is valid, or a valid depth is not finite (`row` is zero then and
/// `column` the index in the list).
pub fn depth_errors(depth: &[f32], truth: &[f32], valid: &[bool], scale: f64) -> Result<DepthErrors, ImageError> {
    for (what, found) in [("the true depth map", truth.len()), ("the mask of valid depths", valid.len())] {
        if found != depth.len() {
            let (width, height) = (depth.len(), 1);
            return Err(ImageError::Length { what, width, height, expected: depth.len(), found });
        }
    }
    let (mut n, mut sum, mut squares) = (0usize, 0.0, 0.0);
    for i in (0..depth.len()).filter(|i| valid[*i]) {
        let off = f64::from(truth[i]) - scale * f64::from(depth[i]);
        if !off.is_finite() {
            return Err(ImageError::NotFinite { what: "a valid depth", row: 0, column: i });
        }
        (n, sum, squares) = (n + 1, sum + off.abs(), squares + off * off);
    }
    if n == 0 {
        return Err(ImageError::NoDepth);
    }
    Ok(DepthErrors { abs: sum / (n as f64 + 1e-6), rms: (squares / n as f64).sqrt() })
}

/// What INN's program returns: of each error the smaller with and without the scale.
///
/// # Errors
/// As [`depth_errors`].
pub fn released_depth_errors(
    depth: &[f32],
    truth: &[f32],
    valid: &[bool],
    scale: f64,
) -> Result<DepthErrors, ImageError> {
    let (a, b) = (depth_errors(depth, truth, valid, scale)?, depth_errors(depth, truth, valid, 1.0)?);
    Ok(DepthErrors { abs: a.abs.min(b.abs), rms: a.rms.min(b.rms) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: usize, height: usize, f: impl Fn(usize, usize) -> f64) -> Vec<f32> {
        (0..width * height).flat_map(|i| [f(i / width, i % width) as f32; 3]).collect()
    }

    /// The check of section 8.4 of the method's specification.
    #[test]
    fn psnr_and_ssim_of_the_specification() {
        let first = |i: usize, j: usize| (i + j) as f64 / 30.0;
        let a = grey(16, 16, first);
        let b = grey(16, 16, |i, j| 0.9 * first(i, j) + 0.05 + 0.02 * (((7 * i + 3 * j) % 5) as f64 - 2.0));
        let (a, b) = (Picture::new(16, 16, &a).unwrap(), Picture::new(16, 16, &b).unwrap());
        assert!((ssim(&a, &b).unwrap() - 0.956_705_3).abs() < 1e-6);
        assert!((psnr(&a, &b).unwrap() - 28.943_716).abs() < 1e-4);
        assert!((ssim(&a, &a).unwrap() - 1.0).abs() < 1e-12);
        assert_eq!(psnr(&a, &a).unwrap(), f64::INFINITY);
    }

    /// Numbers of scikit-image 0.26 on the same pictures within ten pixels of zeros: `structural_similarity` with
    /// `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, full=True`, its map cut back to
    /// the picture, and `peak_signal_noise_ratio`.
    #[test]
    fn psnr_and_ssim_of_scikit_image() {
        for (w, h, similarity, ratio) in [
            (24, 20, 0.994_807_772_069_673_2, 30.127_952_569_496_948),
            (13, 7, 0.995_820_139_644_953_3, 30.150_988_395_215_81),
        ] {
            let places = (0..3 * w * h).map(|n| (n / 3 / w, n / 3 % w, n % 3));
            let first = |i: usize, j: usize, c: usize| ((5 * i + 3 * j + 7 * c) % 32) as f32 / 32.0;
            let a: Vec<f32> = places.clone().map(|(i, j, c)| first(i, j, c)).collect();
            let shifted = places.map(|(i, j, c)| first(i, j, c) + (((i * j + c) % 7) as f32 - 3.0) / 64.0);
            let b: Vec<f32> = shifted.map(|x| x.clamp(0.0, 1.0)).collect();
            let (a, b) = (Picture::new(w, h, &a).unwrap(), Picture::new(w, h, &b).unwrap());
            assert!((ssim(&a, &b).unwrap() - similarity).abs() < 1e-12, "{}", ssim(&a, &b).unwrap());
            assert!((psnr(&a, &b).unwrap() - ratio).abs() < 1e-10);
        }
    }

    #[test]
    fn pictures_smaller_than_the_window_have_a_similarity() {
        let (a, b) = (grey(3, 1, |_, j| j as f64 / 4.0), grey(3, 1, |_, j| 0.5 - j as f64 / 4.0));
        let (a, b) = (Picture::new(3, 1, &a).unwrap(), Picture::new(3, 1, &b).unwrap());
        assert!((ssim(&a, &a).unwrap() - 1.0).abs() < 1e-12);
        assert!(ssim(&a, &b).unwrap() < 0.9);
    }

    #[test]
    fn masks_put_pictures_on_white() {
        let (a, b) = ([0.2f32; 6], [0.2, 0.2, 0.2, 0.9, 0.1, 0.4]);
        let (pa, pb) = (Picture::new(2, 1, &a).unwrap(), Picture::new(2, 1, &b).unwrap());
        let (a, b) = (pa.on_white(&[1.0, 0.0]).unwrap(), pb.on_white(&[1.0, 0.0]).unwrap());
        assert_eq!(a, [0.2, 0.2, 0.2, 1.0, 1.0, 1.0]);
        assert_eq!(a, b);
        assert!(pa.on_white(&[1.0]).unwrap_err().to_string().contains("the mask has 1 values"));
    }

    #[test]
    fn pictures_that_cannot_be_compared_are_refused() {
        let a = [0.5f32; 12];
        let (wide, tall) = (Picture::new(4, 1, &a).unwrap(), Picture::new(1, 4, &a).unwrap());
        for refused in [mse(&wide, &tall), psnr(&wide, &tall), ssim(&wide, &tall)] {
            assert_eq!(refused.unwrap_err(), ImageError::Sizes { a: [4, 1], b: [1, 4] });
        }
        assert!(matches!(Picture::new(2, 2, &a[..9]), Err(ImageError::Length { expected: 12, found: 9, .. })));
        assert!(matches!(Picture::new(0, 3, &[]), Err(ImageError::Empty { .. })));
        let mut broken = a;
        broken[7] = f32::NAN;
        assert!(matches!(Picture::new(2, 2, &broken), Err(ImageError::NotFinite { row: 1, column: 0, .. })));
    }

    #[test]
    fn depth_errors_take_the_scale_and_the_valid_pixels() {
        let errors = depth_errors(&[1.0, 2.0, 7.0], &[2.0, 5.0, f32::NAN], &[true, true, false], 2.0).unwrap();
        assert!((errors.abs - 0.5).abs() < 1e-6 && (errors.rms - 0.5f64.sqrt()).abs() < 1e-6);
        assert_eq!(depth_errors(&[1.0], &[1.0], &[false], 1.0), Err(ImageError::NoDepth));
        assert!(depth_errors(&[1.0], &[f32::NAN], &[true], 1.0).is_err());
        assert!(depth_errors(&[1.0, 2.0], &[1.0], &[true, true], 1.0).unwrap_err().to_string().contains("true depth"));
        let released = released_depth_errors(&[2.0], &[2.0], &[true], 3.0).unwrap();
        assert_eq!(released.abs, 0.0);
    }
}
