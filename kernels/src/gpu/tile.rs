//! Sizes of the tiles of matrix products, and which of them take the least time.

use super::direct::STEP;
use super::half::Matrices;
use super::layout::{Limits, SOFTWARE_TILES};
use std::ops::Range;

/// Invocations of a workgroup that every device can start.
const MOST_INVOCATIONS: u32 = 256;
/// Terms of sums after which writing them does not count.
const LONG: usize = 1024;

/// Sizes of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tile {
    /// Of the workgroup.
    pub m: u32,
    pub n: u32,
    /// Staged at a time.
    pub k: u32,
    /// Of an invocation, multiples of 4; or with matrices, of a subgroup, multiples of their side.
    pub own_m: u32,
    pub own_n: u32,
    pub matrices: Option<Matrices>,
    /// Stages of `m` that are on their way from memory at a time.
    pub ahead: u32,
    /// Whether an invocation has all `n`, and reads its `m` where they lie.
    pub direct: bool,
}

impl Tile {
    /// The tile for products of `[m, k]` and `[k, n]`, so many of them, that takes the least time.
    pub fn of(limits: &Limits, sizes: (usize, usize, usize), products: usize) -> Tile {
        Tile::timed(limits, sizes, products).0
    }

    /// The same, with its time, which compares with that of other sizes: what a processor computes one after the other, at
    /// least one tile, at the tile's rate.
    pub fn timed(limits: &Limits, (m, n, k): (usize, usize, usize), products: usize) -> (Tile, f64) {
        let time = |(t, rate): (Tile, f64)| {
            let workgroups = m.div_ceil(t.m as usize) * n.div_ceil(t.n as usize) * products;
            let each = (workgroups as f64 / f64::from(limits.workgroups)).max(1.0);
            (t, each * f64::from(t.m * t.n) / rate)
        };
        let all = Tile::candidates(limits, (m, n, k));
        // The last one fits in any case: of matrices, see [`Limits::matrices`].
        let (last, larger) = (all[all.len() - 1], &all[..all.len() - 1]);
        let others = larger.iter().skip(limits.tiles as usize).filter(|(t, _)| t.fits(limits));
        others.chain([&last]).map(|t| time(*t)).min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or(time(last))
    }

    /// Tiles and their rates, relative to each other.
    fn candidates(limits: &Limits, (m, n, k): (usize, usize, usize)) -> Vec<(Tile, f64)> {
        if limits.tiles == SOFTWARE_TILES && n > 16 {
            return vec![(Tile::direct(m, n, k), 1.0)];
        }
        if let Some(matrices) = limits.matrices()
            && n > 32
            && k >= 16
        {
            let tile = |m, n, own| Tile::of_matrices(matrices, m, n, own);
            let smallest = (Tile::smallest(matrices), 0.5);
            return match n {
                0..=64 => vec![(tile(128, 64, (4, 2)), 0.8), smallest],
                65..=128 => vec![(tile(256, 128, (4, 4)), 1.0), (tile(64, 128, (2, 4)), 0.8), smallest],
                // All columns at once: the other operand is then read once.
                _ => vec![(tile(128, 256, (4, 4)), 1.0), (tile(64, 128, (2, 4)), 0.8), smallest],
            };
        }
        let deep = match k {
            0..=4 => 4,
            5..=8 => 8,
            // A deeper tile of 256 rows would not fit into the 16 KiB that WebGPU guarantees.
            _ if n <= 4 => 8,
            _ => 16,
        };
        let tile = |m, n, k, own_m, own_n| Tile { m, n, k, own_m, own_n, matrices: None, ahead: 1, direct: false };
        match n {
            0..=4 => vec![(tile(256, 4, deep, 4, 4), 1.0)],
            5..=8 => vec![(tile(128, 8, deep, 4, 4), 1.0)],
            9..=16 => vec![(tile(128, 16, deep, 8, 4), 1.0)],
            17..=32 => vec![(tile(64, 32, deep, 8, 4), 1.0)],
            _ => {
                // Long sums write little.
                let largest = match k >= LONG {
                    true => (tile(128, 128, deep, 8, 8), 1.0),
                    false => (tile(128, 64, deep.min(8), 8, 8), 0.9),
                };
                vec![largest, (tile(64, 64, deep, 8, 8), 0.84), (tile(32, 32, deep, 4, 4), 0.5)]
            }
        }
    }

