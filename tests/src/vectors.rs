//! Test vectors of the reference implementations: JSON files in `$RAYGRAD_DATA/vectors`, one a topic.
//!
//! A case has inputs, outputs and absolute tolerances; large tensors are given by a hash formula. Affine weights are
//! `[out, in]` there and `(in, out)` here.

use raygrad_compiler::graph::{Axis, Channels, Shape, Tensor};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use serde_json::Value;

/// One case of a topic.
pub struct Case {
    pub name: String,
    pub function: String,
    json: Value,
}

/// The cases of a topic; none, with a message, where `RAYGRAD_DATA` is not set.
pub fn cases(topic: &str) -> Vec<Case> {
    let Ok(data) = std::env::var("RAYGRAD_DATA") else {
        eprintln!("skipped: RAYGRAD_DATA is not set, so there are no vectors of `{topic}`");
        return vec![];
    };
    let path = std::path::Path::new(&data).join("vectors").join(format!("{topic}.json"));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let json: Value = serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let text = |v: &Value| v.as_str().expect("a text").to_string();
    let all = json["cases"].as_array().expect("a topic has cases").iter();
    all.map(|c| Case { name: text(&c["name"]), function: text(&c["function"]), json: c.clone() }).collect()
}

/// All numbers of nested lists, in order; a formula's tensor too.
pub fn numbers(v: &Value) -> Vec<f64> {
    match v {
        Value::Array(list) => list.iter().flat_map(numbers).collect(),
        Value::Object(o) if o.contains_key("formula") => formula(v),
        _ => vec![v.as_f64().unwrap_or_else(|| panic!("{v} is no number"))],
    }
}

/// Sizes of nested lists.
pub fn sizes(v: &Value) -> Vec<usize> {
    if let Some(shape) = v.get("shape") {
        return numbers(shape).iter().map(|n| *n as usize).collect();
    }
    match v {
        Value::Array(list) => {
            let mut all = vec![list.len()];
            all.extend(list.first().map(sizes).unwrap_or_default());
            all
        }
        _ => vec![],
    }
}

fn hash(seed: u32, i: u32, j: u32) -> u32 {
    let mut x = seed.wrapping_mul(0x9E37_79B1);
    x = x.wrapping_add(i.wrapping_mul(0x85EB_CA77)).wrapping_add(j.wrapping_mul(0xC2B2_AE3D)).wrapping_add(1);
    x = (x ^ (x >> 16)).wrapping_mul(0x7FEB_352D);
    x = (x ^ (x >> 15)).wrapping_mul(0x846C_A68B);
    x ^ (x >> 16)
}

fn formula(v: &Value) -> Vec<f64> {
    let shape = sizes(v);
    let seed = v["seed"].as_u64().expect("a formula has a seed") as u32;
    let count: usize = shape.iter().product();
    if v["formula"] == "block_image" {
        let (h, w, b) = (shape[1], shape[2], v["block"].as_u64().expect("an image has blocks") as usize);
        let pixel = |n: usize| hash(seed, (4096 * (n / (h * w)) + n / w % h / b) as u32, (n % w / b) as u32);
        return (0..count).map(|n| (pixel(n) >> 24) as f64 / 256.0).collect();
    }
    let scale = v["scale"].as_f64().expect("a formula has a scale");
    let columns = if shape.len() == 1 { count } else { count / shape[0] };
    let raw = |n: usize| (hash(seed, (n / columns) as u32, (n % columns) as u32) >> 16) as f64;
    let value = |n: usize| scale * (raw(n) - 32768.0) / 32768.0;
    match v["formula"].as_str() {
        Some("hash") => (0..count).map(value).collect(),
        Some("abs_hash") => (0..count).map(|n| value(n).abs()).collect(),
        Some("abs_hash_plus_half") => (0..count).map(|n| value(n).abs() + 0.5).collect(),
        other => panic!("unknown formula {other:?}"),
    }
}

/// A matrix `[rows, columns]` with rows and columns exchanged.
pub fn transpose(values: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    (0..rows * columns).map(|i| values[i % rows * columns + i / rows]).collect()
}

