//! Reverse-mode differentiation, graph to graph.
//!
//! Every op's rule returns IR, so a gradient can be differentiated again, to any order. Broadcasting has one adjoint for
//! all ops: a gradient is summed over the axes and channels that its operand lacks.

use crate::graph::{Channels, Tensor, topological, with_source};
use crate::scalar::DType;
use std::collections::{HashMap, HashSet};

/// Gradients of `loss`, summed over all its elements and channels, with respect to `wanted`: one tensor each, of the
/// same axes and channels. Any node may be wanted, not only inputs; what the loss does not depend on gets zeros.
#[track_caller]
pub fn grad(loss: &Tensor, wanted: &[&Tensor]) -> Vec<Tensor> {
    vjp(loss, &ones_like(loss), wanted)
}

/// Gradients of `sum(output * upstream)` with respect to `wanted`.
#[track_caller]
pub fn vjp(output: &Tensor, upstream: &Tensor, wanted: &[&Tensor]) -> Vec<Tensor> {
    if let Some(bad) = [output, upstream].into_iter().chain(wanted.iter().copied()).find(|t| t.error().is_some()) {
        return vec![bad.clone(); wanted.len()];
    }
    if let Some(bad) = [output].into_iter().chain(wanted.iter().copied()).find(|t| t.dtype() == DType::U32) {
        let problem = "whole numbers have no derivative";
        return vec![
            Tensor::misfit("grad", &[bad], problem, "differentiate before rounding to u32, or by a float");
            wanted.len()
        ];
    }
    let order = topological([output.clone()]);
    // Inputs of one name are one input, however often they were recorded.
    let (mut first, mut same) = (HashMap::new(), HashMap::new());
    for t in order.iter().chain(wanted.iter().copied()) {
        if let Some(name) = t.input_name() {
            same.insert(t.id(), *first.entry(name).or_insert(t.id()));
        }
    }
    let id = |t: &Tensor| same.get(&t.id()).copied().unwrap_or(t.id());
    let mut reaches: HashSet<u64> = wanted.iter().map(|t| id(t)).collect();
    for t in &order {
        if t.inputs().iter().any(|i| reaches.contains(&id(i))) {
            reaches.insert(t.id());
        }
    }
    let mut adjoint: HashMap<u64, Tensor> = HashMap::new();
    if reaches.contains(&id(output)) {
        adjoint.insert(id(output), with_source(output.source(), || fit_to(upstream.clone(), output)));
    }
    for t in order.iter().rev() {
        let Some(g) = adjoint.get(&t.id()).cloned() else { continue };
        let gradients = with_source(t.source(), || t.op().vjp(t.inputs(), t, &g));
        if gradients.len() != t.inputs().len() {
            let problem = format!("{} gradients for {} operands", gradients.len(), t.inputs().len());
            let refused =
                || Tensor::misfit(t.op().name(), &[t], problem, "a rule gives one gradient, or None, an operand");
            return vec![with_source(t.source(), refused); wanted.len()];
        }
        with_source(t.source(), || {
            for (input, dx) in t.inputs().iter().zip(gradients) {
                let Some(dx) = dx else { continue };
                if !reaches.contains(&id(input)) || input.dtype() == DType::U32 {
                    continue;
                }
                let dx = fit_to(dx, input);
                let total = match adjoint.get(&id(input)) {
                    Some(sum) => sum + &dx,
                    None => dx,
                };
                adjoint.insert(id(input), total);
            }
        });
    }
    wanted.iter().map(|w| adjoint.get(&id(w)).cloned().unwrap_or_else(|| zeros_like(w))).collect()
}

/// Derivative of `output` in the direction `tangents` of `inputs`: forward mode, as the derivative of the (linear) reverse
/// mode with respect to its upstream factor.
#[track_caller]
pub fn jvp(output: &Tensor, inputs: &[&Tensor], tangents: &[&Tensor]) -> Tensor {
    if inputs.len() != tangents.len() {
        let problem = format!("{} tangents for {} inputs", tangents.len(), inputs.len());
        return Tensor::misfit("jvp", &[output], problem, "give one tangent an input");
    }
    for (input, tangent) in inputs.iter().zip(tangents) {
        let fits = tangent.axes().is_subset(input.axes()) && [1, input.width()].contains(&tangent.width());
        if !fits && input.error().is_none() && tangent.error().is_none() {
            let problem = "a tangent (operand 2) does not fit its input (operand 1)";
            return Tensor::misfit(
                "jvp",
                &[input, tangent],
                problem,
                "give one direction, of the input's axes and channels",
            );
        }
    }
    // It is linear in this one, which no program ever sees; derivatives of derivatives have one each.
    let name = format!("jvp.upstream {}", output.id());
    let upstream = Tensor::input(name, crate::ops::input::Role::Data, output.shape().clone());
    let pulled = vjp(output, &upstream, inputs);
    let paired = pulled.iter().zip(tangents).map(|(g, t)| (g * *t).sum_channels().sum_over(g.axes()));
    let total = paired.reduce(|a, b| a + b).unwrap_or_else(|| Tensor::scalar(0.0));
    grad(&total, &[&upstream]).remove(0)
}

/// Sums a gradient over the axes and channels that `target` lacks, and gives it those it misses itself.
fn fit_to(g: Tensor, target: &Tensor) -> Tensor {
    let mut g = g.sum_over(&g.axes().minus(target.axes()));
    if target.channels().count() == 1 && g.channels().count() > 1 {
        g = g.sum_channels();
    } else if target.channels().count() > 1 && g.channels().count() == 1 {
        g = g.pick(&vec![0; target.width()]);
    }
    g.reshape(target.channels()).broadcast_to(target.axes())
}

fn ones_like(t: &Tensor) -> Tensor {
    constant_like(t, 1.0)
}

/// Zeros of the same axes and channels.
pub fn zeros_like(t: &Tensor) -> Tensor {
    constant_like(t, 0.0)
}

fn constant_like(t: &Tensor, value: f64) -> Tensor {
    with_source(t.source(), || {
        let c = match t.channels() {
            Channels::Vector(n) => Tensor::constant(&vec![value; n]),
            Channels::Matrix(r, c) => Tensor::constant_matrix(r, c, &vec![value; r * c]),
        };
        c.broadcast_to(t.axes())
    })
}
