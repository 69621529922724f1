//! Between a tile and memory: loads, lookups, and stores with what they combine.

use super::*;
use crate::cpu::{larger, outer, rows_max, rows_sum};

impl Tile<'_> {
    pub(super) unsafe fn load(&self, view: &View, to: Place, channels: usize, full: bool) {
        if !full {
            let from = self.buffer(view).wrapping_add(self.element(view));
            for c in 0..channels {
                // SAFETY: a lane of every channel of the buffer.
                unsafe { *self.at(to).add(c) = *from.add(c * view.elements) };
            }
            return;
        }
        for (first, rows, lane) in self.runs(view) {
            for c in 0..channels {
                // SAFETY: rows of the tile are inside the buffer.
                unsafe {
                    let from = self.buffer(view).add(lane + c * view.elements);
                    let to = self.at(to).add(c * self.program.ld + first);
                    match view.inner {
                        0 => std::slice::from_raw_parts_mut(to, rows).fill(*from),
                        1 => std::ptr::copy_nonoverlapping(from, to, rows),
                        step => (0..rows).for_each(|r| *to.add(r) = *from.add(r * step)),
                    }
                }
            }
        }
        for c in 0..channels {
            let padding = self.at(to).wrapping_add(c * self.program.ld + self.rows);
            // SAFETY: padding rows are set, not read.
            unsafe { std::slice::from_raw_parts_mut(padding, self.padded - self.rows).fill(0.0) };
        }
    }

    pub(super) unsafe fn take(
        &self,
        view: &View,
        (axis_stride, axis_size): (usize, usize),
        index: &Value,
        out: Place,
        channels: usize,
        full: bool,
    ) {
        let (len, step) = self.extent(full);
        let copy = |row: usize, lane: usize| {
            // SAFETY: the slot is inside the axis, and the lane without it inside the buffer.
            unsafe {
                let slot = (self.lane(index, 0, row).to_bits() as usize).min(axis_size - 1);
                let from = self.buffer(view).add(lane + slot * axis_stride);
                for c in 0..channels {
                    *self.at(out).add(c * step + row) = *from.add(c * view.elements);
                }
            }
        };
        if !full {
            return copy(0, self.element(view));
        }
        for (first, rows, lane) in self.runs(view) {
            (0..rows).for_each(|r| copy(first + r, lane + r * view.inner));
        }
        for c in 0..channels {
            let channel = self.at(out).wrapping_add(c * step);
            // SAFETY: rows of a full channel; padding rows repeat the last one.
            unsafe {
                let last = *channel.add(self.rows - 1);
                std::slice::from_raw_parts_mut(channel.add(self.rows), len - self.rows).fill(last);
            }
        }
    }

    /// Accumulator of a store: the chunk's own, or the buffer itself where chunks end with lines.
    fn accumulator(&self, view: &View, at: usize) -> *mut f32 {
        if self.program.direct {
            self.memory.buffers[view.buffer.0 as usize]
        } else {
            self.accumulators.wrapping_add(at)
        }
    }

    pub(super) unsafe fn store(&self, store: &TileStore) {
        // SAFETY: views stay inside their buffers for positions of the domain; accumulators have the planned lengths.
        unsafe {
            match store {
                TileStore::Write { value, view } => {
                    for (first, rows, lane) in self.runs(view) {
                        for c in 0..value.places.len() {
                            let to = self.buffer(view).add(lane + c * view.elements);
                            if value.full && view.inner == 1 {
                                std::ptr::copy_nonoverlapping(self.at(value.places[c]).add(first), to, rows);
                            } else {
                                (0..rows).for_each(|r| *to.add(r * view.inner) = self.lane(value, c, first + r));
                            }
                        }
                    }
                }
                TileStore::Reduce { kind, value, view, at } => self.reduce(*kind, value, view, *at),
                TileStore::Outer { parts, k, d, n, view, at } => {
                    let ld = self.program.ld;
                    let rows = self.rows.next_multiple_of(crate::cpu::outer::ROWS);
                    let g = self.accumulators.add(at + self.element(view) * crate::cpu::outer_len(*k, *n));
                    self.clear_padding(*d, *n, rows);
                    for (x, first, channels) in parts {
                        self.clear_padding(*x, *channels, rows);
                        let args = crate::cpu::Outer {
                            x: self.at(*x),
                            ldx: ld,
                            k: *channels,
                            first: *first,
                            channels: *k,
                            d: self.at(*d),
                            ldd: ld,
                            n: *n,
                            rows,
                            g,
                            products: self.program.products,
                            scratch: self.at(self.program.pairs),
                        };
                        outer(self.isa, args);
                    }
                }
                TileStore::Scatter { value, index, axis_stride, axis_size, view, at } => {
                    for (first, rows, lane) in self.runs(view) {
                        let base = self.accumulators.add(at + lane);
                        for r in 0..rows {
                            let slot = (self.lane(index, 0, first + r).to_bits() as usize).min(axis_size - 1);
                            let to = base.add(slot * axis_stride + r * view.inner);
                            for c in 0..value.places.len() {
                                *to.add(c * view.elements) += self.lane(value, c, first + r);
                            }
                        }
                    }
                }
            }
        }
    }

    /// Zeroes the padding of some channels up to `rows`: rows that are summed over must all count.
    unsafe fn clear_padding(&self, first: Place, channels: usize, rows: usize) {
        for c in 0..channels {
            let padding = self.at(first).wrapping_add(c * self.program.ld + self.rows);
            // SAFETY: a full channel has `ld` lanes, at least `rows`.
            unsafe { std::slice::from_raw_parts_mut(padding, rows - self.rows).fill(0.0) };
        }
    }

    unsafe fn reduce(&self, kind: Reduction, value: &Value, view: &View, at: usize) {
        let base = self.accumulator(view, at);
        let combine = |to: *mut f32, x: f32| {
            // SAFETY: a lane of this chunk's accumulator.
            unsafe {
                match kind {
                    Reduction::Sum => *to += x,
                    Reduction::Max => *to = larger(*to, x),
                }
            }
        };
        let ld = self.program.ld;
        let side_by_side = value.places.windows(2).all(|w| w[1] == w[0] + ld);
        let at_once = view.inner == 0 && view.elements == 1 && value.full && side_by_side && kind == Reduction::Sum;
        for (first, rows, lane) in self.runs(view) {
            let base = base.wrapping_add(lane);
            if at_once {
                let x = self.at(value.places[0]).wrapping_add(first);
                // SAFETY: all channels at once: `rows` lanes each, `ld` apart, and as many accumulator lanes.
                unsafe { rows_sum(self.isa, x, ld, value.places.len(), rows, base) };
                continue;
            }
            for c in 0..value.places.len() {
                let to = base.wrapping_add(c * view.elements);
                // SAFETY: `rows` lanes of a channel in the scratch.
                unsafe {
                    if view.inner > 0 {
                        (0..rows).for_each(|r| combine(to.add(r * view.inner), self.lane(value, c, first + r)));
                    } else {
                        combine(to, self.total(kind, value, c, first..first + rows));
                    }
                }
            }
        }
    }

    /// Reduction of a channel over some of the tile's rows; a uniform one counts for every row.
    pub(super) unsafe fn total(&self, kind: Reduction, value: &Value, channel: usize, rows: Range<usize>) -> f32 {
        let (x, ld, len) = (self.at(value.places[channel]), self.program.ld, rows.len());
        // SAFETY: rows of a channel in the scratch, or the one lane of a uniform value.
        unsafe {
            match kind {
                Reduction::Sum if value.full => {
                    let mut total = 0.0;
                    rows_sum(self.isa, x.add(rows.start), ld, 1, len, &mut total);
                    total
                }
                Reduction::Max if value.full => {
                    let mut total = f32::NEG_INFINITY;
                    rows_max(self.isa, x.add(rows.start), ld, 1, len, &mut total);
                    total
                }
                Reduction::Sum => *x * len as f32,
                Reduction::Max => *x,
            }
        }
    }
}
