//! Channels by formula: which input channels an output channel takes, so that a kernel can compute "channel c" for a c
//! known only when it runs.
//!
//! Concatenations, slices, transposes, products of small matrices and their adjoints all choose channels that are linear
//! in the digits of c in some mixed radix, at least on a few ranges of c.

use raygrad_compiler::plan::region::{InstId, Region, RegionOp};

/// Most ranges for which a kernel branches.
const MAX_RUNS: usize = 24;
/// Most separate terms of a sum in a range.
const MAX_TERMS: usize = 8;
/// Most digits.
const MAX_DIGITS: usize = 4;
/// Longest list of constants that a kernel selects from.
pub(super) const MAX_TABLE: usize = 8;

/// Output channels `first..end`: the sum of `terms`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Run {
    pub first: u32,
    pub end: u32,
    pub terms: Vec<Term>,
}

/// The sum of `count` channels of an operand, `step` apart, from `from(c - first)` on.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Term {
    pub operand: usize,
    pub from: Linear,
    pub count: usize,
    pub step: u32,
}

/// `base + sum_d stride_d digit_d`, where digit 0 is the number modulo its radix, and so on. The last digit has no radix.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Linear {
    pub base: u32,
    /// Radix and stride of every digit, the fastest first.
    pub digits: Vec<(u32, i64)>,
}

/// A formula for a list of channels, if there is a short one.
fn linear(list: &[u32]) -> Option<Linear> {
    let base = list[0];
    let mut digits = vec![];
    let mut rest: Vec<u32> = list.to_vec();
    while rest.len() > 1 {
        if digits.len() == MAX_DIGITS {
            return None;
        }
        let step = rest[1] as i64 - rest[0] as i64;
        let fits = |length: &usize| {
            rest.len().is_multiple_of(*length)
                && rest
                    .chunks(*length)
                    .all(|c| c.iter().enumerate().all(|(i, x)| *x as i64 == c[0] as i64 + i as i64 * step))
        };
        let length = (2..=rest.len()).rev().find(fits)?;
        digits.push((length as u32, step));
        rest = rest.chunks(length).map(|c| c[0]).collect();
    }
    Some(Linear { base, digits })
}

/// What one output channel sums: an operand, its first channel, how many, and how far apart.
type Parts = Vec<(usize, u32, usize, u32)>;

fn parts(op: &RegionOp, c: usize) -> Parts {
    match op {
        RegionOp::Pick(pick) => vec![(pick[c].0 as usize, pick[c].1, 1, 0)],
        RegionOp::ChannelSum(groups) => match sequence(&groups[c]) {
            Some((first, step)) if step > 0 => vec![(0, first, groups[c].len(), step as u32)],
            _ => groups[c].iter().map(|x| (0, *x, 1, 0)).collect(),
        },
        _ => vec![],
    }
}

