//! Animated PNG: it plays in every browser and keeps all colours.

use super::{Canvas, PictureError};
use png::{BitDepth, ColorType, Encoder};

/// Milliseconds a frame is shown, and the last one.
const FRAME: u16 = 120;
const LAST: u16 = 2000;

/// All frames as one picture; they have the size of the first.
pub fn animate(frames: &[Canvas]) -> Result<Vec<u8>, PictureError> {
    animate_at(frames, FRAME, LAST)
}

/// The same, with the milliseconds a frame is shown, and the last one.
pub fn animate_at(frames: &[Canvas], shown: u16, last_shown: u16) -> Result<Vec<u8>, PictureError> {
    let Some(first) = frames.first() else {
        return Err(PictureError("an animation needs at least one frame".to_string()));
    };
    let mut bytes = vec![];
    let encode = |bytes: &mut Vec<u8>| -> Result<(), png::EncodingError> {
        let mut encoder = Encoder::new(bytes, first.0.width(), first.0.height());
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_animated(frames.len() as u32, 0)?;
        let mut writer = encoder.write_header()?;
        for (i, frame) in frames.iter().enumerate() {
            writer.set_frame_delay(if i + 1 == frames.len() { last_shown } else { shown }, 1000)?;
            writer.write_image_data(frame.0.as_raw())?;
        }
        writer.finish()
    };
    encode(&mut bytes).map_err(|e| PictureError(e.to_string()))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_another_size_are_refused() {
        let a = Canvas::new(4, 3, [10, 20, 30]);
        assert!(animate(&[a.clone(), a.clone()]).is_ok());
        assert!(animate(&[a, Canvas::new(5, 3, [0; 3])]).is_err());
        assert!(animate(&[]).is_err());
    }
}
