//! Runs a tile program: packs weights, then works through the tiles of a chunk.

mod scans;
mod transfer;

use super::*;
use crate::cpu::{Epilogue, Gemm, Isa, Operand, ROW_BLOCK, apply, gemm, pack_panels, raise};
use raygrad_compiler::ops::sym_eig::jacobi;
use std::ops::Range;

/// Base addresses of a program's buffers, by [`BufferId`].
#[derive(Clone, Copy)]
pub struct Memory<'a> {
    pub buffers: &'a [*mut f32],
}

// SAFETY: a `Memory` is only a list of addresses; every access through it is in an `unsafe fn` whose contract says that
// threads touch disjoint lanes.
unsafe impl Send for Memory<'_> {}
// SAFETY: as above.
unsafe impl Sync for Memory<'_> {}

/// What a thread works with for one chunk.
pub struct Chunk<'a> {
    pub memory: Memory<'a>,
    pub isa: Isa,
    /// Packed weights of the launch.
    pub packed: &'a [f32],
    /// `TileProgram::scratch` lanes of this thread.
    pub scratch: &'a mut [f32],
    /// `TileProgram::accumulated` lanes of this chunk, zeros (or -inf for maxima).
    pub accumulators: &'a mut [f32],
}

/// Packs one set of weights into `packed`.
///
/// # Safety
/// The addresses of `memory` are those of the program's buffers, nobody writes the weights meanwhile, and `isa` is supported.
pub unsafe fn pack(pack: &Pack, isa: Isa, memory: Memory, packed: &mut [f32]) {
    let w = &pack.weights;
    let lanes = w.rows * w.columns;
    let base = memory.buffers[w.buffer.0 as usize].wrapping_add(w.first * pack.elements);
    for e in 0..pack.elements {
        let panels = &mut packed[pack.at + e * pack.len..][..pack.len];
        if pack.elements == 1 {
            // SAFETY: the buffer holds the weights' channels one after the other, being of one element.
            let matrix = unsafe { std::slice::from_raw_parts(base, lanes) };
            pack_panels(isa, pack.products, matrix, w.rows, w.columns, w.transposed, panels);
        } else {
            // SAFETY: channel c of element e lies at c * elements + e.
            let matrix: Vec<f32> = (0..lanes).map(|c| unsafe { *base.add(c * pack.elements + e) }).collect();
            pack_panels(isa, pack.products, &matrix, w.rows, w.columns, w.transposed, panels);
        }
    }
}

/// Runs the tiles of chunk `c`.
///
/// # Safety
/// `memory` holds the addresses of the program's buffers, all of the planned size; `chunk.isa` is supported; no other
/// thread touches the lanes this chunk writes. Different chunks write different lanes, by construction of the plan.
pub unsafe fn run_tiles(program: &TileProgram, c: usize, chunk: &mut Chunk) {
    debug_assert!(chunk.scratch.len() >= program.scratch && chunk.accumulators.len() >= program.accumulated);
    for (place, bits) in &program.constants {
        chunk.scratch[*place] = f32::from_bits(*bits);
    }
    let all = program.chunk_tiles(c);
    let Some(batch) = program.batch else {
        // SAFETY: forwarded contract.
        return unsafe { run_batch(program, all, chunk, 0) };
    };
    let half = program.accumulated / 2;
    for first in all.clone().step_by(batch) {
        for a in &program.accumulators {
            chunk.accumulators[half + a.at..][..a.len].fill(a.start());
        }
        // SAFETY: forwarded contract.
        unsafe { run_batch(program, first..all.end.min(first + batch), chunk, half) };
        let (sums, batch) = chunk.accumulators.split_at_mut(half);
        for a in &program.accumulators {
            a.combine(&mut sums[a.at..][..a.len], &batch[a.at..][..a.len]);
        }
    }
}

