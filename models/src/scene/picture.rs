//! Images, masks and depth maps of one view: read, undistorted, resized.

use super::check::same_shape;
use super::resize::Bytes;
use super::{Entry, Intrinsics, LoadOptions, SceneError, View, WorldFrame, jpeg, numpy};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageReader};
use std::path::{Path, PathBuf};

/// A file of depths along the optical axis: NumPy (`.npy`), PFM (`.pfm`) or a 16-bit grey PNG.
pub(super) struct DepthFile {
    pub path: PathBuf,
    /// Length of the file's unit in the world of the files.
    pub unit: f64,
}

/// Height and width of an image, from its header. `named_by` is the file and the field that mention the image.
pub(super) fn image_size(path: &Path, named_by: (&Path, String)) -> Result<[usize; 2], SceneError> {
    if !path.is_file() {
        let (by, field) = named_by;
        return Err(SceneError::MissingImage { path: by.into(), field, image: path.into() });
    }
    let (width, height) = open(path)?.into_dimensions().map_err(|e| decode_error(path, e))?;
    Ok([height as usize, width as usize])
}

/// Height and width of a photo held upright, and the turn that EXIF says gets it there.
pub(super) fn upright(path: &Path) -> Result<([usize; 2], Orientation), SceneError> {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    let refuse = |e| decode_error(path, e);
    let mut decoder = open(path)?.into_decoder().map_err(refuse)?;
    let (width, height) = decoder.dimensions();
    let (height, width) = (height as usize, width as usize);
    let turn = decoder.orientation().map_err(refuse)?;
    let lies = matches!(turn, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH);
    Ok((if lies { [width, height] } else { [height, width] }, turn))
}

/// The images of a folder, in the plain order of their names.
/// Whether a file is called like an image.
pub(super) fn is_image(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    ["png", "jpg", "jpeg"].contains(&ending.as_str())
}

