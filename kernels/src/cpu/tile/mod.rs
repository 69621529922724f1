//! CPU tile programs: a region lowered to calls of the SIMD kernels.
//!
//! A tile is a stretch of the region's inner axis at one position of the outer axes, or several whole *lines* along it
//! (`fold`). Every value of the region lives in a scratch arena that stays in the L2 cache: *full* values channel by
//! channel with one lane a row, *uniform* values (which do not vary over the rows) one lane a channel. Picking channels costs nothing: a value is a list of
//! places, and picks share them.

mod allocate;
mod flat;
mod fold;
mod lower;
mod run;
mod temporaries;
mod values;

pub use flat::{Flat, FlatArg, split_flat};
pub use lower::lower;
pub use run::{Chunk, Memory, pack, run_tiles};

use crate::cpu::{Products, larger};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::plan::region::{BufferId, Weights};
use raygrad_compiler::scalar::Prim;

/// Rows of a tile with layers: the activations of a few 256-wide layers stay in L2.
const LAYER_ROWS: usize = 192;
/// Rows of a tile without layers.
const PLAIN_ROWS: usize = 1024;
/// Chunks a launch is cut into at most. Fixed, so that sums do not depend on the number of threads.
const MAX_CHUNKS: usize = 16;
/// Tiles that a chunk should have at least, if that leaves two chunks.
const CHUNK_TILES: usize = 4;
/// Channels from which an operand in pieces is multiplied piece by piece instead of being put together first.
const WIDE: usize = 64;
/// Sums that may follow one another in single precision, each rounded once more.
const SUMS: usize = 64;
/// Lanes that a pointwise program works on at a time: its temporaries stay in L1.
const BLOCK: usize = 512;

/// How a buffer is addressed from a position of the domain: `channel * elements + outer . index + lines . index of the
/// line + inner * row of the line`.
#[derive(Clone, Debug)]
pub struct View {
    pub buffer: BufferId,
    /// Lanes between channels.
    pub elements: usize,
    /// Stride of every outer axis.
    pub outer: Vec<usize>,
    /// Size and stride of every axis whose positions are lines, outermost first.
    pub lines: Vec<(usize, usize)>,
    /// Stride of the inner axis; 0 where the buffer lacks it.
    pub inner: usize,
}

impl View {
    /// Lane of channel 0 at a row, of rows in lines of `line`.
    fn lane(&self, position: &[usize], row: usize, line: usize) -> usize {
        let mut lane = position.iter().zip(&self.outer).map(|(p, s)| p * s).sum::<usize>() + row % line * self.inner;
        let mut index = row / line;
        for (size, stride) in self.lines.iter().rev() {
            lane += index % size * stride;
            index /= size;
        }
        lane
    }

    /// Whether lanes are evenly spaced from line to line too.
    fn is_even(&self, line: usize) -> bool {
        let mut next = line * self.inner;
        self.lines.iter().rev().all(|(size, stride)| std::mem::replace(&mut next, size * stride) == *stride)
    }
}

/// Where a channel of a value starts in the scratch arena, in lanes.
type Place = usize;

/// A value in the scratch arena.
#[derive(Clone, Debug, PartialEq)]
pub struct Value {
    pub places: Vec<Place>,
    /// Varies along the inner axis: one lane a row. Otherwise one lane.
    pub full: bool,
}

/// An operand of a pointwise run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RunArg {
    /// One lane for each lane of the run.
    Lanes(Place),
    /// One lane for all.
    Splat(Place),
}

/// A pointwise program applied to consecutive lanes.
#[derive(Clone, Debug)]
pub struct Run {
    pub out: Place,
    /// Channels of the run; full channels are a row stride apart.
    pub channels: usize,
    pub args: Vec<RunArg>,
}

/// Where an instruction of a pointwise program reads.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Source {
    Arg(u8),
    Const(u32),
    Temp(u8),
}

