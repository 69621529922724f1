//! Making a failing recipe small.

use super::Recipe;
use super::roots::FIRST_TERM;
use std::collections::BTreeSet;

/// The smallest recipe found that still fails: roots dropped, nodes left out, axes shortened, one thing at a time.
pub fn shrink(recipe: &Recipe, fails: impl Fn(&Recipe) -> bool) -> Recipe {
    let mut best = recipe.clone();
    loop {
        let before = best.clone();
        let all = Recipe { dropped: BTreeSet::new(), ..best.clone() }.build().step;
        // Whole tail first: most nodes after the failing one do not matter.
        for nodes in 1..best.nodes {
            let next = Recipe { nodes, ..best.clone() };
            if fails(&next) {
                best = next;
                break;
            }
        }
        for at in (0..all.outputs.len() + all.updates.len()).rev() {
            try_one(&mut best, &fails, |r| r.dropped.insert(at));
        }
        for part in 0..4 {
            try_one(&mut best, &fails, |r| r.dropped.insert(FIRST_TERM + part));
        }
        for at in (0..best.nodes).rev() {
            try_one(&mut best, &fails, |r| r.without.insert(at));
        }
        for at in 0..best.sizes.len() {
            for size in [1, 2, 3, 17] {
                let fewer = |r: &mut Recipe| size < r.sizes[at] && std::mem::replace(&mut r.sizes[at], size) != size;
                try_one(&mut best, &fails, fewer);
            }
        }
        if best == before {
            return best;
        }
    }
}

fn try_one(best: &mut Recipe, fails: &impl Fn(&Recipe) -> bool, change: impl Fn(&mut Recipe) -> bool) {
    let mut next = best.clone();
    if change(&mut next) && fails(&next) {
        *best = next;
    }
}