impl Case {
    /// An input by its key; `null` where there is none.
    pub fn input(&self, key: &str) -> &Value {
        &self.json["inputs"][key]
    }
    pub fn numbers(&self, key: &str) -> Vec<f64> {
        numbers(self.input(key))
    }
    pub fn sizes(&self, key: &str) -> Vec<usize> {
        sizes(self.input(key))
    }
    pub fn number(&self, key: &str) -> f64 {
        self.input(key).as_f64().unwrap_or_else(|| panic!("{}: {key} is no number", self.name))
    }
    pub fn count(&self, key: &str) -> usize {
        self.number(key) as usize
    }
    pub fn text(&self, key: &str) -> &str {
        self.input(key).as_str().unwrap_or_else(|| panic!("{}: {key} is no text", self.name))
    }
    /// Layer widths, the first replaced by `inputs`.
    pub fn widths(&self, key: &str, inputs: usize) -> Vec<usize> {
        let list = self.input(key).as_array().expect("a list of layers");
        list.iter().map(|n| n.as_u64().map_or(inputs, |n| n as usize)).collect()
    }
    /// An output by its path, for example `param_grads/mlp.0.bias`; `null` where there is none.
    pub fn output(&self, path: &str) -> &Value {
        path.splitn(2, '/').fold(&self.json["outputs"], |v, key| &v[key])
    }
    pub fn has_output(&self, path: &str) -> bool {
        !self.output(path).is_null()
    }
    /// The absolute tolerance of an output in double precision.
    pub fn tolerance(&self, path: &str) -> f64 {
        let tolerance = &self.json["tolerance_abs"][path]["f64"];
        tolerance.as_f64().unwrap_or_else(|| panic!("{}: no tolerance for {path}", self.name))
    }

    /// Panics unless `found` is the output within its tolerance. An output may be a digest: norm, sum, first and last
    /// entries.
    pub fn check(&self, path: &str, found: &[f64]) {
        self.check_within(path, found, 0.0);
    }
    /// Like [`Case::check`], with at least the tolerance `floor`.
    pub fn check_within(&self, path: &str, found: &[f64], floor: f64) {
        let (output, tolerance) = (self.output(path), self.tolerance(path).max(floor));
        if let Value::Object(digest) = output {
            let compare = |key: &str, found: &[f64]| {
                if let Some(expected) = digest.get(key) {
                    self.compare(&format!("{path} ({key})"), found, &numbers(expected), tolerance);
                }
            };
            compare("norm", &[found.iter().map(|x| x * x).sum::<f64>().sqrt()]);
            compare("sum", &[found.iter().sum()]);
            compare("first", &found[..found.len().min(6)]);
            compare("last", &found[found.len().saturating_sub(2)..]);
            return;
        }
        self.compare(path, found, &numbers(output), tolerance);
    }

    fn compare(&self, what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
        assert_eq!(found.len(), expected.len(), "{}: {what} has another size", self.name);
        for (i, (a, b)) in found.iter().zip(expected).enumerate() {
            let off = (a - b).abs();
            assert!(off <= tolerance, "{}: {what}[{i}] is {a}, not {b}: off by {off:.2e} > {tolerance:.1e}", self.name);
        }
    }
}

/// Inputs of a graph and their values, recorded together.
#[derive(Default)]
pub struct Bound {
    pub bindings: Bindings,
}

impl Bound {
    /// A data input with values.
    pub fn data(&mut self, name: &str, axes: &[&Axis], channels: impl Into<Channels>, values: Vec<f64>) -> Tensor {
        let shape = Shape::new(axes, channels);
        self.bindings.insert(name.into(), Array::floats(&shape, values));
        Tensor::input(name, Role::Data, shape)
    }
    /// Gives a recorded input its values, those of weights being `[out, in]`.
    pub fn fill(&mut self, input: &Tensor, official: &[f64]) {
        let name = input.input_name().expect("an input").to_string();
        self.bindings.insert(name, Array::floats(input.shape(), from_official(input, official)));
    }
    /// Values of tensors, flattened.
    pub fn run(&self, tensors: &[Tensor]) -> Vec<Vec<f64>> {
        let values = evaluate(tensors, &self.bindings).unwrap_or_else(|e| panic!("{e}"));
        values.iter().map(|a| a.f().to_vec()).collect()
    }
}

/// Official values of a parameter in this crate's order.
pub fn from_official(parameter: &Tensor, values: &[f64]) -> Vec<f64> {
    match parameter.channels() {
        Channels::Matrix(inputs, outputs) => transpose(values, outputs, inputs),
        Channels::Vector(_) => values.to_vec(),
    }
}

/// This crate's values of a parameter in the official order.
pub fn to_official(parameter: &Tensor, values: &[f64]) -> Vec<f64> {
    match parameter.channels() {
        Channels::Matrix(inputs, outputs) => transpose(values, inputs, outputs),
        Channels::Vector(_) => values.to_vec(),
    }
}
