//! Random graphs: steps of all ops over random axes, with gradients, several outputs and updates.
//!
//! A [`Recipe`] is a seed and sizes; the same recipe gives the same graph. Every node draws from a generator of its own,
//! so leaving one out hardly changes the others: a failing recipe is shrunk by leaving out nodes and dropping roots.
//!
//! Values stay where f32 and f64 can be compared. Every float has a known bound, and operands are mapped into the smooth
//! part of an op's domain. Floats that comparisons, maxima and roundings see are *exact*: multiples of a power of two
//! without rounding on any backend, compared half a unit off.

mod builder;
mod channels;
mod gathers;
mod layers;
mod pointwise;
mod roots;
mod rows;
mod shrink;

pub use shrink::shrink;

use crate::Rng;
use builder::Builder;
use raygrad_compiler::Step;
use raygrad_compiler::reference::Bindings;
use roots::FIRST_TERM;
use std::collections::BTreeSet;

/// How to make one random graph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recipe {
    pub seed: u64,
    /// Sizes of the axes; the last one is the axis that gathers point along.
    pub sizes: Vec<usize>,
    /// Nodes drawn, inputs included.
    pub nodes: usize,
    /// Nodes that are left out.
    pub without: BTreeSet<usize>,
    /// Outputs and updates that are left out, by position.
    pub dropped: BTreeSet<usize>,
}

/// A step and values of its inputs.
pub struct Graph {
    pub step: Step,
    pub bindings: Bindings,
}

/// Most elements of a domain: mostly a few tiles, sometimes many.
const SMALL: usize = 700;
const LARGE: usize = 9000;

const SIZES: [usize; 14] = [1, 1, 2, 3, 3, 5, 8, 17, 33, 33, 64, 200, 300, 1100];

impl Recipe {
    pub fn new(seed: u64) -> Recipe {
        let mut rng = Rng(seed);
        let most = if rng.chance(0.12) { LARGE } else { SMALL };
        let mut sizes = vec![];
        let mut elements = 1;
        for _ in 0..1 + rng.below(3) {
            let fitting: Vec<usize> = SIZES.into_iter().filter(|s| s * elements <= most).collect();
            sizes.push(fitting[rng.below(fitting.len())]);
            elements *= sizes[sizes.len() - 1];
        }
        // Long axes come first or last alike.
        for i in (1..sizes.len()).rev() {
            sizes.swap(i, rng.below(i + 1));
        }
        sizes.push([1, 3, 4, 40][rng.below(4)]);
        let nodes = 6 + rng.below(24);
        Recipe { seed, sizes, nodes, without: BTreeSet::new(), dropped: BTreeSet::new() }
    }

    /// A graph of the same kind with a third of the nodes and half of the roots: software GPUs take long over every kernel.
    pub fn small(seed: u64) -> Recipe {
        let recipe = Recipe::new(seed);
        let mut rng = Rng(seed);
        let dropped = (0..40).chain(FIRST_TERM..FIRST_TERM + 10).filter(|_| rng.chance(0.5)).collect();
        Recipe { nodes: 4 + recipe.nodes / 4, dropped, ..recipe }
    }

    pub fn build(&self) -> Graph {
        let mut builder = Builder::new(self);
        for node in 0..self.nodes {
            builder.rng = Rng(self.seed ^ (node as u64 + 1).wrapping_mul(0xD1B5_4A32_D192_ED03));
            let value = if self.without.contains(&node) { None } else { builder.node(node) };
            builder.values.push(value);
        }
        builder.rng = Rng(self.seed ^ 0x5851_F42D_4C95_7F2D);
        let step = builder.roots(&self.dropped);
        Graph { step, bindings: builder.bindings }
    }
}