pub(super) fn images_in(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let refuse = |source| SceneError::Read { path: folder.into(), source };
    let mut found = vec![];
    for file in std::fs::read_dir(folder).map_err(refuse)? {
        let path = file.map_err(refuse)?.path();
        // What macOS leaves beside files, and other hidden ones, are no images.
        let hidden = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
        if is_image(&path) && !hidden && path.is_file() {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The numbers that images are called, where all are; their order becomes that of the numbers.
pub(super) fn numbered(images: &mut [PathBuf]) -> Option<Vec<u64>> {
    let number = |p: &PathBuf| p.file_stem()?.to_str()?.parse::<u64>().ok();
    let mut numbers: Vec<u64> = images.iter().map(number).collect::<Option<_>>()?;
    numbers.sort_unstable();
    images.sort_by_key(|p| (number(p), p.clone()));
    Some(numbers)
}

/// The file's name, without its folder.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn open(path: &Path) -> Result<ImageReader<std::io::BufReader<std::fs::File>>, SceneError> {
    let refuse = |source| SceneError::Read { path: path.into(), source };
    ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(refuse)
}

fn decode_error(path: &Path, source: image::ImageError) -> SceneError {
    SceneError::Decode { path: path.into(), source }
}

fn decode(path: &Path) -> Result<DynamicImage, SceneError> {
    let bytes = std::fs::read(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    if let Some(damage) = jpeg::damage(&bytes) {
        return Err(SceneError::Format { path: path.into(), message: format!("a damaged JPEG image: {damage}") });
    }
    let reader = ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format();
    reader.map_err(Into::into).and_then(ImageReader::decode).map_err(|e| decode_error(path, e))
}

/// The view of an entry.
pub(super) fn read_view(entry: &Entry, frame: &WorldFrame, options: &LoadOptions) -> Result<View, SceneError> {
    let native = entry.intrinsics;
    let [height, width] = options.size.unwrap_or([native.height, native.width]);
    let mut image = decode(&entry.image)?;
    image.apply_orientation(entry.turn);
    let transparent = image.color().has_alpha();
    let bytes = match transparent {
        true => bytes_of(4, &image, image.to_rgba8().into_raw()),
        false => bytes_of(3, &image, image.to_rgb8().into_raw()),
    };
    let lens = Lens::of(&native);
    let flat = lens.as_ref().map_or(bytes.clone(), |lens| lens.remove(&bytes));
    let bytes = flat.resized(height, width);
    let opaque = |p: &[u8; 3]| [p[0], p[1], p[2], 255];
    let pixels = match transparent {
        true => bytes.data.as_chunks::<4>().0.to_vec(),
        false => bytes.data.as_chunks::<3>().0.iter().map(opaque).collect(),
    };
    let places = Places { native: &native, lens: lens.as_ref(), size: [height, width] };
    let mask = match &entry.mask {
        Some(path) => Some(read_mask(path, &places)?),
        None => None,
    };
    let depth = match &entry.depth {
        Some(file) => Some(read_depth(file, &places, frame.scale)?),
        None => None,
    };
    let intrinsics = Intrinsics { distortion: None, ..native.resized(height, width) };
    let pose = entry.pose.as_ref().map(|p| frame.load(p));
    let removed_distortion = native.distortion.filter(|d| d.iter().any(|k| *k != 0.0));
    Ok(View {
        name: entry.name.clone(),
        file: entry.image.clone(),
        file_size: [native.height, native.width],
        removed_distortion,
        pixels,
        transparent,
        intrinsics,
        pose,
        mask,
        depth,
    })
}

fn bytes_of(channels: usize, image: &DynamicImage, data: Vec<u8>) -> Bytes {
    Bytes { channels, height: image.height() as usize, width: image.width() as usize, data }
}

/// Where the pixels of a loaded view lie in a file that goes with its image: resized, and seen through the lens.
struct Places<'a> {
    native: &'a Intrinsics,
    lens: Option<&'a Lens>,
    size: [usize; 2],
}

impl Places<'_> {
    /// Row and column, at which pixel centres are halves, of every pixel in a file of `size`.
    fn each(&self, [rows, columns]: [usize; 2]) -> impl Iterator<Item = [f64; 2]> {
        let [height, width] = self.size;
        let native = self.native;
        let scale = |to: usize, from: usize| to as f64 / from as f64;
        let pixels = (0..height).flat_map(move |i| (0..width).map(move |j| [i as f64 + 0.5, j as f64 + 0.5]));
        pixels.map(move |[y, x]| match self.lens {
            None => [y * scale(rows, height), x * scale(columns, width)],
            Some(lens) => {
                let [u, v] = lens.distort([x * scale(native.width, width), y * scale(native.height, height)]);
                [v * scale(rows, native.height), u * scale(columns, native.width)]
            }
        })
    }

    /// Refuses a file that is no resized image of the same.
    fn check(&self, path: &Path, found: [usize; 2]) -> Result<(), SceneError> {
        let native = [self.native.height, self.native.width];
        if found[0] > 0 && found[1] > 0 && same_shape(found, native) {
            return Ok(());
        }
        Err(SceneError::Field {
            path: path.into(),
            field: "size".into(),
            expected: format!("{} x {}, as the image, or that resized", native[0], native[1]),
            found: format!("{} x {}", found[0], found[1]),
        })
    }
}

/// A mask: whether all that a bilinear lookup sees is foreground (white in the file).
fn read_mask(path: &Path, places: &Places) -> Result<Vec<bool>, SceneError> {
    let image = decode(path)?.to_rgb8();
    let [rows, columns] = [image.height() as usize, image.width() as usize];
    places.check(path, [rows, columns])?;
    let white = |i: usize, j: usize| image.as_raw()[3 * (i * columns + j)] == 255;
    let ends = |x: f64, size: usize| {
        let x = inside(x - 0.5, size);
        // Not the next pixel for a rounding.
        [(x + 1e-6).floor() as usize, (x - 1e-6).ceil() as usize]
    };
    let seen = |[y, x]: [f64; 2]| {
        let (upper, left) = (ends(y, rows), ends(x, columns));
        upper.iter().all(|i| left.iter().all(|j| white(*i, *j)))
    };
    Ok(places.each([rows, columns]).map(seen).collect())
}

/// Depths by nearest neighbour, in the loaded world's unit.
fn read_depth(file: &DepthFile, places: &Places, scale: f64) -> Result<Vec<f32>, SceneError> {
    let path = &file.path;
    let ([rows, columns], values) = match path.extension().and_then(|e| e.to_str()) {
        Some("npy") => {
            let array = numpy::read(path)?;
            match array.shape[..] {
                [rows, columns] | [rows, columns, 1] => ([rows, columns], array.values),
                _ => return Err(array.refuse(path, "height x width depths")),
            }
        }
        Some("pfm") => pfm(path)?,
        _ => {
            let image = decode(path)?;
            let size = [image.height() as usize, image.width() as usize];
            (size, image.to_luma16().into_raw().into_iter().map(f64::from).collect())
        }
    };
    places.check(path, [rows, columns])?;
    let unit = file.unit * scale;
    let nearest = |x: f64, size: usize| (x.max(0.0) as usize).min(size - 1);
    let depth = |[y, x]: [f64; 2]| {
        let depth = values[nearest(y, rows) * columns + nearest(x, columns)] * unit;
        if depth.is_finite() && depth > 0.0 { depth as f32 } else { 0.0 }
    };
    Ok(places.each([rows, columns]).map(depth).collect())
}

/// A grey portable float map: three header lines, then floats from the bottom row up, little-endian if the scale is
/// negative.
fn pfm(path: &Path) -> Result<([usize; 2], Vec<f64>), SceneError> {
    let format = |message: &str| SceneError::Format { path: path.into(), message: message.into() };
    let bytes = std::fs::read(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    let mut rest = &bytes[..];
    let mut line = || {
        let end = rest.iter().position(|b| *b == b'\n').ok_or_else(|| format("not a PFM file"))?;
        let text = std::str::from_utf8(&rest[..end]).map_err(|_| format("not a PFM file"))?.trim();
        rest = &rest[end + 1..];
        Ok::<&str, SceneError>(text)
    };
    let (kind, size, scale) = (line()?, line()?, line()?);
    let mut numbers = size.split_whitespace().map(str::parse::<usize>);
    let (Some(Ok(columns)), Some(Ok(rows)), Ok(scale)) = (numbers.next(), numbers.next(), scale.parse::<f64>()) else {
        return Err(format("the PFM header has no size and scale"));
    };
    let expected = rows.checked_mul(columns).and_then(|n| n.checked_mul(4));
    if kind != "Pf" || expected != Some(rest.len()) || rest.is_empty() {
        return Err(format("expected a grey PFM file (`Pf`) with four bytes a pixel"));
    }
    let float = |b: &[u8; 4]| f64::from(if scale < 0.0 { f32::from_le_bytes(*b) } else { f32::from_be_bytes(*b) });
    let upwards: Vec<f64> = rest.as_chunks::<4>().0.iter().map(float).collect();
    Ok(([rows, columns], upwards.chunks_exact(columns).rev().flatten().copied().collect()))
}

/// A camera with lens distortion, in pixels of its image.
struct Lens {
    camera: Intrinsics,
    k: [f64; 4],
}

impl Lens {
    fn of(camera: &Intrinsics) -> Option<Lens> {
        camera.distortion.filter(|k| k.iter().any(|k| *k != 0.0)).map(|k| Lens { camera: *camera, k })
    }

    /// Where the lens puts what a pinhole camera would show at (u, v).
    fn distort(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        let (c, [k1, k2, p1, p2]) = (&self.camera, self.k);
        let (x, y) = ((u - c.cx) / c.fx, (v - c.cy) / c.fy);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        let dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let dy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        [c.fx * dx + c.cx, c.fy * dy + c.cy]
    }

    /// The image of the pinhole camera with the same matrix, by bilinear lookup; the border repeats where it looks past it.
    fn remove(&self, image: &Bytes) -> Bytes {
        let (c, line) = (image.channels, image.width * image.channels);
        let mut data = Vec::with_capacity(image.data.len());
        for i in 0..image.height {
            for j in 0..image.width {
                let [u, v] = self.distort([j as f64 + 0.5, i as f64 + 0.5]);
                let (x, y) = (inside(u - 0.5, image.width), inside(v - 0.5, image.height));
                let (x0, y0) = (x as usize, y as usize);
                let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
                let (fx, fy) = (x - x0 as f64, y - y0 as f64);
                for k in 0..c {
                    let at = |row: usize, column: usize| f64::from(image.data[row * line + column * c + k]);
                    let upper = at(y0, x0) * (1.0 - fx) + at(y0, x1) * fx;
                    let lower = at(y1, x0) * (1.0 - fx) + at(y1, x1) * fx;
                    data.push((upper * (1.0 - fy) + lower * fy).round() as u8);
                }
            }
        }
        Bytes { data, ..*image }
    }
}

/// A coordinate moved into an axis of `size` pixels; 0 for what is no number.
fn inside(x: f64, size: usize) -> f64 {
    if x.is_nan() { 0.0 } else { x.clamp(0.0, (size - 1) as f64) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(distortion: Option<[f64; 4]>) -> Intrinsics {
        Intrinsics { fx: 40.0, fy: 42.0, cx: 16.0, cy: 12.5, height: 24, width: 32, distortion }
    }

    /// A smooth image seen through a lens, straightened, is the image again, away from the border.
    #[test]
    fn a_lens_and_its_removal() {
        assert!(Lens::of(&camera(Some([0.0; 4]))).is_none());
        let lens = Lens::of(&camera(Some([0.05, -0.02, 0.001, -0.002]))).unwrap();
        let smooth = |[u, v]: [f64; 2]| 120.0 + 60.0 * (u / 7.0).sin() + 50.0 * (v / 6.0).cos();
        // Inverse of the lens by fixed point.
        let straight = |p: [f64; 2]| {
            (0..50).fold(p, |q, _| {
                let d = lens.distort(q);
                [q[0] + p[0] - d[0], q[1] + p[1] - d[1]]
            })
        };
        let pixels = (0..24).flat_map(|i| (0..32).map(move |j| [f64::from(j) + 0.5, f64::from(i) + 0.5]));
        let seen = pixels.map(|p| smooth(straight(p)).round() as u8).collect();
        let found = lens.remove(&Bytes { channels: 1, height: 24, width: 32, data: seen });
        for i in 2..22 {
            for j in 2..30 {
                let expected = smooth([j as f64 + 0.5, i as f64 + 0.5]);
                assert!((f64::from(found.data[i * 32 + j]) - expected).abs() < 2.5, "row {i}, column {j}");
            }
        }
    }

    #[test]
    fn maps_of_floats() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("d.pfm");
        let floats: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        std::fs::write(&path, [b"Pf\n2 2\n-1.0\n".to_vec(), floats].concat()).unwrap();
        assert_eq!(pfm(&path).unwrap(), ([2, 2], vec![3.0, 4.0, 1.0, 2.0]));
        std::fs::write(&path, b"Pf\n2 2\n-1.0\nshort").unwrap();
        assert!(pfm(&path).unwrap_err().to_string().contains("d.pfm"));
    }
}
