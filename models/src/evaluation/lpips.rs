//! LPIPS, version 0.1, on AlexNet (Zhang et al. 2018): how different two pictures look.
//!
//! Both pictures go through the five convolutions of AlexNet. After each of its ReLUs the features are divided by their
//! length over channels, and the squared differences are weighted by one learned weight a channel:
//! `d = sum over layers of mean over pixels of w . (f_a / |f_a| - f_b / |f_b|)^2`.
//!
//! The weights are not ours to ship: `scripts/convert_lpips.py` makes a safetensors file of them, with `conv1.weight`
//! `[out, in, rows, columns]`, `conv1.bias`, .. `conv5.bias` and `lin0.weight` `[1, channels, 1, 1]`, .. `lin4.weight`.

use super::image_metrics::{ImageError, Picture, same_size};
use nalgebra::DMatrix;
use rayon::prelude::*;
use safetensors::{Dtype, SafeTensors};
use std::path::{Path, PathBuf};

/// A weights file that is not one of LPIPS.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    #[error("cannot read the LPIPS weights {}: {source}", .path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("the LPIPS weights are not in the safetensors format (scripts/convert_lpips.py writes it): {0}")]
    Format(#[from] safetensors::SafeTensorError),
    #[error("the LPIPS weights lack the tensor `{name}`; found: {}", .found.join(", "))]
    Missing { name: String, found: Vec<String> },
    #[error("the tensor `{name}` of the LPIPS weights has shape {found:?}, not {expected:?}")]
    Shape { name: String, expected: Vec<usize>, found: Vec<usize> },
    #[error("the tensor `{name}` of the LPIPS weights holds {found}, not F32 or F64 numbers")]
    Type { name: String, found: String },
    #[error(
        "the tensor `{name}` of the LPIPS weights holds a number that is not finite, or a negative weight of a layer"
    )]
    Value { name: String },
}

/// One convolution with its ReLU and what comes before it.
struct Spec {
    inputs: usize,
    outputs: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
    /// Largest value of 3 x 3 windows, every other one, first.
    pool: bool,
}

const fn spec(inputs: usize, outputs: usize, kernel: usize, stride: usize, padding: usize, pool: bool) -> Spec {
    Spec { inputs, outputs, kernel, stride, padding, pool }
}

const LAYERS: [Spec; 5] = [
    spec(3, 64, 11, 4, 2, false),
    spec(64, 192, 5, 1, 2, true),
    spec(192, 384, 3, 1, 1, true),
    spec(384, 256, 3, 1, 1, false),
    spec(256, 256, 3, 1, 1, false),
];

/// The least side of a picture: 31 pixels give 7, then 3, then one.
const LEAST: usize = 31;

/// Brings colours in -1..=1 to the trunk's range.
const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];

struct Layer {
    /// `outputs x (inputs * kernel * kernel)`.
    weight: DMatrix<f64>,
    bias: Vec<f64>,
    /// One weight a feature.
    linear: Vec<f64>,
}

/// The network with its weights.
pub struct Lpips {
    layers: Vec<Layer>,
}

impl std::fmt::Debug for Lpips {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Lpips")
    }
}

/// Features of a picture: row by row, all channels of a pixel together.
struct Features {
    width: usize,
    height: usize,
    channels: usize,
    values: Vec<f64>,
}

impl Lpips {
    /// Weights from a file.
    ///
    /// # Errors
    /// If the file cannot be read, or is not a file of these weights: the message names the tensor, what was expected
    /// and what was found.
    pub fn load(path: &Path) -> Result<Lpips, WeightsError> {
        let bytes = std::fs::read(path).map_err(|source| WeightsError::Read { path: path.into(), source })?;
        Lpips::from_bytes(&bytes)
    }

