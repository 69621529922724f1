//! Operands of maxima that are compared with them later.
//!
//! The gradient of a maximum goes to the elements that equal it. Computed again in another launch, where other ops are fused with
//! it, an element may be rounded otherwise, equal no longer what it became, and lose its gradient. So the operand of a maximum
//! that is compared with it is stored and read wherever it is needed; on a CPU a tile that stores it takes the maximum, too.

use super::cuts::resolve;
use crate::graph::{Tensor, topological};
use crate::ops::channel_max::ChannelMax;
use crate::ops::compare::{Compare, Relation};
use crate::ops::pointwise::Map;
use crate::ops::{Form, Reduction, reduce::Reduce};
use std::collections::HashSet;

/// The computed nodes that are compared with maxima of themselves.
pub(super) fn compared(roots: &[Tensor]) -> HashSet<u64> {
    let equal = |t: &Tensor| t.op_as::<Map<Compare>>().is_some_and(|map| map.0.relation == Relation::Equal);
    let operand = |t: &Tensor| {
        let (x, most) = (resolve(&t.inputs()[0]), resolve(&t.inputs()[1]));
        let is_most = most.op_as::<ChannelMax>().is_some()
            || most.op_as::<Reduce>().is_some_and(|reduce| reduce.kind == Reduction::Max);
        let computed = !matches!(x.op().form(), Form::Input | Form::Const(_) | Form::Index { .. });
        (computed && is_most && resolve(&most.inputs()[0]).id() == x.id()).then(|| x.id())
    };
    topological(roots.iter().cloned()).iter().filter(|t| equal(t)).filter_map(operand).collect()
}
