//! Networks whose rows stay in a workgroup of a GPU, from encoding to the last layer.
//!
//! A layer of a wide network is a launch of its own: its weights alone fill what a workgroup can hold. The rows of a narrow one
//! pass through all layers in workgroup memory, and only what comes out of the last one, or what a way back needs, is written.
//!
//! Where no scan along the inner axis goes backwards, as in rendering without gradients, scans and the sums over that axis need no cut
//! either: a workgroup follows a whole line, such as a ray. Else scans, and what follows from them up to the next layer, are
//! regions of their own.

use super::cuts::{Cuts, Info};
use crate::graph::{Axes, Tensor, topological};
use crate::ops::Form;
use crate::plan::region::Grain;
use std::collections::{HashMap, HashSet};

/// Inputs of a layer for one output that it may have.
const INPUTS: usize = 2;
/// Most channels of a scan, or of a sum over a line, that a workgroup follows: one an invocation.
pub const LINE_CHANNELS: usize = 32;

/// Domains of resident networks; whether a workgroup follows whole lines there.
#[derive(Default)]
pub(super) struct Resident(HashMap<Axes, bool>);

/// What a value was last computed from, of its own domain.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum After {
    Neither,
    Layer,
    Scan,
}

impl Resident {
    /// The domains whose layers have at most `most` outputs, at least two of them.
    pub fn of(roots: &[Tensor], most: usize) -> Resident {
        if most == 0 {
            return Resident::default();
        }
        let all = topological(roots.iter().cloned());
        let mut layers: HashMap<Axes, (usize, bool)> = HashMap::new();
        for t in all.iter().filter(|t| matches!(t.op().form(), Form::Linear { .. })) {
            let (x, w) = (&t.inputs()[0], &t.inputs()[1]);
            let shared = t.axes().last().is_some_and(|inner| !w.axes().contains(inner));
            let narrow = t.width() <= most && x.width() <= INPUTS * most;
            let (count, all) = layers.get(t.axes()).copied().unwrap_or((0, true));
            layers.insert(t.axes().clone(), (count + 1, all && shared && narrow));
        }
        let narrow = layers.into_iter().filter(|(_, (count, narrow))| *count > 1 && *narrow);
        Resident(narrow.map(|(domain, _)| (domain.clone(), follows_lines(&all, &domain))).collect())
    }

    /// In order.
    pub fn domains(&self) -> Vec<Axes> {
        let mut all: Vec<Axes> = self.0.keys().cloned().collect();
        all.sort();
        all
    }

    /// Of a node of a resident network, what it works on.
    pub fn grain(&self, info: &Info) -> Option<Grain> {
        let lines = *self.0.get(&info.domain)?;
        // Products of many rows have kernels of their own.
        let apart = info.reduces && matches!(info.form, Form::Outer | Form::Scatter { .. });
        let inside = info.runs_along(&info.domain) && !apart;
        (inside && (lines || info.after != After::Scan)).then_some(Grain::Tile)
    }
}

/// What a node was last computed from: of several operands, the later of what they were.
pub(super) fn after(cuts: &Cuts, info: &Info) -> After {
    match info.form {
        Form::Linear { .. } => After::Layer,
        Form::CumSum { .. } | Form::Shift { .. } => After::Scan,
        _ => {
            let operands = info.operands.iter().map(|o| cuts.get(o));
            let inside = operands.filter(|o| !o.reduces && o.domain == info.domain);
            inside.map(|o| o.after).max().unwrap_or(After::Neither)
        }
    }
}

/// Whether a workgroup can follow the lines of `domain` from the first element to the last, and it pays: all sums along them go
/// forwards, and neighbours can be computed again.
fn follows_lines(all: &[Tensor], domain: &Axes) -> bool {
    let Some(inner) = domain.last() else { return false };
    let outer = domain.without(inner);
    // What depends on a layer or a scan of the domain.
    let mut kept: HashSet<u64> = HashSet::new();
    let mut pays = false;
    for t in all {
        let here = t.axes() == domain;
        let over = t.inputs().iter().any(|i| i.axes() == domain);
        let mut depends = t.inputs().iter().any(|i| kept.contains(&i.id()));
        match t.op().form() {
            Form::Linear { .. } if here => depends = true,
            Form::CumSum { axis, reverse } if here => {
                if reverse || axis != *inner || t.width() > LINE_CHANNELS {
                    return false;
                }
                (depends, pays) = (true, true);
            }
            Form::Shift { axis, .. } if here && (depends || axis != *inner) => return false,
            Form::Reduce(_) if over => pays |= *t.axes() == outer && t.width() <= LINE_CHANNELS,
            _ => {}
        }
        kept.extend(depends.then_some(t.id()));
    }
    pays
}
