//! Resizing as Pillow does it by default, byte for byte, since the published numbers come from images resized by it.
//!
//! Bicubic (a = -0.5), its support widened by the reduction factor; columns first, then rows, each pass in fixed point and
//! rounded to bytes. Transparent images are resized with colours multiplied by opacity.

/// Bytes of an image, row by row, `channels` a pixel: 1 (grey), 3 (RGB) or 4 (RGBA, the colours not multiplied).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Bytes {
    pub channels: usize,
    pub height: usize,
    pub width: usize,
    pub data: Vec<u8>,
}

/// Fractional bits of the weights.
const BITS: u32 = 22;

/// Weights of the source pixels from `first` on, for one destination pixel.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

fn bicubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    match x.abs() {
        x if x < 1.0 => ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0,
        x if x < 2.0 => (((x - 5.0) * x + 8.0) * x - 4.0) * A,
        _ => 0.0,
    }
}

/// Taps of every destination pixel along one axis.
fn taps(from: usize, to: usize) -> Vec<Taps> {
    let scale = from as f64 / to as f64;
    let widened = scale.max(1.0);
    let support = 2.0 * widened;
    let one = |i: usize| {
        let center = (i as f64 + 0.5) * scale;
        let first = (center - support + 0.5).max(0.0) as usize;
        let end = ((center + support + 0.5) as usize).min(from);
        let weights: Vec<f64> = (first..end).map(|j| bicubic((j as f64 - center + 0.5) * (1.0 / widened))).collect();
        let sum: f64 = weights.iter().sum();
        let fixed = |w: f64| (w / sum * f64::from(1u32 << BITS)).round() as i32;
        Taps { first, weights: weights.into_iter().map(fixed).collect() }
    };
    (0..to).map(one).collect()
}

/// One pass: destination pixel `i` of a line is the weighted sum of source pixels `step` bytes apart.
fn weighted(line: &[u8], offset: usize, step: usize, taps: &Taps) -> u8 {
    let start = 1i32 << (BITS - 1);
    let sum = taps
        .weights
        .iter()
        .enumerate()
        .fold(start, |sum, (j, w)| sum + w * i32::from(line[offset + (taps.first + j) * step]));
    (sum >> BITS).clamp(0, 255) as u8
}

impl Bytes {
    /// The image at `height` x `width`.
    pub fn resized(&self, height: usize, width: usize) -> Bytes {
        if (height, width) == (self.height, self.width) {
            return self.clone();
        }
        if self.channels == 4 {
            return self.map_pixels(multiplied).scaled(height, width).map_pixels(divided);
        }
        self.scaled(height, width)
    }

    fn scaled(&self, height: usize, width: usize) -> Bytes {
        let c = self.channels;
        let mut wide = self.data.clone();
        if width != self.width {
            let taps = taps(self.width, width);
            wide = Vec::with_capacity(self.height * width * c);
            for row in self.data.chunks_exact(self.width * c) {
                wide.extend(taps.iter().flat_map(|t| (0..c).map(|k| weighted(row, k, c, t))));
            }
        }
        let mut data = wide;
        if height != self.height {
            let (wide, line) = (data, width * c);
            data = Vec::with_capacity(height * line);
            for t in taps(self.height, height) {
                data.extend((0..line).map(|k| weighted(&wide, k, line, &t)));
            }
        }
        Bytes { channels: c, height, width, data }
    }

    fn map_pixels(&self, f: impl Fn([u8; 4]) -> [u8; 4]) -> Bytes {
        let data = self.data.as_chunks::<4>().0.iter().flat_map(|p| f(*p)).collect();
        Bytes { data, ..*self }
    }
}

fn multiplied([r, g, b, a]: [u8; 4]) -> [u8; 4] {
    let times = |c: u8| {
        let t = u32::from(c) * u32::from(a) + 128;
        (((t >> 8) + t) >> 8) as u8
    };
    [times(r), times(g), times(b), a]
}