/// Ranges of the output of an instruction that chooses or sums channels.
pub(super) fn runs_of(op: &RegionOp) -> Vec<Run> {
    let channels = match op {
        RegionOp::Pick(pick) => pick.len(),
        RegionOp::ChannelSum(groups) => groups.len(),
        _ => 0,
    };
    let all: Vec<Parts> = (0..channels).map(|c| parts(op, c)).collect();
    let alike =
        |a: &Parts, b: &Parts| a.len() == b.len() && a.iter().zip(b).all(|(x, y)| (x.0, x.2, x.3) == (y.0, y.2, y.3));
    let formulas = |from: usize, to: usize| -> Option<Vec<Linear>> {
        (0..all[from].len()).map(|t| linear(&all[from..to].iter().map(|p| p[t].1).collect::<Vec<_>>())).collect()
    };
    let mut runs = vec![];
    let mut first = 0;
    while first < channels {
        let alike_end = (first..channels).find(|c| !alike(&all[first], &all[*c])).unwrap_or(channels);
        // The longest range with a formula: all of it, else as far as it goes in even steps.
        let even = |to: &usize| {
            all[first].iter().enumerate().all(|(t, _)| {
                let list: Vec<u32> = all[first..*to].iter().map(|p| p[t].1).collect();
                list.len() < 3 || sequence(&list).is_some()
            })
        };
        let (end, formula) = match formulas(first, alike_end) {
            Some(formula) => (alike_end, formula),
            None => {
                let end = (first + 1..=alike_end).take_while(even).last().unwrap_or(first + 1);
                (end, formulas(first, end).unwrap_or_default())
            }
        };
        let terms = all[first].iter().zip(formula);
        let terms = terms.map(|(p, from)| Term { operand: p.0, from, count: p.2, step: p.3 }).collect();
        runs.push(Run { first: first as u32, end: end as u32, terms });
        first = end;
    }
    runs
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

/// Per value of a region, whether "channel c" can be computed for a c known only when the kernel runs.
pub(super) fn indexable(region: &Region) -> Vec<bool> {
    indexable_from(region, |_| false)
}

/// The same where some values are held, so that any channel of them can be had.
pub(super) fn indexable_from(region: &Region, held: impl Fn(InstId) -> bool) -> Vec<bool> {
    let mut all: Vec<bool> = vec![];
    for inst in &region.body {
        let own = match &inst.op {
            RegionOp::SymEig { .. } | RegionOp::CumSum { .. } | RegionOp::Shift { .. } => false,
            _ if inst.channels == 1 => true,
            RegionOp::Const(bits) => {
                bits.iter().all(|b| *b == bits[0]) || bits.len() <= MAX_TABLE || affine(bits).is_some()
            }
            RegionOp::Pick(_) | RegionOp::ChannelSum(_) => {
                let runs = runs_of(&inst.op);
                runs.len() <= MAX_RUNS && runs.iter().all(|run| run.terms.len() <= MAX_TERMS)
            }
            _ => true,
        };
        all.push(own && (inst.channels == 1 || inst.inputs.iter().all(|i| held(*i) || all[i.0 as usize])));
    }
    all
}

/// Whether "channel c" of one value can.
pub(super) fn is_indexable(region: &Region, id: InstId) -> bool {
    indexable(region)[id.0 as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(operand: usize, base: u32, digits: &[(u32, i64)]) -> Term {
        Term { operand, from: Linear { base, digits: digits.to_vec() }, count: 1, step: 0 }
    }

    #[test]
    fn concatenation_is_one_run_a_part() {
        let pick = RegionOp::Pick([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)].into());
        let expected = vec![
            Run { first: 0, end: 3, terms: vec![line(0, 0, &[(3, 1)])] },
            Run { first: 3, end: 5, terms: vec![line(1, 0, &[(2, 1)])] },
        ];
        assert_eq!(runs_of(&pick), expected);
    }

    #[test]
    fn adjoint_of_a_slice_has_empty_runs() {
        let groups = RegionOp::ChannelSum([vec![], vec![], vec![0], vec![1], vec![]].into());
        let runs: Vec<_> = runs_of(&groups).iter().map(|r| (r.first, r.end, r.terms.len())).collect();
        assert_eq!(runs, [(0, 2, 0), (2, 4, 1), (4, 5, 0)]);
    }

    /// The operands of a product of 3 by 3 matrices, and the sum over the middle index.
    #[test]
    fn matrix_products_are_one_run() {
        let index = |f: fn(u32, u32, u32) -> u32| {
            RegionOp::Pick((0..27).map(|c| (0, f(c / 9, c / 3 % 3, c % 3))).collect::<Vec<_>>().into())
        };
        let left = runs_of(&index(|i, _, k| 3 * i + k));
        assert_eq!(left, vec![Run { first: 0, end: 27, terms: vec![line(0, 0, &[(3, 1), (3, 0), (3, 3)])] }]);
        let right = runs_of(&index(|_, j, k| 3 * k + j));
        assert_eq!(right, vec![Run { first: 0, end: 27, terms: vec![line(0, 0, &[(3, 3), (3, 1), (3, 0)])] }]);
        let sum = RegionOp::ChannelSum((0..9).map(|c| vec![3 * c, 3 * c + 1, 3 * c + 2]).collect::<Vec<_>>().into());
        let from = Linear { base: 0, digits: vec![(9, 3)] };
        assert_eq!(
            runs_of(&sum),
            vec![Run { first: 0, end: 9, terms: vec![Term { operand: 0, from, count: 3, step: 1 }] }]
        );
    }

    #[test]
    fn every_formula_gives_the_channels_it_stands_for() {
        for list in [
            vec![4, 2, 0, 5, 3, 1],
            vec![7],
            vec![0, 0, 1, 1, 2, 2, 9, 9],
            (0..64).map(|i| i % 8 * 8 + i / 8).collect(),
        ] {
            let op = RegionOp::Pick(list.iter().map(|c| (0, *c)).collect::<Vec<_>>().into());
            for run in runs_of(&op) {
                for c in run.first..run.end {
                    let mut rest = c - run.first;
                    let mut channel = run.terms[0].from.base as i64;
                    for (radix, stride) in &run.terms[0].from.digits {
                        channel += stride * (rest % radix) as i64;
                        rest /= radix;
                    }
                    assert_eq!(channel, list[c as usize] as i64, "{list:?}");
                }
            }
        }
    }

    #[test]
    fn sequences() {
        assert_eq!(sequence(&[5, 3, 1]), Some((5, -2)));
        assert_eq!(sequence(&[0, 1, 3]), None);
        assert_eq!(affine(&[7, 8, 9]), Some((7, 1)));
    }
}
