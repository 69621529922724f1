//! Linear layers over operands with fewer axes.
//!
//! A layer over `[x, code]`, where `code` varies per frame only, is `x W1 + code W2`: the second product is taken once
//! per frame, not per row. The same holds backwards: the gradient of the code is `(sum of row gradients) W2^T`, and that
//! of its weights `code (sum of row gradients)`, so whatever sums first is moved inwards.

use super::is_map;
use crate::graph::{Axes, Channels, Tensor};
use crate::ops::add::Add;
use crate::ops::linear::Linear;
use crate::ops::outer::Outer;
use crate::ops::pick::Pick;
use crate::ops::reduce::{Broadcast, Reduce};
use crate::ops::{Form, Reduction};

pub(super) fn rewrite(t: &Tensor) -> Option<Tensor> {
    let simpler = forward(t)
        .or_else(|| slice_of_transposed(t))
        .or_else(|| sum_of_linear(t))
        .or_else(|| sum_of_linears(t))
        .or_else(|| weights(t))?;
    debug_assert_eq!(simpler.shape(), t.shape(), "a split changed the shape of {t:?} to {simpler:?}");
    Some(simpler)
}

/// Channels of a concatenation grouped by the axes they vary along: the operand to use and the positions it takes.
fn groups_by_axes(x: &Tensor) -> Option<Vec<(Tensor, Vec<usize>)>> {
    let pick = x.op_as::<Pick>()?;
    let axes_of = |operand: u32| x.inputs()[operand as usize].axes();
    let mut sets: Vec<&Axes> = vec![];
    for (operand, _) in pick.pick.iter() {
        if !sets.contains(&axes_of(*operand)) {
            sets.push(axes_of(*operand));
        }
    }
    if sets.len() < 2 {
        return None;
    }
    let group = |axes: &Axes| {
        let positions: Vec<usize> = (0..pick.pick.len()).filter(|p| axes_of(pick.pick[*p].0) == axes).collect();
        let mut operands: Vec<Tensor> = vec![];
        let chosen = positions.iter().map(|p| {
            let (operand, channel) = pick.pick[*p];
            let operand = &x.inputs()[operand as usize];
            let at = operands.iter().position(|o| o.id() == operand.id()).unwrap_or_else(|| {
                operands.push(operand.clone());
                operands.len() - 1
            });
            (at as u32, channel)
        });
        let op = Pick { pick: chosen.collect(), channels: Channels::Vector(positions.len()), name: "concat" };
        (Tensor::record_arc(std::sync::Arc::new(op), operands), positions)
    };
    Some(sets.into_iter().map(group).collect())
}

/// Rows `positions` of a weight matrix.
fn rows(w: &Tensor, positions: &[usize]) -> Tensor {
    let Channels::Matrix(_, out) = w.channels() else { unreachable!("weights are a matrix") };
    let channels: Vec<usize> = positions.iter().flat_map(|r| (0..out).map(move |o| r * out + o)).collect();
    w.pick_as(&channels, (positions.len(), out))
}

/// `[x, code] W = x W1 + code W2`.
fn forward(t: &Tensor) -> Option<Tensor> {
    t.op_as::<Linear>().filter(|l| !l.transposed)?;
    let (x, w) = (&t.inputs()[0], &t.inputs()[1]);
    if x.op_as::<Broadcast>().is_some() {
        return Some(x.inputs()[0].linear(w).broadcast_to(t.axes()));
    }
    let parts = groups_by_axes(x)?;
    let products = parts.iter().map(|(part, positions)| part.linear(&rows(w, positions)));
    products.reduce(|a, b| a + b).map(|s| s.broadcast_to(t.axes()))
}

/// Some channels of `d W^T` need only those rows of W.
fn slice_of_transposed(t: &Tensor) -> Option<Tensor> {
    let pick = t.op_as::<Pick>().filter(|_| t.inputs().len() == 1)?;
    let product = &t.inputs()[0];
    product.op_as::<Linear>().filter(|l| l.transposed)?;
    let positions: Vec<usize> = pick.pick.iter().map(|p| p.1 as usize).collect();
    let ascending = positions.windows(2).all(|w| w[0] + 1 == w[1]);
    if !ascending || positions.len() >= product.width() {
        return None;
    }
    Some(product.inputs()[0].linear_transposed(&rows(&product.inputs()[1], &positions)).reshape(t.channels()))
}

