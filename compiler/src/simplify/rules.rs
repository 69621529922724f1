//! Local rules: constants, algebra, broadcasts, channel picks.

use super::{fold, is_map};
use crate::graph::Tensor;
use crate::ops::add::Add;
use crate::ops::channel_sum::ChannelSum;
use crate::ops::div::Div;
use crate::ops::identity::{Reshape, StopGradient};
use crate::ops::mul::Mul;
use crate::ops::pick::Pick;
use crate::ops::reduce::{Broadcast, Reduce};
use crate::ops::sub::Sub;
use crate::ops::{Form, Reduction, custom::Custom};

/// A simpler tensor of the same shape and value, if a rule applies.
pub(super) fn rewrite(t: &Tensor) -> Option<Tensor> {
    let simpler = fold(t)
        .or_else(|| identity(t))
        .or_else(|| algebra(t))
        .or_else(|| drop_broadcast(t))
        .or_else(|| picks(t))
        .or_else(|| reductions(t))?;
    debug_assert_eq!(simpler.shape(), t.shape(), "a rule changed the shape of {t:?} to {simpler:?}");
    Some(simpler)
}

/// Markers that mean nothing once gradients are taken.
fn identity(t: &Tensor) -> Option<Tensor> {
    let x = t.inputs().first()?;
    if t.op_as::<StopGradient>().is_some() || t.op_as::<Custom>().is_some() {
        return Some(x.clone());
    }
    if t.op_as::<Reshape>().is_some() {
        if x.channels() == t.channels() {
            return Some(x.clone());
        }
        if x.op_as::<Reshape>().is_some() {
            return Some(x.inputs()[0].reshape(t.channels()));
        }
    }
    if t.op_as::<Broadcast>().is_some() && x.op_as::<Broadcast>().is_some() {
        return Some(x.inputs()[0].broadcast_to(t.axes()));
    }
    None
}

/// Gives `x` the axes and channels of `t`, if that only broadcasts.
fn like(x: &Tensor, t: &Tensor) -> Tensor {
    let x = if x.width() == 1 && t.width() > 1 { x.pick(&vec![0; t.width()]) } else { x.clone() };
    x.reshape(t.channels()).broadcast_to(t.axes())
}

/// The value of a constant, seen through broadcasts.
fn constant_value(t: &Tensor) -> Option<f64> {
    if t.op_as::<Broadcast>().is_some() || t.op_as::<Reshape>().is_some() {
        return constant_value(&t.inputs()[0]);
    }
    let v = t.as_constant()?;
    v.iter().all(|x| *x == v[0]).then_some(v[0])
}

fn algebra(t: &Tensor) -> Option<Tensor> {
    let (a, b) = (t.inputs().first()?, t.inputs().get(1)?);
    let (ca, cb) = (constant_value(a), constant_value(b));
    if is_map::<Add>(t) {
        match (ca, cb) {
            (_, Some(0.0)) => return Some(like(a, t)),
            (Some(0.0), _) => return Some(like(b, t)),
            _ => {}
        }
    }
    if is_map::<Sub>(t) && cb == Some(0.0) {
        return Some(like(a, t));
    }
    if is_map::<Div>(t) && cb == Some(1.0) {
        return Some(like(a, t));
    }
    if is_map::<Mul>(t) {
        match (ca, cb) {
            (_, Some(1.0)) => return Some(like(a, t)),
            (Some(1.0), _) => return Some(like(b, t)),
            // The gradient of an unused branch: exact zero, as if it had not been recorded.
            (Some(0.0), _) | (_, Some(0.0)) => return Some(like(&Tensor::scalar(0.0), t)),
            _ => {}
        }
        // Factors of one value collect: (x c) d = x (c d), as long as single precision holds the product.
        let (x, d) = if cb.is_some() { (a, b) } else { (b, a) };
        let d = constant_value(d)?;
        if is_map::<Mul>(x) {
            let (y, c) = (&x.inputs()[0], &x.inputs()[1]);
            let (y, c) = if constant_value(c).is_some() { (y, c) } else { (c, y) };
            if let Some(product) = constant_value(c).map(|c| c * d).filter(|p| (*p as f32).is_normal()) {
                return Some(like(&(y * product), t));
            }
        }
    }
    None
}

