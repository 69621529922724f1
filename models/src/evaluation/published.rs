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
    /// `planar`, or the name of the layout of its scenes: `blender`, `llff`, `dtu`, or `folder` (photos without poses).
    pub dataset: String,
    /// Poses at the start: `identity`, `noise 0.15`, `noise per scene` or `colmap`; in the plane, the perturbations' noise.
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
    /// A name as [`Settings::method_name`](crate::config::Settings::method_name) gives it.
    pub method: String,
    /// Read in the paper or its supplement, or confirmed by others. Else quoted: no threshold to accept or refuse by.
    pub verified: bool,
    /// Over the scenes of the table, or over runs.
    pub mean: f64,
    /// Standard deviation over runs; of rows of one scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spread: Option<f64>,
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

/// What the papers say of these methods on these scenes of one data set from one start; from any if there is none. Tables
/// of means alone are taken where the data set has any of the scenes.
pub fn published_for(dataset: &str, start: Option<&str>, scenes: &[&str], methods: &[&str]) -> Vec<PublishedTable> {
    let mut tables = published_of(dataset);
    let has = |t: &PublishedTable| t.scenes.iter().any(|s| scenes.contains(&s.as_str()));
    if !tables.iter().any(has) {
        return vec![];
    }
    tables.retain(|t| start.is_none_or(|s| t.start == s) && (t.scenes.is_empty() || has(t)));
    tables.iter_mut().for_each(|t| t.rows.retain(|r| methods.contains(&r.method.as_str())));
    tables.retain(|t| !t.rows.is_empty());
    tables
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
                assert_eq!(row.stage.is_none(), !row.metric.is_of_views(), "{name}");
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
            let tables = published_of(dataset).into_iter().filter(|t| t.paper == paper && t.scenes.len() > 1);
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

    #[test]
    fn what_compares_with_a_run_is_of_its_scene_method_and_start() {
        let of = |scene: &str, method: &str, start: &str| published_for("blender", Some(start), &[scene], &[method]);
        let lego = of("lego", "barf", "noise 0.15");
        assert!(!lego.is_empty() && lego.iter().all(|t| t.start == "noise 0.15"));
        assert!(lego.iter().flat_map(|t| &t.rows).all(|r| r.method == "barf"));
        assert_eq!(of("my own scene", "barf", "noise 0.15"), []);
        assert_eq!(of("lego", "my own method", "noise 0.15"), []);
        let planar = published_for("planar", None, &["cat"], &["inn"]);
        let corners = planar[0].rows.iter().find(|r| r.metric == Metric::CornerErrorPx).unwrap();
        assert_eq!((corners.mean, corners.spread), (4.70, Some(6.47)));
    }
}