/// Runs some tiles of a chunk, which accumulate from lane `at` on.
///
/// # Safety
/// As [`run_tiles`].
unsafe fn run_batch(program: &TileProgram, tiles: Range<usize>, chunk: &mut Chunk, at: usize) {
    let scratch = chunk.scratch.as_mut_ptr();
    let segments = program.segments();
    for t in tiles {
        let row0 = t % segments * program.rows;
        let mut rest = t / segments;
        let mut position = vec![0; program.outer.len()];
        for (p, size) in position.iter_mut().zip(&program.outer).rev() {
            *p = rest % size;
            rest /= size;
        }
        let rows = program.rows.min(program.inner - row0);
        let tile = Tile {
            program,
            memory: chunk.memory,
            isa: chunk.isa,
            packed: chunk.packed.as_ptr(),
            accumulators: chunk.accumulators[at..].as_mut_ptr(),
            scratch,
            row0,
            rows,
            padded: rows.next_multiple_of(ROW_BLOCK),
            position: &position,
        };
        for op in &program.ops {
            // SAFETY: the lowering places every value inside the scratch, and the caller vouches for the buffers.
            unsafe { tile.run(op) };
        }
    }
}

struct Tile<'a> {
    program: &'a TileProgram,
    memory: Memory<'a>,
    isa: Isa,
    packed: *const f32,
    accumulators: *mut f32,
    scratch: *mut f32,
    row0: usize,
    rows: usize,
    /// Rows rounded up for the matrix kernels.
    padded: usize,
    position: &'a [usize],
}

