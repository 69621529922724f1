//! The papers' numbers, from `published.toml`.

use super::scores::{Metric, Stage};
use serde::{Deserialize, Serialize};

/// One table of a paper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedTable {
    /// `BARF`, `L2G-NeRF` or `INN`.
    pub paper: String,
    /// Which table of it.
    pub table: String,
    /// `blender`, `llff`, `dtu` or `iphone`.
    pub dataset: String,
    /// Poses at the start: `identity`, `noise 0.15`, `noise per scene` or `colmap`.
    pub start: String,
    /// Columns of every row's `values`; none where only means are known.
    pub scenes: Vec<String>,
    pub rows: Vec<PublishedRow>,
}

/// One method's values of one metric.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedRow {
    pub metric: Metric,
    /// Before or after test-time refinement; nothing for errors of poses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stage: Option<Stage>,
    /// `naive`, `barf`, `l2g`, `l2g-noglobal`, `inn` or `reference`.
    pub method: String,
    /// Read in the paper or its supplement, or confirmed by others. Else quoted: no threshold to accept or refuse by.
    pub verified: bool,
    /// Over the scenes of the table.
    pub mean: f64,
    /// Per scene.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub values: Vec<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    table: Vec<PublishedTable>,
}

/// All tables; `tests` below read the same file, so it is well-formed.
///
/// # Panics
/// Never, as the file is part of the program.
pub fn published() -> Vec<PublishedTable> {
    let file: File = toml::from_str(include_str!("published.toml")).expect("the built-in numbers are well-formed");
    file.table
}

/// Tables of one data set.
pub fn published_of(dataset: &str) -> Vec<PublishedTable> {
    published().into_iter().filter(|t| t.dataset == dataset).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_the_rows() {
        let mut rows = 0;
        for table in published() {
            for row in &table.rows {
                let name = format!("{}, {}, {} of {}", table.paper, table.table, row.metric.key(), row.method);
                assert_eq!(row.stage.is_none(), row.metric.is_of_poses(), "{name}");
                assert_eq!(row.values.len(), table.scenes.len(), "{name}");
                rows += 1;
                if row.values.is_empty() {
                    continue;
                }
                let mean = row.values.iter().sum::<f64>() / row.values.len() as f64;
                // Means and values are rounded to the last digit printed.
                let digit = if table.paper == "BARF" && row.metric != Metric::PsnrDb { 1e-3 } else { 1e-2 };
                assert!((mean - row.mean).abs() <= 1.01 * digit, "{name}: {mean} instead of {}", row.mean);
            }
        }
        assert!(rows > 120, "{rows}");
    }

    #[test]
    fn numbers_known_by_heart() {
        let find = |dataset: &str, paper: &str, metric, method: &str, stage| {
            let tables = published_of(dataset).into_iter().filter(|t| t.paper == paper && !t.scenes.is_empty());
            let mut rows = tables.flat_map(|t| t.rows);
            rows.find(|r| r.metric == metric && r.method == method && r.stage == stage).unwrap()
        };
        let barf = find("blender", "BARF", Metric::RotationErrorDeg, "barf", None);
        assert_eq!((barf.mean, barf.values[0], barf.verified), (0.193, 0.096, true));
        let l2g = find("blender", "L2G-NeRF", Metric::PsnrDb, "l2g", Some(Stage::After));
        assert_eq!((l2g.mean, l2g.verified), (28.62, false));
        let inn = find("llff", "INN", Metric::PsnrDb, "inn", Some(Stage::Before));
        assert_eq!((inn.mean, inn.values[0]), (19.31, 22.04));
        assert_eq!(published_of("no such data set"), []);
    }
}
