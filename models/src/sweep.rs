//! Runs of a sweep: which are done, which are to be done, and the papers' table of all.

use crate::Error;
use crate::config::{Sweep, SweepCell};
use crate::evaluation::{Evaluation, PublishedTable, Table, published_for};
use crate::run::checkpoint::MANIFEST;
use crate::run::{EVALUATION, Metrics, RunFolder};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// How far a run of a sweep has got.
#[derive(Clone, Debug, PartialEq)]
pub enum Progress {
    /// There is nothing, or what a run leaves that was killed before its first checkpoint.
    Open,
    /// There is a checkpoint to go on from.
    Begun,
    Done(Box<Evaluation>),
}

impl SweepCell {
    /// The run's folder.
    pub fn folder(&self, sweep: &Path) -> PathBuf {
        sweep.join(&self.name)
    }

    /// How far the run has got.
    ///
    /// # Errors
    /// If its folder holds something else: other files, or a run with other settings.
    pub fn progress(&self, sweep: &Path) -> Result<Progress, Error> {
        let (path, settings) = (self.folder(sweep), &self.layered.settings);
        if !path.exists() || RunFolder::held_settings(&path)?.is_none() {
            RunFolder::claim(&path, settings)?;
            return Ok(Progress::Open);
        }
        RunFolder::check(&path, settings)?;
        // Written last of all, with what the run has come to.
        let ended = read::<Metrics>(&path.join("metrics.json")).is_some_and(|m| m.last.is_some());
        match read::<Evaluation>(&path.join(EVALUATION)) {
            Some(evaluation) if ended => Ok(Progress::Done(Box::new(evaluation))),
            _ if path.join(MANIFEST).exists() => Ok(Progress::Begun),
            _ => Ok(Progress::Open),
        }
    }

    /// What was measured, under the name of the preset, and of the scene as the sweep has it.
    fn named(&self, evaluation: &Evaluation) -> Evaluation {
        let (method, scene) = (self.preset.clone(), self.layered.settings.scene_name());
        Evaluation { method, scene, ..evaluation.clone() }
    }

    /// What the papers say of the same scene, method and start.
    fn published(&self) -> Vec<PublishedTable> {
        let settings = &self.layered.settings;
        let dataset = settings.scene.as_ref().map_or("planar", |s| s.layout().name());
        published_for(dataset, settings.start_name().as_deref(), &[&settings.scene_name()], &[settings.method_name()])
    }
}

/// A file of this program, if it is whole.
fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Option<T> {
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

/// What a sweep has come to.
#[derive(Debug, Serialize)]
pub struct SweepResults<'a> {
    pub name: &'a str,
    pub runs: Vec<RunResult<'a>>,
    /// Of the papers, for the same scenes, methods and starts.
    pub published: &'a [PublishedTable],
}

/// What one run has come to.
#[derive(Debug, Serialize)]
pub struct RunResult<'a> {
    pub name: &'a str,
    pub preset: &'a str,
    pub seed: u32,
    pub evaluation: &'a Evaluation,
}

/// The papers' table of a sweep, a cell a scene and preset over all seeds; and all of it as JSON.
pub fn results(sweep: &Sweep, done: &[(&SweepCell, Evaluation)]) -> (Table, String) {
    let mut published: Vec<PublishedTable> = vec![];
    for table in sweep.cells.iter().flat_map(SweepCell::published) {
        merge(&mut published, table);
    }
    let runs = done.iter().map(|(cell, evaluation)| RunResult {
        name: &cell.name,
        preset: &cell.preset,
        seed: cell.layered.settings.run.seed,
        evaluation,
    });
    let all = SweepResults { name: &sweep.name, runs: runs.collect(), published: &published };
    // Numbers, strings and lists always have a JSON form.
    let json = serde_json::to_string_pretty(&all).unwrap_or_default();
    let evaluations = done.iter().map(|(cell, evaluation)| cell.named(evaluation)).collect();
    (Table { title: sweep.name.clone(), evaluations, published }, json)
}

/// Adds the rows of a table that are not there yet.
fn merge(tables: &mut Vec<PublishedTable>, table: PublishedTable) {
    let same =
        |t: &&mut PublishedTable| (&t.paper, &t.table, &t.dataset) == (&table.paper, &table.table, &table.dataset);
    match tables.iter_mut().find(same) {
        None => tables.push(table),
        Some(known) => {
            let new: Vec<_> = table.rows.into_iter().filter(|r| !known.rows.contains(r)).collect();
            known.rows.extend(new);
        }
    }
}