fn divided([r, g, b, a]: [u8; 4]) -> [u8; 4] {
    if a == 0 || a == 255 {
        return [r, g, b, a];
    }
    let by = |c: u8| (255 * u32::from(c) / u32::from(a)).min(255) as u8;
    [by(r), by(g), by(b), a]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the cases were resized from.
    fn noise([height, width]: [usize; 2], channels: usize, seed: u32) -> Bytes {
        let mut x = seed;
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (x >> 24) as u8
        };
        let mut data: Vec<u8> = (0..height * width * channels).map(|_| next()).collect();
        if channels == 4 {
            for alpha in data.iter_mut().skip(3).step_by(4) {
                *alpha = match *alpha {
                    0..70 => 0,
                    181.. => 255,
                    a => a,
                };
            }
        }
        Bytes { channels, height, width, data }
    }

    /// (channels, size, new size, seed) and the bytes that Pillow 13.0 makes of it.
    type Case = ((usize, [usize; 2], [usize; 2], u32), &'static [u8]);
    #[rustfmt::skip]
    const PILLOW: &[Case] = &[
        ((3, [7, 11], [3, 5], 1), &[156, 124, 154, 138, 146, 120, 141, 185, 77, 92, 110, 88, 153, 120, 116, 86, 138,
          166, 103, 155, 136, 135, 147, 135, 143, 102, 119, 140, 106, 101, 109, 125, 113, 156, 113, 123, 193, 142,
          101, 117, 95, 113, 111, 121, 126]),
        ((3, [5, 4], [9, 7], 2), &[42, 103, 43, 102, 139, 34, 193, 196, 23, 116, 161, 82, 37, 122, 124, 130, 158,
          56, 190, 184, 13, 80, 147, 71, 114, 142, 58, 169, 134, 43, 143, 120, 112, 112, 120, 164, 155, 161, 87,
          182, 188, 37, 143, 217, 118, 131, 142, 100, 120, 22, 79, 185, 47, 163, 242, 116, 229, 197, 167, 140, 166,
          195, 81, 118, 139, 83, 94, 81, 81, 63, 0, 84, 138, 23, 133, 214, 96, 171, 186, 166, 130, 163, 202, 101,
          65, 40, 42, 52, 29, 61, 35, 17, 92, 82, 43, 85, 136, 92, 77, 148, 169, 106, 151, 210, 123, 53, 138, 129,
          82, 129, 152, 132, 120, 183, 155, 146, 119, 152, 182, 67, 103, 210, 147, 73, 224, 198, 83, 207, 199, 136,
          191, 208, 223, 169, 213, 222, 200, 133, 174, 235, 79, 85, 229, 182, 35, 222, 249, 184, 109, 163, 203, 86,
          129, 230, 54, 71, 204, 98, 63, 163, 155, 91, 132, 178, 174, 117, 186, 222, 240, 50, 139, 237, 23, 80, 228,
          0, 0, 190, 36, 22, 156, 107, 99, 160, 148, 167, 166, 165, 204]),
        ((4, [8, 9], [3, 4], 3), &[90, 156, 131, 124, 75, 154, 128, 193, 90, 112, 121, 172, 125, 107, 135, 154, 144,
          123, 123, 132, 114, 116, 179, 125, 108, 109, 157, 160, 166, 160, 145, 135, 184, 126, 172, 188, 149, 130,
          126, 188, 123, 175, 139, 64, 109, 127, 103, 84]),
        ((1, [6, 13], [6, 5], 4), &[130, 129, 67, 157, 139, 179, 99, 95, 111, 81, 148, 168, 139, 104, 95, 78, 125,
          91, 149, 207, 80, 87, 99, 71, 78, 140, 141, 202, 163, 154]),
        ((4, [3, 3], [4, 5], 5), &[61, 202, 68, 255, 56, 187, 62, 166, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 115, 194,
          45, 255, 97, 181, 33, 160, 0, 0, 0, 0, 255, 83, 231, 55, 250, 90, 193, 116, 146, 166, 85, 198, 133, 132,
          74, 164, 128, 56, 72, 95, 215, 70, 156, 98, 250, 90, 193, 116, 158, 128, 255, 95, 139, 79, 152, 176, 135,
          59, 75, 255, 122, 53, 53, 96, 0, 0, 0, 0]),
    ];

    #[test]
    fn bytes_of_pillow() {
        for ((channels, size, to, seed), expected) in PILLOW {
            let found = noise(*size, *channels, *seed).resized(to[0], to[1]);
            assert_eq!(found.data, *expected, "{channels} channels, {size:?} to {to:?}");
        }
    }

    #[test]
    fn one_axis_only_and_none() {
        let image = noise([4, 6], 3, 9);
        assert_eq!(image.resized(4, 6), image);
        let flat = Bytes { data: vec![77; 4 * 6 * 3], ..image };
        assert_eq!(flat.resized(9, 6).data, vec![77; 9 * 6 * 3]);
        assert_eq!(flat.resized(4, 2).data, vec![77; 4 * 2 * 3]);
    }
}
