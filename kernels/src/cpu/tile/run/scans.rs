//! What goes along the lines of a tile: cumulative sums, shifts and reductions of each.

use super::*;

impl Tile<'_> {
    pub(super) unsafe fn cumsum(&self, from: &[Place], out: Place, reverse: bool) {
        for (c, place) in from.iter().enumerate() {
            let (x, y) = (self.at(*place), self.at(out).wrapping_add(c * self.program.ld));
            for (first, rows) in self.lines(self.program.line) {
                // A long sum of single-precision sums would lose digits; to add up doubles takes no longer.
                let mut sum = 0.0f64;
                for i in 0..rows {
                    let r = first + if reverse { rows - 1 - i } else { i };
                    // SAFETY: rows of a full channel.
                    unsafe {
                        *y.add(r) = sum as f32;
                        sum += f64::from(*x.add(r));
                    }
                }
            }
            // SAFETY: padding rows of the same channel.
            unsafe { std::slice::from_raw_parts_mut(y.add(self.rows), self.padded - self.rows).fill(0.0) };
        }
    }

    pub(super) unsafe fn shift(&self, from: &[Place], out: Place, by: i64) {
        for (c, place) in from.iter().enumerate() {
            let (x, y) = (self.at(*place), self.at(out).wrapping_add(c * self.program.ld));
            for (first, rows) in self.lines(self.program.line) {
                for r in 0..rows {
                    let source = r as i64 - by;
                    let inside = (0..rows as i64).contains(&source);
                    // SAFETY: rows of a full channel.
                    unsafe { *y.add(first + r) = if inside { *x.add(first + source as usize) } else { 0.0 } };
                }
            }
            // SAFETY: padding rows of the same channel.
            unsafe { std::slice::from_raw_parts_mut(y.add(self.rows), self.padded - self.rows).fill(0.0) };
        }
    }

    pub(super) unsafe fn row_reduce(&self, kind: Reduction, x: &Value, out: Place, full: bool) {
        for c in 0..x.places.len() {
            if !full {
                // All lines of the tile are the same.
                let line = self.program.line.min(self.rows);
                // SAFETY: the output has one lane a channel.
                unsafe { *self.at(out).add(c) = self.total(kind, x, c, 0..line) };
                continue;
            }
            let out = self.at(out).wrapping_add(c * self.program.ld);
            for (first, rows) in self.lines(self.program.line) {
                // SAFETY: rows of a full channel.
                unsafe {
                    let total = self.total(kind, x, c, first..first + rows);
                    std::slice::from_raw_parts_mut(out.add(first), rows).fill(total);
                }
            }
            // SAFETY: padding rows of the same channel.
            unsafe { std::slice::from_raw_parts_mut(out.add(self.rows), self.padded - self.rows).fill(0.0) };
        }
    }
}