    /// Weights from the bytes of a safetensors file.
    ///
    /// # Errors
    /// As [`Lpips::load`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Lpips, WeightsError> {
        let file = SafeTensors::deserialize(bytes)?;
        let layers = LAYERS.iter().enumerate().map(|(i, spec)| {
            let window = spec.inputs * spec.kernel * spec.kernel;
            let shape = [spec.outputs, spec.inputs, spec.kernel, spec.kernel];
            let weight = numbers(&file, &format!("conv{}.weight", i + 1), &shape)?;
            let bias = numbers(&file, &format!("conv{}.bias", i + 1), &[spec.outputs])?;
            let name = format!("lin{i}.weight");
            let linear = numbers(&file, &name, &[1, spec.outputs, 1, 1])?;
            if linear.iter().any(|w| *w < 0.0) {
                return Err(WeightsError::Value { name });
            }
            Ok(Layer { weight: DMatrix::from_row_slice(spec.outputs, window, &weight), bias, linear })
        });
        Ok(Lpips { layers: layers.collect::<Result<_, WeightsError>>()? })
    }

    /// The distance of two pictures with values in 0..=1; zero for equal ones.
    ///
    /// # Errors
    /// If the pictures differ in size or have a side of less than 31 pixels.
    pub fn distance(&self, a: &Picture, b: &Picture) -> Result<f64, ImageError> {
        Ok(self.per_layer(a, b)?.iter().sum())
    }

    /// Whether pictures of this size can be compared.
    ///
    /// # Errors
    /// If they have a side of less than 31 pixels.
    pub fn check_size(width: usize, height: usize) -> Result<(), ImageError> {
        let least = LEAST;
        if width.min(height) < least { Err(ImageError::Small { width, height, least }) } else { Ok(()) }
    }

    /// The five terms of the distance, from the first layer to the last.
    ///
    /// # Errors
    /// As [`Lpips::distance`].
    pub fn per_layer(&self, a: &Picture, b: &Picture) -> Result<[f64; 5], ImageError> {
        same_size(a, b)?;
        Lpips::check_size(a.width(), a.height())?;
        let mut terms = [0.0; 5];
        let (mut a, mut b) = (input(a), input(b));
        for ((term, layer), spec) in terms.iter_mut().zip(&self.layers).zip(&LAYERS) {
            (a, b) = (forward(layer, spec, a), forward(layer, spec, b));
            *term = difference(&a, &b, &layer.linear);
        }
        Ok(terms)
    }
}

fn numbers(file: &SafeTensors, name: &str, expected: &[usize]) -> Result<Vec<f64>, WeightsError> {
    let tensor = file.tensor(name).map_err(|_| {
        let mut found: Vec<String> = file.names().iter().map(|n| n.to_string()).collect();
        found.sort();
        WeightsError::Missing { name: name.into(), found }
    })?;
    if tensor.shape() != expected {
        let (expected, found) = (expected.to_vec(), tensor.shape().to_vec());
        return Err(WeightsError::Shape { name: name.into(), expected, found });
    }
    let data = tensor.data();
    let values: Vec<f64> = match tensor.dtype() {
        Dtype::F32 => data.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        Dtype::F64 => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        other => return Err(WeightsError::Type { name: name.into(), found: format!("{other:?}") }),
    };
    if values.iter().all(|x| x.is_finite()) { Ok(values) } else { Err(WeightsError::Value { name: name.into() }) }
}

fn input(picture: &Picture) -> Features {
    let rgb = picture.rgb().iter().enumerate();
    let values = rgb.map(|(i, x)| (f64::from(*x) * 2.0 - 1.0 - SHIFT[i % 3]) / SCALE[i % 3]).collect();
    Features { width: picture.width(), height: picture.height(), channels: 3, values }
}

/// Output pixels a matrix product takes at once: enough for its speed, few enough that the windows stay small.
const BLOCK: usize = 256;

fn forward(layer: &Layer, spec: &Spec, x: Features) -> Features {
    let x = if spec.pool { pooled(&x) } else { x };
    let side = |n: usize| (n + 2 * spec.padding - spec.kernel) / spec.stride + 1;
    let (width, height) = (side(x.width), side(x.height));
    let mut values = vec![0.0; width * height * spec.outputs];
    values.par_chunks_mut(BLOCK * spec.outputs).enumerate().for_each(|(block, out)| {
        let pixels = out.len() / spec.outputs;
        let product = &layer.weight * windows(&x, spec, block * BLOCK, pixels, width);
        for (i, (y, sum)) in out.iter_mut().zip(product.as_slice()).enumerate() {
            *y = (sum + layer.bias[i % spec.outputs]).max(0.0);
        }
    });
    Features { width, height, channels: spec.outputs, values }
}

/// Windows of the output pixels `first..first + pixels`, one a column, ordered as a row of the weights.
fn windows(x: &Features, spec: &Spec, first: usize, pixels: usize, width: usize) -> DMatrix<f64> {
    let k = spec.kernel;
    let mut all = DMatrix::zeros(x.channels * k * k, pixels);
    for (i, mut window) in all.column_iter_mut().enumerate() {
        let (row, column) = ((first + i) / width * spec.stride, (first + i) % width * spec.stride);
        for (dy, dx) in (0..k).flat_map(|dy| (0..k).map(move |dx| (dy, dx))) {
            // Below the padding there is nothing, and above the picture neither.
            let (Some(y), Some(x0)) = ((row + dy).checked_sub(spec.padding), (column + dx).checked_sub(spec.padding))
            else {
                continue;
            };
            if y < x.height && x0 < x.width {
                let pixel = &x.values[(y * x.width + x0) * x.channels..][..x.channels];
                for (channel, value) in pixel.iter().enumerate() {
                    window[channel * k * k + dy * k + dx] = *value;
                }
            }
        }
    }
    all
}

