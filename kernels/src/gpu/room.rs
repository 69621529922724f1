//! Where a workgroup of a resident network keeps what it keeps, and how many rows it takes at a time.

use super::phases::{Phase, Phases};
use raygrad_compiler::plan::region::InstId;
use std::collections::HashMap;

/// Rows of a tile, largest first.
const ROWS: [u32; 3] = [64, 32, SMALLEST];
pub(super) const SMALLEST: u32 = 16;
/// Rows that a tile's reading of the weights is worth.
const READING: u32 = 8;

pub(super) struct Tile {
    pub rows: u32,
    /// Lane of the workgroup's memory where a value begins; of those that it holds.
    pub offsets: HashMap<InstId, u32>,
    pub lanes: u32,
}

/// The tile that takes the least work for so many rows, of those whose values a workgroup can hold; or the smallest, with those
/// that fit. Where a line may be left before its end, tiles divide it.
pub(super) fn tile_of(phases: &Phases, (rows, left): (u32, bool), bytes: u32) -> Tile {
    let most = if left { SMALLEST.max(rows / 3) } else { u32::MAX };
    let kept = phases.kept.iter().filter(|k| **k).count();
    let lives = lives(phases);
    let place = |rows: u32| place(phases, &lives, rows, bytes / 4);
    let tiles = ROWS.into_iter().filter(|r| *r <= most).map(place);
    // Every tile reads all weights once, which costs as much as some rows more.
    let work = |t: &Tile| rows.div_ceil(t.rows) * (t.rows + READING);
    let whole = tiles.filter(|t| t.offsets.len() == kept).min_by_key(work);
    whole.unwrap_or_else(|| place(SMALLEST))
}

/// Values with when they are written and read last: phase n reads at 2n. A layer has read what it needs when it writes;
/// everything else writes as it reads.
fn lives(phases: &Phases) -> Vec<(InstId, usize, usize)> {
    let reads: Vec<_> = (0..phases.all.len()).map(|at| phases.reads(at)).collect();
    let mut lives = vec![];
    for (at, phase) in phases.all.iter().enumerate() {
        let from = 2 * at + usize::from(matches!(phase, Phase::Layer { .. }));
        for id in phase.results().into_iter().filter(|id| phases.kept[id.0 as usize]) {
            let last = (at..reads.len()).filter(|p| reads[*p].contains(&id)).map(|p| 2 * p).max();
            lives.push((id, from, last.unwrap_or(from).max(from)));
        }
    }
    lives
}

/// Places for what is kept, first come, first served.
fn place(phases: &Phases, lives: &[(InstId, usize, usize)], rows: u32, most: u32) -> Tile {
    let mut taken: Vec<(u32, u32, usize, usize)> = vec![];
    let mut offsets = HashMap::new();
    for (id, from, to) in lives.iter().copied() {
        let lanes = phases.region.inst(id).channels as u32 * rows;
        let mut beside: Vec<(u32, u32)> =
            taken.iter().filter(|t| t.2 <= to && from <= t.3).map(|t| (t.0, t.1)).collect();
        beside.sort();
        let offset = beside.iter().fold(0, |at, (first, end)| if at + lanes <= *first { at } else { at.max(*end) });
        if offset + lanes <= most {
            taken.push((offset, offset + lanes, from, to));
            offsets.insert(id, offset);
        }
    }
    Tile { rows, offsets, lanes: taken.iter().map(|t| t.1).max().unwrap_or(0) }
}
