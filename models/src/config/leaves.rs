//! What a TOML file sets: every value with its full key and its line.

use super::error::{ConfigError, Origin};
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Value};

/// A value of a file, under the names of all tables that it is in.
pub(super) struct Leaf {
    pub key: String,
    pub value: Value,
    pub origin: Origin,
}

/// Everything that a file of this name and content sets.
pub(super) fn leaves(file: &str, text: &str) -> Result<Vec<Leaf>, ConfigError> {
    let lines = LineIndex::new(file, text);
    let document = DeTable::parse(text).map_err(|e| ConfigError::Syntax {
        origin: lines.at(e.span().map_or(0, |s| s.start)),
        message: e.message().to_string(),
    })?;
    let mut leaves = vec![];
    flatten("", document.get_ref(), &lines, &mut leaves);
    Ok(leaves)
}

fn flatten(prefix: &str, table: &DeTable, lines: &LineIndex, into: &mut Vec<Leaf>) {
    for (key, value) in table {
        let path = if prefix.is_empty() { key.get_ref().to_string() } else { format!("{prefix}.{}", key.get_ref()) };
        match value.get_ref() {
            DeValue::Table(inner) => flatten(&path, inner, lines, into),
            _ => into.push(Leaf { key: path, value: plain(value), origin: lines.at(key.span().start) }),
        }
    }
}

/// The value without spans.
fn plain(value: &Spanned<DeValue>) -> Value {
    match value.get_ref() {
        DeValue::String(s) => Value::String(s.to_string()),
        DeValue::Integer(n) => {
            i64::from_str_radix(n.as_str(), n.radix()).map_or(Value::Float(f64::INFINITY), Value::Integer)
        }
        DeValue::Float(x) => x.as_str().parse().map_or(Value::Float(f64::NAN), Value::Float),
        DeValue::Boolean(b) => Value::Boolean(*b),
        DeValue::Datetime(d) => Value::Datetime(*d),
        DeValue::Array(items) => Value::Array(items.iter().map(plain).collect()),
        DeValue::Table(t) => Value::Table(t.iter().map(|(k, v)| (k.get_ref().to_string(), plain(v))).collect()),
    }
}

/// Byte offsets to lines of a file.
struct LineIndex<'a> {
    file: &'a str,
    starts: Vec<usize>,
}

impl LineIndex<'_> {
    fn new<'a>(file: &'a str, text: &str) -> LineIndex<'a> {
        LineIndex { file, starts: text.match_indices('\n').map(|(i, _)| i + 1).collect() }
    }
    fn at(&self, offset: usize) -> Origin {
        Origin::Line { file: self.file.to_string(), line: 1 + self.starts.partition_point(|s| *s <= offset) }
    }
}