/// The largest value of every 3 x 3 window, two pixels apart.
fn pooled(x: &Features) -> Features {
    let (width, height, channels) = ((x.width - 3) / 2 + 1, (x.height - 3) / 2 + 1, x.channels);
    let at = |i: usize| {
        let (row, column, channel) = (i / channels / width * 2, i / channels % width * 2, i % channels);
        let value = |j: usize| x.values[((row + j / 3) * x.width + column + j % 3) * channels + channel];
        (0..9).map(value).fold(f64::NEG_INFINITY, f64::max)
    };
    let values = (0..width * height * channels).into_par_iter().map(at).collect();
    Features { width, height, channels, values }
}

/// Mean over pixels of the weighted squared difference of unit features.
fn difference(a: &Features, b: &Features, weights: &[f64]) -> f64 {
    let length = |pixel: &[f64]| pixel.iter().map(|x| x * x).sum::<f64>().sqrt() + 1e-10;
    let pixels = a.values.chunks_exact(a.channels).zip(b.values.chunks_exact(b.channels));
    let sum: f64 = pixels
        .map(|(a, b)| {
            let (la, lb) = (length(a), length(b));
            let terms = a.iter().zip(b).zip(weights);
            terms.map(|((x, y), w)| w * (x / la - y / lb).powi(2)).sum::<f64>()
        })
        .sum();
    sum / (a.width * a.height) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::tensor::TensorView;

    /// A file whose tensors are `fill(name, index)`, changed by `change` before it is written.
    fn file(change: impl Fn(&str, &mut Vec<usize>) -> bool, fill: impl Fn(&str, usize) -> f32) -> Vec<u8> {
        let mut shapes = vec![];
        for (i, s) in LAYERS.iter().enumerate() {
            shapes.push((format!("conv{}.weight", i + 1), vec![s.outputs, s.inputs, s.kernel, s.kernel]));
            shapes.push((format!("conv{}.bias", i + 1), vec![s.outputs]));
            shapes.push((format!("lin{i}.weight"), vec![1, s.outputs, 1, 1]));
        }
        shapes.retain_mut(|(name, shape)| change(name, shape));
        let bytes: Vec<Vec<u8>> = shapes
            .iter()
            .map(|(n, s)| (0..s.iter().product()).flat_map(|i| fill(n, i).to_le_bytes()).collect())
            .collect();
        let views = shapes
            .iter()
            .zip(&bytes)
            .map(|((name, shape), data)| (name.clone(), TensorView::new(Dtype::F32, shape.clone(), data).unwrap()));
        safetensors::serialize(views, None).unwrap()
    }

    #[test]
    fn wrong_weights_are_named() {
        let refuse = |bytes: &[u8]| Lpips::from_bytes(bytes).unwrap_err().to_string();
        let small = |_: &str, _: usize| 0.01;
        let missing = refuse(&file(|n, _| n != "conv3.bias", small));
        assert!(missing.contains("lack the tensor `conv3.bias`") && missing.contains("conv3.weight"), "{missing}");
        let shape = refuse(&file(
            |n, s| {
                if n == "conv1.weight" {
                    *s = vec![64, 3, 3, 3];
                }
                true
            },
            small,
        ));
        assert!(shape.contains("`conv1.weight`") && shape.contains("[64, 3, 3, 3], not [64, 3, 11, 11]"), "{shape}");
        let negative = refuse(&file(|_, _| true, |n, _| if n == "lin2.weight" { -1.0 } else { 0.0 }));
        assert!(negative.contains("lin2.weight"), "{negative}");
        assert!(refuse(b"PK not a safetensors file").contains("safetensors"));
        assert!(Lpips::load(Path::new("no/such/file")).unwrap_err().to_string().contains("no/such/file"));
    }

    #[test]
    fn equal_pictures_have_no_distance_and_small_ones_are_refused() {
        let wave = |name: &str, i: usize| {
            let x = (i as f32 * 0.7 + name.len() as f32).sin() * 0.05;
            if name.starts_with("lin") { x.abs() } else { x }
        };
        let lpips = Lpips::from_bytes(&file(|_, _| true, wave)).unwrap();
        let picture = |w: usize, h: usize, f: f32| -> Vec<f32> {
            (0..3 * w * h).map(|i| 0.5 + 0.5 * (i as f32 * f).sin()).collect()
        };
        let (a, b) = (picture(31, 35, 0.3), picture(31, 35, 0.8));
        let (a, b) = (Picture::new(31, 35, &a).unwrap(), Picture::new(31, 35, &b).unwrap());
        assert_eq!(lpips.distance(&a, &a).unwrap(), 0.0);
        let terms = lpips.per_layer(&a, &b).unwrap();
        assert!(terms.iter().all(|t| *t > 0.0 && t.is_finite()), "{terms:?}");
        let small = picture(30, 35, 0.3);
        let small = Picture::new(30, 35, &small).unwrap();
        assert!(lpips.distance(&small, &small).unwrap_err().to_string().contains("30 x 35"));
    }
}
