//! Depth maps as pictures: inverse depth in the inferno colours, as the published videos have them. The crate colorous
//! draws a smooth line through that colour map's 256 entries, so a byte may be off by one, at the bright end by four.

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
        let near = |found: [u8; 3], entry: [u8; 3]| {
            let close = found.iter().zip(entry).all(|(a, b)| a.abs_diff(b) <= 4);
            assert!(close, "{found:?} instead of {entry:?}");
        };
        // Entries 255, 63, 0 and 0 of the published colour map; the second is floor(255 / (1 / 0.5 * 2)).
        let canvas = inverse_depth(4, 1, &[0.25, 1.0, 1e9, f32::NAN], &[1.0, 0.5, 1.0, 1.0], style);
        let entries = [[0xfc, 0xff, 0xa4], [0x55, 0x0f, 0x6d], [0x00, 0x00, 0x04], [0x00, 0x00, 0x04]];
        canvas.0.pixels().zip(entries).for_each(|(p, e)| near(p.0, e));
        // Shifted by 1.5, and not below one: entries 255 and 127.
        let shifted = inverse_depth(2, 1, &[2.0, 3.5], &[1.0; 2], DepthStyle { scale: 1.0, shifted: true });
        near(shifted.0.get_pixel(0, 0).0, [0xfc, 0xff, 0xa4]);
        near(shifted.0.get_pixel(1, 0).0, [0xba, 0x36, 0x55]);
    }
}