impl Tile<'_> {
    fn at(&self, place: Place) -> *mut f32 {
        self.scratch.wrapping_add(place)
    }

    /// The tile's lines: first row and rows of each.
    fn lines(&self, line: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let rows = self.rows;
        (0..rows).step_by(line).map(move |first| (first, line.min(rows - first)))
    }

    /// Stretches of rows along which the lanes of `view` are evenly spaced: first row, rows, lane of the first.
    fn runs(&self, view: &View) -> impl Iterator<Item = (usize, usize, usize)> {
        let line = self.program.line;
        let lines = self.lines(if view.is_even(line) { self.rows } else { line });
        lines.map(move |(first, rows)| (first, rows, view.lane(self.position, self.row0 + first, line)))
    }

    /// Index along the outer axes of an operand that does not vary over rows.
    fn element(&self, view: &View) -> usize {
        self.position.iter().zip(&view.outer).map(|(p, s)| p * s).sum()
    }

    fn buffer(&self, view: &View) -> *mut f32 {
        self.memory.buffers[view.buffer.0 as usize]
    }

    /// Lanes an operation works on, and the distance between output channels.
    fn extent(&self, full: bool) -> (usize, usize) {
        if full { (self.padded, self.program.ld) } else { (1, 1) }
    }

    /// Lane `row` of a value's channel, 0 for every row of a uniform one.
    unsafe fn lane(&self, value: &Value, channel: usize, row: usize) -> f32 {
        // SAFETY: places are inside the scratch, and a full channel has `ld` lanes.
        unsafe { *self.at(value.places[channel]).add(if value.full { row } else { 0 }) }
    }

    /// # Safety
    /// As [`run_tiles`].
    unsafe fn run(&self, op: &TileOp) {
        // SAFETY: every arm works on places that the lowering allocated with the extent used here, and on buffers
        // through views that stay inside them for positions of the domain.
        unsafe {
            match op {
                TileOp::Load { view, to, channels, full } => self.load(view, *to, *channels, *full),
                TileOp::Map { program, runs, full } => self.map(program, runs, *full),
                TileOp::ChannelSum { from, groups, out, full } => self.channel_sum(from, groups, *out, *full),
                TileOp::ChannelMax { from, out, full } => {
                    let (len, _) = self.extent(*full);
                    let out = self.at(*out);
                    std::ptr::copy(self.at(from[0]), out, len);
                    for place in &from[1..] {
                        raise(self.isa, out, self.at(*place), len);
                    }
                }
                TileOp::Gather { from, from_full, to, full } => {
                    let (len, step) = self.extent(*full);
                    for (c, (place, is_full)) in from.iter().zip(from_full).enumerate() {
                        let (source, to) = (self.at(*place), self.at(*to).add(c * step));
                        if *is_full == *full {
                            std::ptr::copy_nonoverlapping(source, to, len);
                        } else {
                            std::slice::from_raw_parts_mut(to, len).fill(*source);
                        }
                    }
                }
                TileOp::Layer(layer) => self.layer(layer),
                TileOp::RowLinear { x, w, rows, columns, transposed, out, full } => {
                    self.row_linear(x, w, (*rows, *columns), *transposed, *out, *full);
                }
                TileOp::RowOuter { x, d, out, full } => {
                    let (len, step) = self.extent(*full);
                    let n = d.places.len();
                    for c in 0..x.places.len() * n {
                        let (a, b) = (self.operand(x, c / n, *full), self.operand(d, c % n, *full));
                        let out = self.at(*out).add(c * step);
                        apply(self.isa, Prim::Mul, out, &[a, b, Operand::Splat(0)].into(), len);
                    }
                }
                TileOp::CumSum { from, out, reverse } => self.cumsum(from, *out, *reverse),
                TileOp::Shift { from, out, by } => self.shift(from, *out, *by),
                TileOp::RowReduce { kind, x, out, full } => self.row_reduce(*kind, x, *out, *full),
                TileOp::Index { of, out } => {
                    let out = self.at(*out);
                    match *of {
                        Position::Outer(axis) => *out = f32::from_bits(self.position[axis] as u32),
                        Position::Row { every, size } => {
                            for r in 0..self.padded {
                                *out.add(r) = f32::from_bits(((self.row0 + r) / every % size) as u32);
                            }
                        }
                    }
                }
                TileOp::Take { view, axis_stride, axis_size, index, out, channels, full } => {
                    self.take(view, (*axis_stride, *axis_size), index, *out, *channels, *full);
                }
                TileOp::SymEig { n, from, out, full } => self.sym_eig(*n, from, *out, *full),
                TileOp::Store(store) => self.store(store),
            }
        }
    }

    unsafe fn add(&self, out: *mut f32, a: *const f32, b: *const f32, len: usize) {
        let operands = [Operand::Lanes(a), Operand::Lanes(b), Operand::Splat(0)].into();
        // SAFETY: forwarded; the callers pass scratch places of `len` lanes.
        unsafe { apply(self.isa, Prim::Add, out, &operands, len) }
    }

    unsafe fn operand(&self, value: &Value, channel: usize, full: bool) -> Operand {
        let place = self.at(value.places[channel]);
        // SAFETY: the place is inside the scratch.
        if full && !value.full { Operand::Splat(unsafe { (*place).to_bits() }) } else { Operand::Lanes(place) }
    }

    unsafe fn map(&self, program: &LaneProgram, runs: &[Run], full: bool) {
        let temps = self.at(self.program.temps);
        for run in runs {
            let lanes = if full { (run.channels - 1) * self.program.ld + self.padded } else { run.channels };
            let mut start = 0;
            while start < lanes {
                let len = BLOCK.min(lanes - start);
                let arg = |a: u8| match run.args[a as usize] {
                    RunArg::Lanes(at) => Operand::Lanes(self.at(at).wrapping_add(start)),
                    // SAFETY: the place is inside the scratch.
                    RunArg::Splat(at) => Operand::Splat(unsafe { (*self.at(at)).to_bits() }),
                };
                // SAFETY: all operands have `len` lanes from `start`; an overwritten operand has the run's own places.
                unsafe { program.run(self.isa, arg, temps, self.at(run.out).wrapping_add(start), len) };
                start += len;
            }
        }
    }

    unsafe fn channel_sum(&self, from: &[Place], groups: &[Vec<u32>], out: Place, full: bool) {
        let (len, step) = self.extent(full);
        for (j, group) in groups.iter().enumerate() {
            let out = self.at(out).wrapping_add(j * step);
            // SAFETY: places of `len` lanes; the output overlaps no operand.
            unsafe {
                match group.split_first() {
                    None => std::slice::from_raw_parts_mut(out, len).fill(0.0),
                    Some((first, rest)) => {
                        std::ptr::copy_nonoverlapping(self.at(from[*first as usize]), out, len);
                        for c in rest {
                            self.add(out, out, self.at(from[*c as usize]), len);
                        }
                    }
                }
            }
        }
    }

    unsafe fn layer(&self, layer: &Layer) {
        let Layer { x, contraction, pack, bias, accumulate, epilogue, out, outputs, full } = *layer;
        let pack = &self.program.packs[pack];
        let panels = self.packed.wrapping_add(pack.at + self.element(&pack.view) * pack.len);
        if !full {
            // One row: a dot product per output, straight from the panels.
            for o in 0..outputs {
                let panel =
                    panels.wrapping_add(o / crate::cpu::panels::PANEL * contraction * crate::cpu::panels::PANEL);
                let term = |k: usize| {
                    // SAFETY: panel `o / 8` holds its 8 outputs for every step of the contraction; x has one lane a channel.
                    unsafe {
                        *panel.add(k * crate::cpu::panels::PANEL + o % crate::cpu::panels::PANEL) * *self.at(x).add(k)
                    }
                };
                // SAFETY: the output has one lane a channel.
                unsafe { *self.at(out).add(o) = (0..contraction).map(term).sum::<f32>() };
            }
            return;
        }
        let ld = self.program.ld;
        let args = Gemm {
            x: self.at(x),
            ldx: ld,
            contraction,
            products: pack.products,
            scratch: self.at(self.program.pairs),
            panels,
            outputs,
            bias: bias.map_or(std::ptr::null(), |b| self.at(b).cast_const()),
            accumulate,
            epilogue: match epilogue {
                LayerEpilogue::None => Epilogue::None,
                LayerEpilogue::Relu => Epilogue::Relu,
                LayerEpilogue::Mask(h) => Epilogue::Mask { h: self.at(h), ldh: ld },
            },
            y: self.at(out),
            ldy: ld,
            rows: self.padded,
        };
        // SAFETY: the lowering places x, y, h and bias with these strides; y is a fresh place.
        unsafe { gemm(self.isa, args) };
    }

    unsafe fn row_linear(&self, x: &Value, w: &Value, dims: (usize, usize), transposed: bool, out: Place, full: bool) {
        let (rows, columns) = dims;
        let (contraction, outputs) = if transposed { (columns, rows) } else { (rows, columns) };
        let (len, step) = self.extent(full);
        let product = self.at(self.program.temps);
        for o in 0..outputs {
            let out = self.at(out).wrapping_add(o * step);
            for k in 0..contraction {
                let (row, column) = if transposed { (o, k) } else { (k, o) };
                // SAFETY: scratch places of `len` lanes; the temporaries have room for a row of lanes.
                unsafe {
                    let (a, b) = (self.operand(x, k, full), self.operand(w, row * columns + column, full));
                    let to = if k == 0 { out } else { product };
                    apply(self.isa, Prim::Mul, to, &[a, b, Operand::Splat(0)].into(), len);
                    if k > 0 {
                        self.add(out, out, product, len);
                    }
                }
            }
        }
    }

    /// In f64 whatever the lanes are: rounding inside the iteration would be amplified by small gaps.
    unsafe fn sym_eig(&self, n: usize, from: &[Place], out: Place, full: bool) {
        let (len, step) = self.extent(full);
        let rows = if full { self.rows } else { 1 };
        for r in 0..len {
            let lane = |c: &Place| {
                // SAFETY: rows of the operand's channels; padding rows repeat the last one.
                unsafe { *self.at(*c).add(r.min(rows - 1)) as f64 }
            };
            let matrix: Vec<f64> = from.iter().map(lane).collect();
            let (values, vectors) = jacobi(&matrix, n);
            for (c, x) in values.iter().chain(&vectors).enumerate() {
                // SAFETY: rows of the output's channels.
                unsafe { *self.at(out).add(c * step + r) = *x as f32 };
            }
        }
    }
}