    /// The smallest tile of matrices, which must fit where they are used.
    pub fn smallest(matrices: Matrices) -> Tile {
        Tile::of_matrices(matrices, 64, 64, (2, 2))
    }

    /// A tile of matrices, with the block of a subgroup in matrices.
    fn of_matrices(matrices: Matrices, m: u32, n: u32, own: (u32, u32)) -> Tile {
        let (own_m, own_n) = (own.0 * matrices.side, own.1 * matrices.side);
        Tile { m, n, k: 32, own_m, own_n, matrices: Some(matrices), ahead: 1, direct: false }
    }

    /// Whether a device can start its workgroups.
    pub fn fits(&self, limits: &Limits) -> bool {
        self.bytes() <= limits.max_workgroup_bytes && self.starts()
    }

    /// Whether a workgroup has no more invocations than any device starts.
    pub fn starts(&self) -> bool {
        self.invocations() <= MOST_INVOCATIONS
    }

    /// A tile for drivers in software.
    fn direct(m: usize, n: usize, k: usize) -> Tile {
        const MOST_N: usize = 32;
        let n = n.div_ceil(n.div_ceil(MOST_N)).next_multiple_of(4) as u32;
        let (m, own_m) = match m {
            0..=32 => (32, 4),
            33..=64 => (64, 8),
            65..=128 => (128, 8),
            _ => (256, 8),
        };
        let k = k.next_multiple_of(STEP as usize).min(32) as u32;
        Tile { m, n, k, own_m, own_n: n, matrices: None, ahead: 1, direct: true }
    }

    /// Memory that a workgroup shares.
    fn bytes(&self) -> u32 {
        match self.matrices {
            // Staged, and what the columns' totals pass through.
            None => {
                let vectors = if self.direct { 0 } else { self.m / 4 + 1 } + self.n / 4 + 1;
                self.k * vectors * 16 + self.n * (self.m / self.own_m) * 4
            }
            Some(Matrices { side, subgroup }) => {
                let staged = (self.m + self.n) * (self.k / 4 + 2) * 8;
                staged + self.invocations() / subgroup * side * (self.strip(side) / 4 + 1) * 16
            }
        }
    }

    /// Rows of sums that a subgroup passes through workgroup memory at a time: of two matrices.
    pub fn strip(&self, side: u32) -> u32 {
        self.own_m.min(2 * side)
    }

    /// Parts of the tile's m over which values are combined.
    pub fn parts(&self) -> u32 {
        if self.matrices.is_some() { self.m / self.own_m } else { 1 }
    }

    /// Terms that the loop over them takes at a time.
    pub fn turn(&self) -> u32 {
        self.k * self.ahead
    }

    pub fn invocations(&self) -> u32 {
        (self.m / self.own_m) * (self.n / self.own_n) * self.matrices.map_or(1, |m| m.subgroup)
    }
}

/// Columns of products, of sizes as for [`Tile::of`] and of so many terms each, that one kernel computes each: the few after the
/// last whole tile get one of their own where that saves more than it takes to start.
pub(super) fn split(
    limits: &Limits,
    (m, columns, k): (usize, usize, usize),
    products: usize,
    terms: usize,
) -> Vec<Range<usize>> {
    const FEW: usize = 16;
    /// Multiply-adds of a processor in the time of a kernel that has little to do.
    const START: f64 = 1e6;
    let rest = columns % 64;
    let end = columns - rest;
    let time = |n| Tile::timed(limits, (m, n, k), products).1;
    let start = START / terms as f64;
    let apart = end > 0 && (1..=FEW).contains(&rest) && time(end) + time(rest) + start < time(columns);
    let end = if apart { end } else { columns };
    [0..end, end..columns].into_iter().filter(|r| !r.is_empty()).collect()
}