/// A pointwise op broadcasts by itself: an explicit broadcast of one operand is dropped where another has the axes.
fn drop_broadcast(t: &Tensor) -> Option<Tensor> {
    let pointwise = matches!(t.op().form(), Form::Pointwise(_) | Form::Pick(_));
    if !pointwise || t.inputs().iter().all(|i| i.op_as::<Broadcast>().is_none()) {
        return None;
    }
    let bare: Vec<Tensor> = t
        .inputs()
        .iter()
        .map(|i| if i.op_as::<Broadcast>().is_some() { i.inputs()[0].clone() } else { i.clone() })
        .collect();
    // The broadcast moves behind the op, towards its users.
    Some(Tensor::record_arc(t.op().clone(), bare).broadcast_to(t.axes()))
}

fn picks(t: &Tensor) -> Option<Tensor> {
    if let Some(sum) = t.op_as::<ChannelSum>()
        && sum.0.iter().all(|g| g.len() == 1)
    {
        let channels: Vec<usize> = sum.0.iter().map(|g| g[0] as usize).collect();
        return Some(t.inputs()[0].pick_as(&channels, t.channels()));
    }
    let pick = t.op_as::<Pick>()?;
    let straight = |operand: &Tensor, at: usize| {
        pick.pick.len() == operand.width() && (0..pick.pick.len()).all(|c| pick.pick[c] == (at as u32, c as u32))
    };
    if t.inputs().len() == 1 && straight(&t.inputs()[0], 0) {
        return Some(t.inputs()[0].reshape(t.channels()));
    }
    // Operands that nothing is picked from are dropped, if that loses no axes.
    let used: Vec<usize> = (0..t.inputs().len()).filter(|i| pick.pick.iter().any(|p| p.0 as usize == *i)).collect();
    if used.len() < t.inputs().len() {
        let kept: Vec<Tensor> = used.iter().map(|i| t.inputs()[*i].clone()).collect();
        let place = |old: u32| used.iter().position(|u| *u == old as usize).unwrap_or_default() as u32;
        let op = Pick {
            pick: pick.pick.iter().map(|p| (place(p.0), p.1)).collect(),
            channels: pick.channels,
            name: pick.name,
        };
        let narrower = Tensor::record_arc(std::sync::Arc::new(op), kept);
        return Some(narrower.broadcast_to(t.axes()));
    }
    // A pick of picks is one pick.
    if t.inputs().iter().any(|i| i.op_as::<Pick>().is_some() || i.op_as::<Reshape>().is_some()) {
        let mut operands: Vec<Tensor> = vec![];
        let mut at = |x: &Tensor| match operands.iter().position(|o| o.id() == x.id()) {
            Some(i) => i as u32,
            None => {
                operands.push(x.clone());
                operands.len() as u32 - 1
            }
        };
        let through = pick.pick.iter().map(|(operand, c)| {
            let x = &t.inputs()[*operand as usize];
            if let Some(inner) = x.op_as::<Pick>() {
                let (o, c) = inner.pick[*c as usize];
                (at(&x.inputs()[o as usize]), c)
            } else if x.op_as::<Reshape>().is_some() {
                (at(&x.inputs()[0]), *c)
            } else {
                (at(x), *c)
            }
        });
        let op = Pick { pick: through.collect(), channels: pick.channels, name: pick.name };
        return Some(Tensor::record_arc(std::sync::Arc::new(op), operands).broadcast_to(t.axes()));
    }
    None
}

/// Sums of what does not vary along the summed axis, and sums of sums.
fn reductions(t: &Tensor) -> Option<Tensor> {
    let reduce = t.op_as::<Reduce>().filter(|r| r.kind == Reduction::Sum)?;
    let x = &t.inputs()[0];
    if x.op_as::<Broadcast>().is_some() {
        let inner = &x.inputs()[0];
        let repeated = reduce.over.minus(inner.axes());
        if !repeated.is_empty() {
            let n = repeated.elements() as f64;
            let rest = inner.sum_over(&reduce.over.minus(&repeated));
            return Some((rest * n).broadcast_to(t.axes()));
        }
    }
    if let Some(inner) = x.op_as::<Reduce>().filter(|r| r.kind == Reduction::Sum) {
        return Some(x.inputs()[0].sum_over(&reduce.over.union(&inner.over)));
    }
    // sum(a c) = c sum(a) where c does not vary along the summed axes.
    if is_map::<Mul>(x) {
        let (a, b) = (&x.inputs()[0], &x.inputs()[1]);
        for (vary, fixed) in [(a, b), (b, a)] {
            let fixed_is_fixed = fixed.axes().minus(&reduce.over) == *fixed.axes();
            if fixed_is_fixed && reduce.over.is_subset(vary.axes()) && vary.width() >= fixed.width() {
                return Some(like(&(vary.sum_over(&reduce.over) * fixed), t));
            }
        }
    }
    None
}
