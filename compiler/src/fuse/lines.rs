//! Reductions along the inner axis that stay inside a tile.
//!
//! Volume rendering evaluates a network on `[frame, ray, sample]`, sums over `sample`, compares the colour of a ray with a
//! picture, and goes back through the same samples:
//!
//! ```text
//! c_s, sigma_s = network(x_s),   rgb = sum_s w_s c_s,   g = 2 (rgb - target) / n,   dL/dc_s = w_s g
//! ```
//!
//! A cut after the sum would evaluate the network twice. Where a tile is a whole *line*, all elements along the inner axis,
//! the sum is complete inside it. Nodes between such a reduction and its way back, here `rgb` and `g`, get a copy that the
//! line's region computes, one lane a channel; only elements of the line's domain use it. Everybody else (the loss, whatever
//! goes on from per-ray gradients) reads the stored reduction after the region ended, as after any cut.

use super::cuts::{Cuts, Info};
use crate::graph::{Axes, Tensor, with_source};
use crate::ops::Form;
use std::collections::{HashMap, HashSet};

/// Per node, its copies: the domain of the region that computes one, and a tensor that stands for it.
#[derive(Default)]
pub(super) struct Copies(HashMap<u64, Vec<(Axes, Tensor)>>);

impl Copies {
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
    /// Copies of the node `id`.
    pub fn of(&self, id: u64) -> &[(Axes, Tensor)] {
        self.0.get(&id).map_or(&[], |c| c)
    }
    /// The copy that regions over `domain` compute.
    pub fn within(&self, id: u64, domain: &Axes) -> Option<&Tensor> {
        self.of(id).iter().find(|(d, _)| d == domain).map(|(_, t)| t)
    }
}

/// Domains with layers whose lines fit into tiles and are reduced.
pub(super) fn domains(cuts: &Cuts) -> Vec<Axes> {
    let all = || cuts.order.iter().map(|id| &cuts.nodes[id]);
    let mut domains: Vec<Axes> = vec![];
    for info in all().filter(|i| is_line(cuts, i)) {
        let expensive = |i: &Info| {
            i.runs_along(&info.domain) && (matches!(i.form, Form::Linear { .. }) || cuts.again(i) > cuts.stored(i))
        };
        if !domains.contains(&info.domain) && all().any(expensive) {
            domains.push(info.domain.clone());
        }
    }
    domains
}

/// The copies that regions over `domains` compute.
pub(super) fn copies(cuts: &Cuts, domains: &[Axes]) -> Copies {
    let mut copies = Copies::default();
    for domain in domains {
        for id in between(cuts, domain) {
            let t = &cuts.nodes[&id].tensor;
            let copy = with_source(t.source(), || Tensor::record_arc(t.op().clone(), t.inputs().to_vec()));
            copies.0.entry(id).or_default().push((domain.clone(), copy));
        }
    }
    copies
}

/// Whether a node reduces over the inner axis of its domain and nothing else, and a line of it fits into a tile.
fn is_line(cuts: &Cuts, info: &Info) -> bool {
    let Some(inner) = info.domain.last().filter(|_| info.reduces && matches!(info.form, Form::Reduce(_))) else {
        return false;
    };
    let outer = info.domain.without(inner);
    let target = &cuts.target;
    let most = if outer.elements() < target.lines { target.tile_rows } else { target.line_rows };
    *info.tensor.axes() == outer && inner.size() <= most
}

/// The nodes between a reduction along the inner axis of `domain` and elements of the domain that use it: the reductions
/// themselves and what is pointwise after them, in order.
fn between(cuts: &Cuts, domain: &Axes) -> Vec<u64> {
    let outer = Axes::new(domain.iter().take(domain.len().saturating_sub(1)).cloned());
    let mut reached = HashSet::new();
    for id in &cuts.order {
        let info = &cuts.nodes[id];
        let cheap = matches!(info.form, Form::Pointwise(_) | Form::Pick(_) | Form::ChannelSum(_) | Form::ChannelMax);
        let follows = cheap && info.domain == outer && info.operands.iter().any(|o| reached.contains(&o.id()));
        if follows || info.domain == *domain && is_line(cuts, info) {
            reached.insert(*id);
        }
    }
    let (mut used, mut all) = (HashSet::new(), vec![]);
    for id in cuts.order.iter().rev() {
        let info = &cuts.nodes[id];
        let copied = reached.contains(id) && used.contains(id);
        if copied {
            all.push(*id);
        }
        if copied || info.runs_along(domain) {
            let values = (0..info.operands.len()).filter(|i| !info.needs_buffer(*i));
            used.extend(values.map(|i| info.operands[i].id()));
        }
    }
    all.reverse();
    all
}
