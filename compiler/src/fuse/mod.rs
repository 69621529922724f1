//! Fusion: which ops share a launch, and what is written to memory between launches.
//!
//! A node's *domain* is the set of axes it loops over, its *depth* the number of cuts on the longest path to it. A cut is
//! forced where a value must be complete before it is used: after a reduction, before a gather's table or a layer's
//! weights, between domains, and, on a GPU, around wide layers. Nodes of one depth and domain form one region. Values
//! that are cheap to get from inputs are *free*: every region that needs them computes them itself.
//!
//! On a CPU a reduction over exactly the inner axis is also complete inside a tile that holds the whole axis, and what goes
//! back from it into the same domain needs no cut (see [`lines`]).
//!
//! What a region needs from an earlier region of the same domain is either stored or computed again, whatever takes less
//! time on the target (see [`store`]); only what is compared with its own maximum is always stored (see [`extremes`]). On a GPU,
//! parts of a stored concatenation are read back from it (see [`reread`]), and layers of
//! narrow networks need no cut (see [`resident`]).

mod build;
mod cuts;
mod extremes;
mod lines;
mod merge;
mod reread;
mod resident;
mod store;

pub use build::{Fused, Origin, fuse};
pub use resident::LINE_CHANNELS;

use crate::cost::Rates;
use crate::step::Step;

/// Most outputs of a layer of a resident network that is trained: weights and rows of wider ones do not fit into a workgroup side by
/// side.
const TRAINED: usize = 128;
/// The same of one that nothing goes back through: what a workgroup's invocations sum up in registers.
const RENDERED: usize = 256;

/// What fusion decides by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    pub kind: TargetKind,
    /// By which it is decided what takes longer, to store a value or to compute it again.
    pub rates: Rates,
    /// Memory for that: values of at most this many channels may be stored in any case,
    pub store_channels: usize,
    /// so may values of at most this many bytes,
    pub store_free_bytes: usize,
    /// and wider ones, as long as those of one region take no more bytes than this together.
    pub store_bytes: usize,
    /// Operations per element up to which values computed from inputs alone are free.
    pub free_flops: u64,
    /// Longest inner axis that is one tile in any case: reductions along it stay inside a tile; 0 where they never do.
    pub tile_rows: usize,
    /// Longest inner axis that becomes one tile for them if there are ...
    pub line_rows: usize,
    /// ... at least this many positions of the outer axes, so that there are still tiles for every thread.
    pub lines: usize,
    /// GPU: networks whose layers have at most this many outputs are resident; 0: none are.
    pub resident: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TargetKind {
    /// Resident tiles: a region holds any number of layers.
    Cpu,
    /// Layered: a region holds the layers of one depth and their pointwise epilogues; or resident, see [`Target::resident`].
    Gpu,
}

impl Target {
    pub fn cpu() -> Target {
        Target {
            kind: TargetKind::Cpu,
            rates: Rates::CPU,
            store_channels: 32,
            store_free_bytes: 1 << 18,
            store_bytes: 192 << 20,
            free_flops: 600,
            tile_rows: 192,
            line_rows: 1024,
            lines: 16,
            resident: 0,
        }
    }
    pub fn gpu() -> Target {
        Target {
            kind: TargetKind::Gpu,
            rates: Rates::GPU.single(),
            store_channels: usize::MAX,
            store_free_bytes: 0,
            store_bytes: 0,
            free_flops: 600,
            tile_rows: 0,
            line_rows: 0,
            lines: 0,
            resident: 0,
        }
    }

    /// The same with resident networks, as wide as is of use to a step. A CPU's tiles hold any in any case.
    pub fn with_resident(self, step: &Step) -> Target {
        match self.kind {
            TargetKind::Cpu => self,
            TargetKind::Gpu => Target { resident: if step.updates.is_empty() { RENDERED } else { TRAINED }, ..self },
        }
    }
}
