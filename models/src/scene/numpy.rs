//! Arrays of NumPy files (`.npy`, `.npz`) as f64, whatever floating or integer type they have.

use super::SceneError;
use npyz::{NpyFile, NpyHeader, Order, TypeChar};
use std::collections::BTreeMap;
use std::io::{BufReader, Read};
use std::path::Path;

/// An array in C order.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct NumpyArray {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl NumpyArray {
    /// The error of a file whose array has another shape than expected.
    pub fn refuse(&self, path: &Path, expected: &str) -> SceneError {
        let found = format!("an array of shape {:?}", self.shape);
        SceneError::Format { path: path.into(), message: format!("expected {expected}, found {found}") }
    }
}

pub(super) fn read(path: &Path) -> Result<NumpyArray, SceneError> {
    let bytes = std::fs::read(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    parse(&bytes).map_err(|message| SceneError::Format { path: path.into(), message })
}

/// All arrays of an archive whose names `wanted` accepts.
pub(super) fn read_archive(
    path: &Path,
    wanted: impl Fn(&str) -> bool,
) -> Result<BTreeMap<String, NumpyArray>, SceneError> {
    let format = |message: String| SceneError::Format { path: path.into(), message };
    let file = std::fs::File::open(path).map_err(|source| SceneError::Read { path: path.into(), source })?;
    let archive = zip::ZipArchive::new(BufReader::new(file));
    let mut archive = archive.map_err(|e| format(format!("not a NumPy archive: {e}")))?;
    let mut arrays = BTreeMap::new();
    for i in 0..archive.len() {
        let mut member = archive.by_index(i).map_err(|e| format(e.to_string()))?;
        let name = member.name().map_err(|e| format(e.to_string()))?.trim_end_matches(".npy").to_string();
        if wanted(&name) {
            let refuse = |e: String| format(format!("`{name}`: {e}"));
            // Reading up to the end compares the checksum.
            let mut bytes = vec![];
            member.read_to_end(&mut bytes).map_err(|e| refuse(e.to_string()))?;
            let array = parse(&bytes).map_err(refuse)?;
            arrays.insert(name, array);
        }
    }
    Ok(arrays)
}

/// The numbers of the shape that a header states. The library multiplies them, come what may.
fn stated_shape(bytes: &[u8]) -> Vec<u64> {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(1 << 16)]);
    let shape = text.split_once("shape").and_then(|(_, rest)| rest.split_once('(')?.1.split_once(')'));
    shape.map_or_else(Vec::new, |(numbers, _)| numbers.split(',').filter_map(|n| n.trim().parse().ok()).collect())
}

fn parse(bytes: &[u8]) -> Result<NumpyArray, String> {
    let stated = stated_shape(bytes);
    if stated.iter().try_fold(1u64, |product, n| product.checked_mul((*n).max(1))).is_none() {
        return Err(format!("expected an array that fits into a file, found the shape {stated:?}"));
    }
    let mut data = bytes;
    let header = NpyHeader::from_reader(&mut data).map_err(|e| format!("not a NumPy file: {e}"))?;
    let shape: Vec<usize> = header.shape().iter().map(|n| *n as usize).collect();
    let order = header.order();
    let npyz::DType::Plain(kind) = header.dtype() else {
        return Err("expected plain numbers, found records".to_string());
    };
    let size = kind.num_bytes().and_then(|n| shape.iter().try_fold(n, |product, n| product.checked_mul(*n)));
    if size.is_none_or(|size| size > data.len()) {
        return Err(format!("expected an array of shape {shape:?}, found {} bytes", data.len()));
    }
    let file = NpyFile::with_header(header, data);
    let values: Result<Vec<f64>, std::io::Error> = match (kind.type_char(), kind.size_field()) {
        (TypeChar::Float, 8) => file.into_vec::<f64>(),
        (TypeChar::Float, 4) => file.into_vec::<f32>().map(|v| v.into_iter().map(f64::from).collect()),
        (TypeChar::Int, 8) => file.into_vec::<i64>().map(|v| v.into_iter().map(|x| x as f64).collect()),
        (TypeChar::Int, 4) => file.into_vec::<i32>().map(|v| v.into_iter().map(f64::from).collect()),
        (TypeChar::Uint, 2) => file.into_vec::<u16>().map(|v| v.into_iter().map(f64::from).collect()),
        _ => return Err(format!("expected floating numbers, found the type `{kind}`")),
    };
    let values = values.map_err(|e| e.to_string())?;
    match order {
        Order::C => Ok(NumpyArray { shape, values }),
        Order::Fortran if shape.len() == 2 => {
            let (rows, columns) = (shape[0], shape[1]);
            let at = |i: usize| values[i % columns * rows + i / columns];
            Ok(NumpyArray { values: (0..rows * columns).map(at).collect(), shape })
        }
        Order::Fortran => Err("expected C order, found Fortran order".to_string()),
    }
}
