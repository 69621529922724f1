//! Long work that is watched: how far it is, and whether somebody wants it to stop.

use crate::Error;
use std::sync::atomic::{AtomicBool, Ordering};

/// What long work is given to tell and to ask between its parts.
#[derive(Clone, Copy)]
pub struct Watch<'a> {
    progress: &'a dyn Fn(usize, usize),
    stop: &'a AtomicBool,
}

/// Nobody stops what is not given a flag.
static NEVER: AtomicBool = AtomicBool::new(false);

impl<'a> Watch<'a> {
    /// `progress` hears how many of how many parts are done; `stop` is looked at between smaller ones.
    pub fn new(progress: &'a dyn Fn(usize, usize), stop: &'a AtomicBool) -> Watch<'a> {
        Watch { progress, stop }
    }

    /// Nobody looks.
    pub fn none() -> Watch<'static> {
        Watch { progress: &|_, _| {}, stop: &NEVER }
    }

    pub fn done(&self, done: usize, all: usize) {
        (self.progress)(done, all);
    }

    /// Goes on, or [`Error::Stopped`].
    pub fn check(&self) -> Result<(), Error> {
        if self.stop.load(Ordering::Relaxed) { Err(Error::Stopped) } else { Ok(()) }
    }
}