/// A scalar program with its temporaries assigned; the last instruction writes the run's output.
#[derive(Clone, Debug)]
pub struct LaneProgram {
    pub code: Vec<(Prim, [Source; 3], u8)>,
    pub temps: usize,
}

/// What happens to a layer's output before it is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LayerEpilogue {
    None,
    Relu,
    /// Zero where the value at this place is not positive.
    Mask(Place),
}

/// A layer on a tile.
#[derive(Clone, Debug)]
pub struct Layer {
    pub x: Place,
    pub contraction: usize,
    /// Index of its packed weights.
    pub pack: usize,
    pub bias: Option<Place>,
    /// Adds to what is there.
    pub accumulate: bool,
    pub epilogue: LayerEpilogue,
    pub out: Place,
    pub outputs: usize,
    pub full: bool,
}

/// One operation on a tile.
#[derive(Clone, Debug)]
pub enum TileOp {
    Load {
        view: View,
        to: Place,
        channels: usize,
        full: bool,
    },
    Map {
        program: LaneProgram,
        runs: Vec<Run>,
        full: bool,
    },
    /// `out[j] = sum of from[group[j]]`, channel lists flattened.
    ChannelSum {
        from: Vec<Place>,
        groups: Vec<Vec<u32>>,
        out: Place,
        full: bool,
    },
    ChannelMax {
        from: Vec<Place>,
        out: Place,
        full: bool,
    },
    /// Puts channels next to each other for a kernel that needs them so.
    Gather {
        from: Vec<Place>,
        from_full: Vec<bool>,
        to: Place,
        full: bool,
    },
    Layer(Layer),
    RowLinear {
        x: Value,
        w: Value,
        rows: usize,
        columns: usize,
        transposed: bool,
        out: Place,
        full: bool,
    },
    RowOuter {
        x: Value,
        d: Value,
        out: Place,
        full: bool,
    },
    CumSum {
        from: Vec<Place>,
        out: Place,
        reverse: bool,
    },
    Shift {
        from: Vec<Place>,
        out: Place,
        by: i64,
    },
    /// Reduction over the rows of each line: one lane a channel, or the same for all rows of a line.
    RowReduce {
        kind: Reduction,
        x: Value,
        out: Place,
        full: bool,
    },
    /// Position along an axis.
    Index {
        of: Position,
        out: Place,
    },
    Take {
        view: View,
        axis_stride: usize,
        axis_size: usize,
        index: Value,
        out: Place,
        channels: usize,
        full: bool,
    },
    SymEig {
        n: usize,
        from: Vec<Place>,
        out: Place,
        full: bool,
    },
    Store(TileStore),
}

/// A position along an axis of the domain.
#[derive(Clone, Copy, Debug)]
pub enum Position {
    /// Along an outer axis, by index.
    Outer(usize),
    /// `row / every % size`.
    Row { every: usize, size: usize },
}

/// How a tile's result reaches memory.
#[derive(Clone, Debug)]
pub enum TileStore {
    Write {
        value: Value,
        view: View,
    },
    /// Combined into the chunk's accumulator at `at`, laid out like the buffer.
    Reduce {
        kind: Reduction,
        value: Value,
        view: View,
        at: usize,
    },
    /// Accumulators in panels (see [`mod@super::outer`]), one per element of the buffer, at `at`.
    Outer {
        /// Stretches of x: place, first channel, channels.
        parts: Vec<(Place, usize, usize)>,
        k: usize,
        d: Place,
        n: usize,
        view: View,
        at: usize,
    },
    Scatter {
        value: Value,
        index: Value,
        axis_stride: usize,
        axis_size: usize,
        view: View,
        at: usize,
    },
}

/// An accumulator of a chunk, and what it becomes.
#[derive(Clone, Debug)]
pub struct Accumulator {
    pub at: usize,
    pub len: usize,
    pub kind: Reduction,
    pub buffer: BufferId,
    /// `(k, n, elements)` of blocked outer products; plain sums are laid out like the buffer.
    pub blocked: Option<(usize, usize, usize)>,
}

