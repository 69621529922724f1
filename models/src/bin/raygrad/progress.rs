//! Progress of a run on standard error: a bar on a terminal, plain lines elsewhere.

use indicatif::{ProgressBar, ProgressStyle};
use raygrad::report::duration;
use raygrad::run::Entry;
use raygrad::{Estimate, Observer};
use std::io::IsTerminal;
use std::path::Path;
use std::time::{Duration, Instant};

/// Plain lines are at least this far apart.
const QUIET: Duration = Duration::from_secs(2);

pub struct Progress {
    bar: Option<ProgressBar>,
    begun: Instant,
    last_line: Option<Instant>,
    first: usize,
    done: usize,
    steps: usize,
}

impl Progress {
    pub fn new() -> Progress {
        let bar = std::io::stderr().is_terminal().then(ProgressBar::no_length);
        Progress { bar, begun: Instant::now(), last_line: None, first: 0, done: 0, steps: 0 }
    }

    /// A line for people, above the bar if there is one.
    fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => note!("{text}"),
        }
    }

    /// Steps a second in this part of the run.
    fn rate(&self) -> f64 {
        (self.done - self.first) as f64 / self.begun.elapsed().as_secs_f64().max(1e-3)
    }

    fn state(entry: &Entry) -> String {
        let total = entry.loss.get("total").copied().unwrap_or(0.0);
        let views: Vec<&str> = entry.relocalised.iter().map(|r| r.view.as_str()).collect();
        let back = if views.is_empty() { String::new() } else { format!("  brought back {}", views.join(", ")) };
        let seen = entry.validation_psnr_db().map_or(String::new(), |psnr| format!("  validation {psnr:.2} dB"));
        format!("loss {total:.5}  PSNR {:.2} dB{seen}  {}{back}", entry.psnr_db(), entry.error_text())
    }
}

impl Observer for Progress {
    fn loading(&self) -> Box<dyn Fn(usize, usize) + Sync> {
        let bar = bar("loading", "images");
        Box::new(move |done, all| {
            bar.show(done, all);
            if done == all {
                bar.finish();
            }
        })
    }

    fn note(&mut self, note: &str) {
        self.say(&format!("note: {note}"));
    }

    fn expected(&mut self, estimate: &Estimate, device: &str) {
        let [total, training, evaluation] = [estimate.total(), estimate.training, estimate.evaluation].map(duration);
        let text = format!("about {total} on {device}: {training} of training, {evaluation} of evaluation");
        self.say(&text);
    }

    fn begin(&mut self, folder: &Path, done: usize, steps: usize) {
        (self.begun, self.first, self.done, self.steps) = (Instant::now(), done, done, steps);
        match &self.bar {
            Some(bar) => {
                let template = "{bar:32.cyan/blue} {pos}/{len}  {per_sec}  ETA {eta}  {msg}";
                if let Ok(style) = ProgressStyle::with_template(template) {
                    bar.set_style(style);
                }
                bar.set_length(steps as u64);
                bar.set_position(done as u64);
                bar.reset_eta();
                bar.println(format!("training into {}", folder.display()));
            }
            None => note!("training into {}, step {done} of {steps}", folder.display()),
        }
    }

    fn step(&mut self, done: usize) {
        self.done = done;
        if let Some(bar) = &self.bar {
            bar.set_position(done as u64);
        }
    }

    fn measured(&mut self, entry: &Entry) {
        self.done = entry.step;
        match &self.bar {
            Some(bar) => bar.set_message(Progress::state(entry)),
            None => {
                let due = self.last_line.is_none_or(|t| t.elapsed() >= QUIET) || entry.step == self.steps;
                if due {
                    self.last_line = Some(Instant::now());
                    let rate = self.rate();
                    let left = duration((self.steps - entry.step) as f64 / rate.max(1e-9));
                    let state = Progress::state(entry);
                    note!("step {}/{}  {rate:.1} steps/s  ETA {left}  {state}", entry.step, self.steps);
                }
            }
        }
    }

    fn finishing(&mut self) {
        match &self.bar {
            Some(bar) => bar.finish(),
            None => note!("training done, writing pictures and report"),
        }
    }
}

/// The bar ends where it is when a run stops early or fails.
impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = self.bar.as_ref().filter(|b| !b.is_finished()) {
            bar.abandon();
        }
    }
}

/// A bar on a terminal; nothing elsewhere.
pub struct Bar(ProgressBar);

/// A bar of things done: `bar("reading", "images")`.
pub fn bar(what: &'static str, unit: &str) -> Bar {
    let bar = if std::io::stderr().is_terminal() { ProgressBar::no_length() } else { ProgressBar::hidden() };
    let style = ProgressStyle::with_template(&format!("{{msg}} {{wide_bar}} {{pos}}/{{len}} {unit}"));
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.set_message(what);
    Bar(bar)
}

impl Bar {
    /// `done` of `all`; calls may come from any thread and in any order.
    pub fn show(&self, done: usize, all: usize) {
        self.0.set_length(all as u64);
        self.0.set_position(self.0.position().max(done as u64));
    }

    pub fn finish(&self) {
        self.0.finish_and_clear();
    }
}
