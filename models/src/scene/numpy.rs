//! Arrays of NumPy files (`.npy`, `.npz`) as f64, whatever floating or integer type they have.

use super::SceneError;
use npyz::{NpyFile, Order, TypeChar};
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
    let file = open(path)?;
    parse(BufReader::new(file)).map_err(|message| SceneError::Format { path: path.into(), message })
}

/// All arrays of an archive whose names `wanted` accepts.
pub(super) fn read_archive(
    path: &Path,
    wanted: impl Fn(&str) -> bool,
) -> Result<BTreeMap<String, NumpyArray>, SceneError> {
    let format = |message: String| SceneError::Format { path: path.into(), message };
    let archive = zip::ZipArchive::new(BufReader::new(open(path)?));
    let mut archive = archive.map_err(|e| format(format!("not a NumPy archive: {e}")))?;
    let mut arrays = BTreeMap::new();
    for i in 0..archive.len() {
        let member = archive.by_index(i).map_err(|e| format(e.to_string()))?;
        let name = member.name().map_err(|e| format(e.to_string()))?.trim_end_matches(".npy").to_string();
        if wanted(&name) {
            let array = parse(member).map_err(|e| format(format!("`{name}`: {e}")))?;
            arrays.insert(name, array);
        }
    }
    Ok(arrays)
}

fn open(path: &Path) -> Result<std::fs::File, SceneError> {
    std::fs::File::open(path).map_err(|source| SceneError::Read { path: path.into(), source })
}

fn parse(reader: impl Read) -> Result<NumpyArray, String> {
    let file = NpyFile::new(reader).map_err(|e| format!("not a NumPy file: {e}"))?;
    let shape: Vec<usize> = file.shape().iter().map(|n| *n as usize).collect();
    let order = file.order();
    let npyz::DType::Plain(kind) = file.dtype() else {
        return Err("expected plain numbers, found records".to_string());
    };
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
