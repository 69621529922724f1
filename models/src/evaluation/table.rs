//! Results as tables in the papers' layout: a row for each metric and method, a column for each scene, and the mean. Of
//! several runs of one method on one scene a cell holds the mean and the standard deviation.

use super::published::PublishedTable;
use super::scores::{Evaluation, Metric, Stage};
use serde::{Deserialize, Serialize};

/// Our runs, and tables of papers to print beside them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Table {
    pub title: String,
    pub evaluations: Vec<Evaluation>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub published: Vec<PublishedTable>,
}

/// One number of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    pub mean: f64,
    /// Standard deviation over runs, with n - 1; nothing for one run.
    pub spread: Option<f64>,
}

impl Cell {
    /// Of several runs; nothing of none.
    pub fn of(values: &[f64]) -> Option<Cell> {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
        let spread = (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt());
        (!values.is_empty()).then_some(Cell { mean, spread })
    }
}

/// One line of a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    pub metric: Metric,
    /// Nothing for errors of poses.
    pub stage: Option<Stage>,
    pub method: String,
    /// The paper and its table; nothing for ours.
    pub source: Option<String>,
    pub verified: bool,
    /// One for each of [`Table::scenes`].
    pub values: Vec<Option<Cell>>,
    /// Over all of these, nothing where one has no value; of a paper that only has means, its mean.
    pub mean: Option<Cell>,
}

impl Row {
    pub(super) fn heading(&self) -> String {
        match self.stage {
            Some(stage) => format!("{}, {}", self.metric.heading(), stage.name()),
            None => self.metric.heading().to_string(),
        }
    }

    /// The method, with the paper it is from and a mark where that is not verified.
    pub(super) fn label(&self) -> String {
        match &self.source {
            Some(source) => format!("{} [{source}]{}", self.method, if self.verified { "" } else { " *" }),
            None => self.method.clone(),
        }
    }

    pub(super) fn cells(&self) -> impl Iterator<Item = Option<Cell>> {
        self.values.iter().copied().chain([self.mean])
    }
}

impl Table {
    /// The columns: scenes in the order of the runs, or those of the papers where there are no runs.
    pub fn scenes(&self) -> Vec<String> {
        let ours = self.evaluations.iter().map(|e| &e.scene);
        let theirs = self.published.iter().flat_map(|t| &t.scenes);
        let mut scenes: Vec<String> = vec![];
        let mut add = |scene: &String| {
            if !scenes.contains(scene) {
                scenes.push(scene.clone());
            }
        };
        if self.evaluations.is_empty() {
            theirs.for_each(&mut add)
        } else {
            ours.for_each(&mut add)
        }
        scenes
    }

    /// Methods of our runs, in their order.
    fn methods(&self) -> Vec<&str> {
        let mut methods: Vec<&str> = vec![];
        for e in &self.evaluations {
            if !methods.contains(&e.method.as_str()) {
                methods.push(&e.method);
            }
        }
        methods
    }

    /// All lines, by metric, then stage, ours first.
    pub fn rows(&self) -> Vec<Row> {
        let (scenes, methods) = (self.scenes(), self.methods());
        let mut rows = vec![];
        for metric in Metric::ALL {
            let stages: &[Option<Stage>] =
                if metric.is_of_views() { &[Some(Stage::Before), Some(Stage::After)] } else { &[None] };
            for stage in stages {
                rows.extend(methods.iter().filter_map(|m| self.our_row(metric, *stage, m, &scenes)));
                rows.extend(self.published.iter().flat_map(|t| published_rows(t, metric, *stage, &scenes)));
            }
        }
        rows
    }

    fn our_row(&self, metric: Metric, stage: Option<Stage>, method: &str, scenes: &[String]) -> Option<Row> {
        let cell = |scene: &String| {
            let runs = self.evaluations.iter().filter(|e| e.method == method && e.scene == *scene);
            let value = |run: &Evaluation| stage.map_or(Some(&run.cameras), |s| run.stage(s))?.mean.get(metric);
            Cell::of(&runs.filter_map(value).collect::<Vec<f64>>())
        };
        let mut values: Vec<Option<Cell>> = scenes.iter().map(cell).collect();
        // Whether a run succeeds has a share, and no spread.
        if metric == Metric::Success {
            values.iter_mut().flatten().for_each(|c| c.spread = None);
        }
        let (mean, method) = (mean(&values), method.into());
        let known = values.iter().any(Option::is_some);
        known.then_some(Row { metric, stage, method, source: None, verified: true, values, mean })
    }

    /// How many runs there are of a method on a scene, where others have more.
    pub(super) fn fewer_runs(&self) -> Vec<String> {
        let count = |method: &str, scene: &str| {
            self.evaluations.iter().filter(|e| e.method == method && e.scene == scene).count()
        };
        let (scenes, methods) = (self.scenes(), self.methods());
        let pairs: Vec<(&str, &str, usize)> =
            methods.iter().flat_map(|m| scenes.iter().map(|s| (*m, s.as_str(), count(m, s)))).collect();
        let most = pairs.iter().map(|p| p.2).max().unwrap_or(0);
        let few = pairs.into_iter().filter(|p| p.2 < most);
        few.map(|(method, scene, n)| format!("{method} on {scene}: {n} of {most} runs")).collect()
    }
}

fn published_rows(table: &PublishedTable, metric: Metric, stage: Option<Stage>, scenes: &[String]) -> Vec<Row> {
    let rows = table.rows.iter().filter(|r| r.metric == metric && r.stage == stage);
    let shown = rows.filter_map(|r| {
        let cell = |mean: f64| Cell { mean, spread: r.spread };
        let value = |scene: &String| table.scenes.iter().position(|s| s == scene).and_then(|i| r.values.get(i));
        let values: Vec<Option<Cell>> = scenes.iter().map(|s| value(s).map(|v| cell(*v))).collect();
        let complete = values.iter().flatten().count() == table.scenes.len();
        let same = table.scenes.is_empty() || table.scenes.len() == scenes.len();
        // A mean over other scenes than those shown would not compare with ours.
        let mean = if complete && same { Some(cell(r.mean)) } else { mean(&values) };
        let whole = if table.scenes.is_empty() { ", all scenes" } else { "" };
        let source = Some(format!("{}, {}{whole}", table.paper, table.table));
        (mean.is_some() || values.iter().any(Option::is_some)).then(|| Row {
            metric,
            stage,
            method: r.method.clone(),
            source,
            verified: r.verified,
            values,
            mean,
        })
    });
    shown.collect()
}

/// Over scenes, if all have a value: others would not compare. It has a spread over runs only where it is of one scene.
fn mean(values: &[Option<Cell>]) -> Option<Cell> {
    let known: Vec<Cell> = values.iter().copied().collect::<Option<_>>()?;
    match known[..] {
        [] => None,
        [only] => Some(only),
        _ => Some(Cell { mean: known.iter().map(|c| c.mean).sum::<f64>() / known.len() as f64, spread: None }),
    }
}