/// A sum over axes commutes with a linear map whose weights do not vary along them.
fn sum_of_linear(t: &Tensor) -> Option<Tensor> {
    let over = &t.op_as::<Reduce>().filter(|r| r.kind == Reduction::Sum)?.over;
    let product = &t.inputs()[0];
    let Form::Linear { transposed } = product.op().form() else { return None };
    let (x, w) = (&product.inputs()[0], &product.inputs()[1]);
    if w.axes().iter().any(|a| over.contains(a)) || !over.is_subset(x.axes()) {
        return None;
    }
    Some(Tensor::record(Linear { transposed }, &[&x.sum_over(over), w]))
}

/// The sum of some channels of added products, as of a code that enters several layers, is added after summing each.
fn sum_of_linears(t: &Tensor) -> Option<Tensor> {
    let over = &t.op_as::<Reduce>().filter(|r| r.kind == Reduction::Sum)?.over;
    let summed = &t.inputs()[0];
    let pick = summed.op_as::<Pick>().filter(|_| summed.inputs().len() == 1);
    let added = if pick.is_some() { &summed.inputs()[0] } else { summed };
    let products = terms(added)?;
    let each = products.into_iter().map(|product| {
        let part = match pick {
            Some(_) => Tensor::record_arc(summed.op().clone(), vec![product]),
            None => product,
        };
        part.sum_over(over)
    });
    each.reduce(|a, b| a + b)
}

/// The layers of as many axes and channels whose sum this is, if it is one.
fn terms(t: &Tensor) -> Option<Vec<Tensor>> {
    if !is_map::<Add>(t) {
        return None;
    }
    let mut all = vec![];
    for x in t.inputs() {
        match x.op().form() {
            _ if (x.axes(), x.width()) != (t.axes(), t.width()) => return None,
            Form::Linear { .. } if x.inputs()[0].axes() == t.axes() => all.push(x.clone()),
            _ => all.extend(terms(x)?),
        }
    }
    Some(all)
}

/// `sum x_i d_o` with x constant along some summed axes sums d first; a concatenated x gives its rows part by part.
fn weights(t: &Tensor) -> Option<Tensor> {
    let keep = &t.op_as::<Outer>()?.keep;
    let (x, d) = (&t.inputs()[0], &t.inputs()[1]);
    if x.op_as::<Broadcast>().is_some() || d.op_as::<Broadcast>().is_some() {
        let bare = |y: &Tensor| if y.op_as::<Broadcast>().is_some() { y.inputs()[0].clone() } else { y.clone() };
        let (bx, bd) = (bare(x), bare(d));
        if bx.axes().union(bd.axes()) == x.axes().union(d.axes()) {
            return Some(bx.outer(&bd, keep));
        }
    }
    let summed = |own: &Tensor, other: &Tensor| own.axes().minus(other.axes()).minus(keep);
    let (only_d, only_x) = (summed(d, x), summed(x, d));
    if !only_d.is_empty() {
        return Some(x.outer(&d.sum_over(&only_d), keep));
    }
    if !only_x.is_empty() {
        return Some(x.sum_over(&only_x).outer(d, keep));
    }
    let parts = groups_by_axes(x)?;
    let out = d.width();
    // A part may lack axes that are kept: its block is the same along them.
    let kept = |part: &Tensor| Axes::new(keep.iter().filter(|a| part.axes().union(d.axes()).contains(a)).cloned());
    let blocks: Vec<Tensor> = parts.iter().map(|(part, _)| part.outer(d, &kept(part))).collect();
    let mut pick = vec![(0, 0); x.width() * out];
    for (block, (_, positions)) in parts.iter().enumerate() {
        for (i, row) in positions.iter().enumerate() {
            for o in 0..out {
                pick[row * out + o] = (block as u32, (i * out + o) as u32);
            }
        }
    }
    if blocks.len() == 1 {
        return None;
    }
    let op = Pick { pick: pick.into(), channels: t.channels(), name: "concat" };
    Some(Tensor::record_arc(std::sync::Arc::new(op), blocks).broadcast_to(t.axes()))
}