impl Accumulator {
    /// Before anything is accumulated.
    pub fn start(&self) -> f32 {
        match self.kind {
            Reduction::Sum => 0.0,
            Reduction::Max => f32::NEG_INFINITY,
        }
    }

    /// Accumulates what others have, lane by lane.
    pub fn combine(&self, to: &mut [f32], from: &[f32]) {
        match self.kind {
            Reduction::Sum => to.iter_mut().zip(from).for_each(|(t, f)| *t += *f),
            Reduction::Max => to.iter_mut().zip(from).for_each(|(t, f)| *t = larger(*t, *f)),
        }
    }
}

/// Weights to pack before a launch.
#[derive(Clone, Debug)]
pub struct Pack {
    pub weights: Weights,
    /// What multiplies them.
    pub products: Products,
    pub view: View,
    /// Where the panels of the first element start, and how far apart elements are.
    pub at: usize,
    pub len: usize,
    pub elements: usize,
}

/// A region as tile operations.
#[derive(Clone, Debug)]
pub struct TileProgram {
    /// Sizes of the outer axes.
    pub outer: Vec<usize>,
    /// Rows at a position of the outer axes: the size of the inner axis, times the lines.
    pub inner: usize,
    /// Rows of a line: the size of the inner axis.
    pub line: usize,
    /// Most rows of a tile: whole lines, if there are several.
    pub rows: usize,
    /// Lanes between channels of a full value.
    pub ld: usize,
    /// Lanes of scratch a thread needs, temporaries of pointwise programs included.
    pub scratch: usize,
    /// Where the temporaries of pointwise programs start.
    pub temps: usize,
    /// What matrix products of full values multiply, and where their scratch starts.
    pub products: Products,
    pub pairs: usize,
    pub constants: Vec<(Place, u32)>,
    pub ops: Vec<TileOp>,
    pub packs: Vec<Pack>,
    /// Lanes of packed weights.
    pub packed: usize,
    pub accumulators: Vec<Accumulator>,
    /// Lanes of one chunk's accumulators; if `direct`, there are none.
    pub accumulated: usize,
    /// Tiles of a batch, if a chunk has several: each is summed apart, in the second half of the accumulators, and then added
    /// to the first.
    pub batch: Option<usize>,
    /// Reductions over the inner axis alone go straight to their buffer: chunks end where a line ends.
    pub direct: bool,
    pub chunks: usize,
}

impl TileProgram {
    /// Tiles along the inner axis.
    pub fn segments(&self) -> usize {
        self.inner.div_ceil(self.rows)
    }
    /// Tiles in all.
    pub fn tiles(&self) -> usize {
        self.outer.iter().product::<usize>() * self.segments()
    }
    /// Tiles that complete the lines they touch.
    pub fn line_tiles(&self) -> usize {
        if self.line < self.inner { 1 } else { self.segments() }
    }
    /// Tiles of a batch, if what a chunk sums up is many numbers: about as many batches as numbers of each, and none of fewer
    /// rows than there are lanes to be added up.
    fn tiles_of_batch(&self) -> Option<usize> {
        let tiles = self.tiles().div_ceil(self.chunks);
        let lines = if self.line < self.inner { self.rows / self.line } else { 1 };
        let numbers = (tiles * lines).isqrt().max(SUMS);
        let batch = numbers.div_ceil(lines).max(self.accumulated.div_ceil(self.rows));
        (self.accumulated > 0 && batch < tiles).then_some(batch)
    }
    /// Tiles of chunk `c`.
    pub fn chunk_tiles(&self, c: usize) -> std::ops::Range<usize> {
        let unit = if self.direct { self.line_tiles() } else { 1 };
        let units = self.tiles() / unit;
        c * units / self.chunks * unit..(c + 1) * units / self.chunks * unit
    }
}
