//! What is read back from a concatenation that a layer needs in memory anyway.
//!
//! A layer on a GPU reads its input from memory. Where that is a concatenation, its parts lie there, too: what comes after
//! the layer, such as the gradient of the rectifier before it, reads a part from there, and neither the part nor a mask
//! computed from it is stored beside the concatenation.

use super::cuts::{WIDE, resolve};
use crate::graph::{Tensor, topological, with_source};
use crate::ops::Form;
use crate::ops::pick::runs;
use std::collections::{HashMap, HashSet};

/// The same roots, with pointwise values that only what follows a stored concatenation needs computed from it.
pub(super) fn reread(roots: &[Tensor]) -> Vec<Tensor> {
    let order = topological(roots.iter().cloned());
    let mut users: HashMap<u64, Vec<&Tensor>> = HashMap::new();
    for t in &order {
        t.inputs().iter().for_each(|i| users.entry(i.id()).or_default().push(t));
    }
    let is_root = |t: &Tensor| roots.iter().any(|r| r.id() == t.id());
    // Per user and operand, the concatenation and the operand's first channel there.
    let mut replaced: HashMap<(u64, u64), (Tensor, usize)> = HashMap::new();
    let layers = order.iter().filter(|t| matches!(t.op().form(), Form::Linear { .. }));
    let read_by_layers: HashSet<u64> = layers.map(|t| resolve(&t.inputs()[0]).id()).collect();
    for whole in order.iter().filter(|t| t.inputs().len() > 1 && read_by_layers.contains(&t.id())) {
        let Form::Pick(pick) = whole.op().form() else { continue };
        let parts = parts(whole, &pick);
        if parts.is_empty() {
            continue;
        }
        let after = after(whole, &order);
        let follows = |t: &Tensor| after.contains(&t.id());
        for (part, first) in parts {
            for user in users.get(&part.id()).into_iter().flatten() {
                let later = users.get(&user.id()).is_some_and(|all| all.iter().all(|u| follows(u)));
                if matches!(user.op().form(), Form::Pointwise(_)) && !is_root(user) && (follows(user) || later) {
                    replaced.entry((user.id(), part.id())).or_insert((whole.clone(), first));
                }
            }
        }
    }
    if replaced.is_empty() {
        return roots.to_vec();
    }
    rebuild(roots, &replaced)
}

/// Wide computed operands of which a concatenation has all channels in order, with the first of them there.
fn parts(whole: &Tensor, pick: &[(u32, u32)]) -> Vec<(Tensor, usize)> {
    let (mut found, mut first) = (vec![], 0);
    for run in runs(pick) {
        let part = &whole.inputs()[run[0].0 as usize];
        let all = run[0].1 == 0 && run.len() == part.width() && part.axes() == whole.axes();
        if all && part.width() >= WIDE && part.op().form() != Form::Input {
            found.push((part.clone(), first));
        }
        first += run.len();
    }
    found
}

/// What is computed from `t`.
fn after(t: &Tensor, order: &[Tensor]) -> HashSet<u64> {
    let mut found = HashSet::from([t.id()]);
    for next in order {
        if next.inputs().iter().any(|i| found.contains(&i.id())) {
            found.insert(next.id());
        }
    }
    found.remove(&t.id());
    found
}

/// Records what depends on replaced operands anew, operands first: a concatenation can be younger than who now reads it.
fn rebuild(roots: &[Tensor], replaced: &HashMap<(u64, u64), (Tensor, usize)>) -> Vec<Tensor> {
    let mut done: HashMap<u64, Tensor> = HashMap::new();
    let mut stack: Vec<Tensor> = roots.to_vec();
    while let Some(t) = stack.pop() {
        if done.contains_key(&t.id()) {
            continue;
        }
        let read = |i: &Tensor| replaced.get(&(t.id(), i.id())).map_or(i.clone(), |(whole, _)| whole.clone());
        let missing: Vec<Tensor> = t.inputs().iter().map(read).filter(|o| !done.contains_key(&o.id())).collect();
        if !missing.is_empty() {
            stack.push(t);
            stack.extend(missing);
            continue;
        }
        let operand = |i: &Tensor| match replaced.get(&(t.id(), i.id())) {
            Some((whole, first)) => {
                let channels: Vec<usize> = (*first..first + i.width()).collect();
                with_source(t.source(), || done[&whole.id()].pick_as(&channels, i.channels()))
            }
            None => done[&i.id()].clone(),
        };
        let new = t.with_inputs(t.inputs().iter().map(operand).collect());
        done.insert(t.id(), new);
    }
    roots.iter().map(|r| done[&r.id()].clone()).collect()
}

#[cfg(test)]
mod tests {
    use crate::autodiff::grad;
    use crate::graph::{Axis, Shape, Tensor};
    use crate::ops::pick::concat;
    use crate::plan::{Buffer, BufferKind};
    use crate::scalar::DType;
    use crate::{Step, Target, compile};

    /// A rectified layer beside other channels, read by a second layer: the rectifier's mask is not stored.
    #[test]
    fn a_mask_is_computed_from_the_concatenation() {
        let row = Axis::new("row", 1000);
        let x = Tensor::data("x", Shape::new(&[&row], 70));
        let weights = [("v", 70, 80), ("w", 150, 90)];
        let [v, w] = weights.map(|(name, rows, columns)| Tensor::parameter(name, Shape::new(&[], (rows, columns))));
        for (asked, masks) in [(false, 0), (true, 1)] {
            let hidden = x.linear(&v).relu();
            let y = concat([&hidden, &x]).linear(&w);
            let loss = (&y * &y).sum_channels().sum(&[&row]);
            let names = ["dv", "dw"].map(str::to_string);
            let mut outputs: Vec<(String, Tensor)> = names.into_iter().zip(grad(&loss, &[&v, &w])).collect();
            // A mask that somebody asks for is written all the same.
            if asked {
                outputs.push(("mask".into(), hidden.less_than(&x.pick(&(0..70).collect::<Vec<_>>()).sum_channels())));
            }
            let program = compile(&Step { outputs, updates: vec![] }, &Target::gpu()).unwrap();
            let of = |output: bool| {
                let is = |b: &&Buffer| b.shape.dtype == DType::U32 && (b.kind == BufferKind::Output) == output;
                program.buffers.iter().filter(is).count()
            };
            assert_eq!((of(false), of(true)), (0, masks));
        }
    }
}
