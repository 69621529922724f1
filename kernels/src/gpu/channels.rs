//! Channels by formula: which input channels an output channel takes, as a few runs of arithmetic sequences, so that a
//! kernel can compute "channel c" for a c known only when it runs.

use raygrad_compiler::plan::region::{InstId, Region, RegionOp};

/// Most runs of a choice of channels for which a kernel branches.
const MAX_RUNS: usize = 24;
/// Most terms of a sum in a run.
const MAX_TERMS: usize = 8;
/// Longest list of constants that a kernel selects from.
pub(super) const MAX_TABLE: usize = 8;

/// Output channels `first..end`: the sum of `terms`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Run {
    pub first: u32,
    pub end: u32,
    pub terms: Vec<Term>,
}

/// Channel `base + slope * (c - first)` of an operand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Term {
    pub operand: usize,
    pub base: u32,
    pub slope: i64,
}

/// Runs of an output whose channel `c` is the sum of the (operand, channel) pairs `terms(c)`.
fn runs(channels: usize, terms: impl Fn(usize) -> Vec<(usize, u32)>) -> Vec<Run> {
    let mut all: Vec<Run> = vec![];
    for c in 0..channels {
        let next = terms(c);
        let c = c as u32;
        if let Some(run) = all.last_mut()
            && run.terms.len() == next.len()
            && run.terms.iter().zip(&next).all(|(t, n)| t.operand == n.0)
        {
            let offset = (c - run.first) as i64;
            if offset == 1 {
                for (t, n) in run.terms.iter_mut().zip(&next) {
                    t.slope = n.1 as i64 - t.base as i64;
                }
                run.end = c + 1;
                continue;
            }
            if run.terms.iter().zip(&next).all(|(t, n)| t.base as i64 + t.slope * offset == n.1 as i64) {
                run.end = c + 1;
                continue;
            }
        }
        let terms = next.into_iter().map(|(operand, base)| Term { operand, base, slope: 0 }).collect();
        all.push(Run { first: c, end: c + 1, terms });
    }
    all
}

/// Runs of an instruction that chooses or sums channels.
pub(super) fn runs_of(op: &RegionOp) -> Option<Vec<Run>> {
    match op {
        RegionOp::Pick(pick) => Some(runs(pick.len(), |c| vec![(pick[c].0 as usize, pick[c].1)])),
        RegionOp::ChannelSum(groups) => Some(runs(groups.len(), |c| groups[c].iter().map(|g| (0, *g)).collect())),
        _ => None,
    }
}

/// First and step of a list of channels that is an arithmetic sequence.
pub(super) fn sequence(list: &[u32]) -> Option<(u32, i64)> {
    let (first, second) = (*list.first()?, *list.get(1)?);
    let step = second as i64 - first as i64;
    list.iter().enumerate().all(|(i, c)| *c as i64 == first as i64 + step * i as i64).then_some((first, step))
}

/// First and step of integers `first + c * step` (wrapping).
pub(super) fn affine(bits: &[u32]) -> Option<(u32, u32)> {
    let step = bits.get(1)?.wrapping_sub(bits[0]);
    bits.windows(2).all(|w| w[1].wrapping_sub(w[0]) == step).then_some((bits[0], step))
}

/// Whether "channel c" of a value can be computed for a c known only when the kernel runs.
pub(super) fn is_indexable(region: &Region, id: InstId) -> bool {
    let inst = region.inst(id);
    if matches!(inst.op, RegionOp::SymEig { .. } | RegionOp::CumSum { .. } | RegionOp::Shift { .. }) {
        return false;
    }
    if inst.channels == 1 {
        return true;
    }
    let own = match &inst.op {
        RegionOp::Const(bits) => {
            bits.iter().all(|b| *b == bits[0]) || bits.len() <= MAX_TABLE || affine(bits).is_some()
        }
        RegionOp::Pick(_) | RegionOp::ChannelSum(_) => {
            runs_of(&inst.op).is_some_and(|r| r.len() <= MAX_RUNS && r.iter().all(|run| run.terms.len() <= MAX_TERMS))
        }
        _ => true,
    };
    own && inst.inputs.iter().all(|i| is_indexable(region, *i))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn concatenation_is_one_run_a_part() {
        let pick = RegionOp::Pick([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)].into());
        let term = |operand, base, slope| Term { operand, base, slope };
        let expected = vec![
            Run { first: 0, end: 3, terms: vec![term(0, 0, 1)] },
            Run { first: 3, end: 5, terms: vec![term(1, 0, 1)] },
        ];
        assert_eq!(runs_of(&pick), Some(expected));
    }

    #[test]
    fn adjoint_of_a_slice_has_empty_runs() {
        let groups = RegionOp::ChannelSum([vec![], vec![], vec![0], vec![1], vec![]].into());
        let runs = runs_of(&groups).expect("chooses channels");
        assert_eq!(
            runs.iter().map(|r| (r.first, r.end, r.terms.len())).collect::<Vec<_>>(),
            [(0, 2, 0), (2, 4, 1), (4, 5, 0)]
        );
    }

    #[test]
    fn sequences() {
        assert_eq!(sequence(&[5, 3, 1]), Some((5, -2)));
        assert_eq!(sequence(&[0, 1, 3]), None);
        assert_eq!(affine(&[7, 8, 9]), Some((7, 1)));
    }
}
