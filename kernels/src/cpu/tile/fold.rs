//! Short inner axes: several lines in a tile.
//!
//! A tile runs along the inner axis. Where that is short (a few rays a view, 64 samples a ray), most rows of a tile would
//! be padding, and every operation would be called once a line. Then axes outside the inner one become rows too: to the
//! rest of the lowering, they and the inner axis are a single axis. Only where rows meet memory, or a scan, does it matter
//! that they are *lines*, one for each position of the axes outside.

use raygrad_compiler::graph::{Axes, Axis};
use raygrad_compiler::plan::Program;
use raygrad_compiler::plan::region::{Region, RegionOp, Store};

/// A region whose inner axis stands for several, and those other than the old inner one, outermost first.
pub(super) fn fold(program: &Program, region: &Region, most: usize) -> (Region, Vec<Axis>) {
    let unfolded = || (region.clone(), vec![]);
    let Some(inner) = region.inner.as_ref().filter(|i| region.domain.last() == Some(*i)) else { return unfolded() };
    // What is computed once a line would be computed once a row.
    let once_a_line = |i| matches!(region.inst(i).op, RegionOp::Linear(_) | RegionOp::SymEig { .. });
    if region.ids().any(|i| region.is_uniform(i) && once_a_line(i)) {
        return unfolded();
    }
    let (mut lines, mut rows) = (vec![], inner.size());
    for axis in region.domain.iter().rev().skip(1) {
        if 2 * rows > most || has_own_matrices(program, region, axis) {
            break;
        }
        lines.push(axis.clone());
        rows *= axis.size();
    }
    if lines.is_empty() {
        return unfolded();
    }
    lines.reverse();
    let all = Axis::new("row", rows);
    let is_row = |a: &Axis| a == inner || lines.contains(a);
    let folded = |axes: &Axes| Axes::new(axes.iter().map(|a| if is_row(a) { all.clone() } else { a.clone() }));
    let mut new = region.clone();
    new.domain = folded(&region.domain);
    new.body.iter_mut().for_each(|inst| inst.axes = folded(&inst.axes));
    new.inner = Some(all);
    (new, lines)
}

/// Whether weights, or their gradients, differ along `axis`: rows of a tile share theirs.
fn has_own_matrices(program: &Program, region: &Region, axis: &Axis) -> bool {
    let weights = region.body.iter().filter_map(|i| if let RegionOp::Linear(w) = i.op { Some(w.buffer) } else { None });
    let gradients =
        region.stores.iter().filter_map(|s| if let Store::Outer { buffer, .. } = s { Some(*buffer) } else { None });
    weights.chain(gradients).any(|b| program.buffer(b).shape.axes.contains(axis))
}
