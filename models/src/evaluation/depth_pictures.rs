//! Depth maps as pictures: inverse depth in the inferno colours, as the published videos have them.

use crate::pictures::Canvas;

/// How inverse depth becomes a colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthStyle {
    /// Rendered depths are multiplied by this first: [`Similarity::scale`](super::Similarity) of a run that learned its
    /// poses, one for a run with known poses.
    pub scale: f64,
    /// Blender scenes lie about four units ahead: 1.5 are taken off, and no depth stays below one.
    pub shifted: bool,
}

/// The picture of depths, row by row, each divided by its opacity: colour `inferno[floor(255 v)]` with
/// `v = 1 / (depth / opacity + 1e-10)` kept in 0..=1. What is not finite is black.
///
/// # Panics
/// If the lists do not have `width * height` numbers.
pub fn inverse_depth(width: usize, height: usize, depth: &[f32], opacity: &[f32], style: DepthStyle) -> Canvas {
    assert!(depth.len() == width * height && opacity.len() == depth.len(), "a depth and an opacity for every pixel");
    let mut canvas = Canvas::new(width, height, [0; 3]);
    for ((pixel, depth), opacity) in canvas.0.pixels_mut().zip(depth).zip(opacity) {
        let mut depth = f64::from(*depth) / f64::from(*opacity) * style.scale;
        if style.shifted {
            depth = (depth - 1.5).max(1.0);
        }
        let inverse = 1.0 / (depth + 1e-10);
        // A NaN becomes zero, the darkest entry.
        let entry = (inverse.clamp(0.0, 1.0) * 255.0) as usize;
        pixel.0 = colorous::INFERNO.eval_rational(entry, 256).as_array();
    }
    canvas
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_bright_and_far_is_dark() {
        let style = DepthStyle { scale: 2.0, shifted: false };
        let canvas = inverse_depth(4, 1, &[0.25, 1.0, 1e9, f32::NAN], &[1.0, 0.5, 1.0, 1.0], style);
        let pixels: Vec<[u8; 3]> = canvas.0.pixels().map(|p| p.0).collect();
        // The ends of the published colour map, and its entry 63: inverse depth 1 / (1 / 0.5 * 2).
        assert_eq!(pixels[0], [252, 255, 164]);
        assert_eq!(pixels[1], colorous::INFERNO.eval_rational(63, 256).as_array());
        assert_eq!((pixels[2], pixels[3]), ([0, 0, 4], [0, 0, 4]));
        let shifted = inverse_depth(2, 1, &[2.0, 3.5], &[1.0; 2], DepthStyle { scale: 1.0, shifted: true });
        assert_eq!(shifted.0.get_pixel(0, 0).0, [252, 255, 164]);
        assert_eq!(shifted.0.get_pixel(1, 0).0, colorous::INFERNO.eval_rational(127, 256).as_array());
    }
}
