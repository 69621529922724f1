//! What the measurements share: statistics, Markdown tables, and training without files.
//!
//! The measurements are examples, run by the scripts beside this crate.

use anyhow::{Context, bail};
use raygrad::Experiment;
use raygrad::planar::Trainer;
use raygrad::training::Training;
use std::fmt::Display;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;

/// Median; NaN of nothing.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => 0.5 * (sorted[n / 2 - 1] + sorted[n / 2]),
    }
}

pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Rows of a Markdown table; the first is the head.
#[derive(Default)]
pub struct Table(Vec<Vec<String>>);

impl Table {
    pub fn new(head: &[&str]) -> Table {
        Table(vec![head.iter().map(|h| h.to_string()).collect()])
    }
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.0.push(cells.into_iter().collect());
    }
}

impl Display for Table {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        for (i, row) in self.0.iter().enumerate() {
            writeln!(f, "| {} |", row.join(" | "))?;
            if i == 0 {
                writeln!(f, "|{}", "---|".repeat(row.len()))?;
            }
        }
        Ok(())
    }
}

/// The programs that a comparison starts.
#[derive(clap::Args)]
pub struct Programs {
    /// The command raygrad.
    #[arg(long)]
    raygrad: PathBuf,
    /// Python with torch, jax and numpy; what it lacks is left out.
    #[arg(long)]
    python: PathBuf,
    /// Folder of torch_step.py and jax_step.py.
    #[arg(long)]
    peers: PathBuf,
}

impl Programs {
    /// `raygrad bench`, printing JSON.
    pub fn bench(&self, preset: &str) -> Command {
        let mut command = Command::new(&self.raygrad);
        command.args(["bench", preset, "--json"]);
        command
    }

    pub fn python(&self) -> Command {
        Command::new(&self.python)
    }

    /// A script of the peers'.
    pub fn script(&self, name: &str) -> PathBuf {
        self.peers.join(name)
    }

    /// Whether Python runs some code without an error; if not, says that `what` is left out.
    pub fn has(&self, what: &str, code: &str) -> bool {
        let there = self.python().args(["-c", code]).output().is_ok_and(|o| o.status.success());
        if !there {
            eprintln!("{what} is left out: {} cannot `{code}`", self.python.display());
        }
        there
    }
}

/// What a program prints; its messages, if it fails.
pub fn output(mut command: Command) -> anyhow::Result<String> {
    let done = command.output().with_context(|| format!("cannot start {command:?}"))?;
    if !done.status.success() {
        bail!("{command:?} failed: {}", String::from_utf8_lossy(&done.stderr));
    }
    Ok(String::from_utf8(done.stdout)?)
}

/// The number that stands before a unit.
pub fn number_before(text: &str, unit: &str) -> anyhow::Result<f64> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let at = words.iter().position(|w| *w == unit).filter(|at| *at > 0);
    let word = words[at.with_context(|| format!("no `{unit}` in `{text}`"))? - 1];
    word.parse().with_context(|| format!("`{word}` is no number"))
}

/// Whether scripts only prove that they run (`RAYGRAD_QUICK`).
pub fn quick() -> bool {
    std::env::var_os("RAYGRAD_QUICK").is_some()
}

/// Trains to the last step without writing anything; `at` sees the trainer after every step. Returns the seconds it took.
pub fn train(
    name: &str,
    experiment: &Experiment,
    mut at: impl FnMut(&mut Trainer) -> Result<(), raygrad::Error>,
) -> Result<(Trainer, f64), raygrad::Error> {
    let mut trainer = experiment.trainer()?;
    let steps = experiment.layered.settings.optim.steps;
    let begun = Instant::now();
    let every = (steps / 20).max(1);
    while trainer.steps_done() < steps {
        trainer.step()?;
        at(&mut trainer)?;
        if trainer.steps_done().is_multiple_of(every) && std::io::stderr().is_terminal() {
            eprint!("\r{name}: {}/{steps}  ", trainer.steps_done());
        }
    }
    trainer.wait()?;
    Ok((trainer, begun.elapsed().as_secs_f64()))
}
