//! Launches lowered to naga modules: WGSL to read and for the web, SPIR-V for Vulkan, and naga's IR for wgpu.
//!
//! | module | what |
//! |---|---|
//! | `builder`, `naming` | naga IR, statement by statement |
//! | `layout`, `half` | where buffers lie: a few arenas; what is stored in half precision |
//! | `memory` | a kernel being built: arenas bound, positions in the domain |
//! | `channels`, `eval`, `scalar`, `eigen` | values of a region at a position |
//! | `parts`, `stages` | a region cut into what one kind of kernel does, and long work into stages |
//! | `elements`, `reduce`, `chunks`, `scatter`, `scan`, `layer`, `outer` | the kinds of kernels |
//! | `tile`, `direct`, `sums`, `give`, `epilogue` | matrix products in tiles, and what is done with their sums |
//! | `resident`, `phases`, `room`, `resident_layer`, `resident_line`, `vanish` | whole narrow networks in a workgroup's memory |
//! | `peak` | kernels that measure a device |

mod builder;
mod channels;
mod chunks;
mod direct;
mod eigen;
mod elements;
mod epilogue;
mod eval;
mod give;
mod half;
mod homes;
mod layer;
mod layout;
mod memory;
mod naming;
mod outer;
mod parts;
mod peak;
mod phases;
mod position;
mod product;
mod reduce;
mod regions;
mod resident;
mod resident_layer;
mod resident_line;
mod room;
mod scalar;
mod scan;
mod scatter;
mod stages;
mod sums;
mod tile;
mod vanish;

pub use half::{Half, Matrices, Storage, storages};
pub use layout::{Arena, ArenaId, Inputs, Limits, Part, Place, SOFTWARE_TILES, TILES};

pub use peak::{copy, launches, matrix_products, multiply_adds};

use layout::Layout;
use raygrad_compiler::graph::Shape;
use raygrad_compiler::plan::Program;
use std::ops::Range;

/// A buffer that a kernel binds, at its position in the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    pub arena: ArenaId,
    pub writable: bool,
}

/// Lanes that a kernel may read or write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Access {
    pub arena: ArenaId,
    pub lanes: Range<u64>,
    pub write: bool,
}

impl Access {
    /// Whether the order of the two matters.
    fn conflicts(&self, other: &Access) -> bool {
        let overlap = self.lanes.start < other.lanes.end && other.lanes.start < self.lanes.end;
        self.arena == other.arena && overlap && (self.write || other.write)
    }
}

/// The numbers of kernels in groups, one after the other: kernels of a group do not wait for each other, and each is in the
/// first group after all that it has to wait for.
pub fn groups(kernels: &[Kernel]) -> Vec<Vec<usize>> {
    let waits = |a: &Kernel, b: &Kernel| a.accesses.iter().any(|x| b.accesses.iter().any(|y| x.conflicts(y)));
    let mut level: Vec<usize> = vec![];
    let mut groups: Vec<Vec<usize>> = vec![];
    for (i, kernel) in kernels.iter().enumerate() {
        let own = (0..i).filter(|j| waits(&kernels[*j], kernel)).map(|j| level[j] + 1).max().unwrap_or(0);
        level.push(own);
        if groups.len() == own {
            groups.push(vec![]);
        }
        groups[own].push(i);
    }
    groups
}

/// One dispatch.
#[derive(Clone, Debug)]
pub struct Kernel {
    pub name: String,
    /// Has one entry point, `main`.
    pub module: naga::Module,
    pub info: naga::valid::ModuleInfo,
    /// Bindings of group 0, in order.
    pub bindings: Vec<Binding>,
    pub accesses: Vec<Access>,
    pub workgroups: [u32; 3],
    pub workgroup_size: u32,
}

/// The dispatches of one launch, in order.
#[derive(Clone, Debug)]
pub struct GpuLaunch {
    pub name: String,
    pub kernels: Vec<Kernel>,
}

/// A program for a GPU.
#[derive(Clone, Debug)]
pub struct GpuProgram {
    pub launches: Vec<GpuLaunch>,
    /// Arenas of this program alone; those of the inputs are in [`Inputs`].
    pub arenas: Vec<Arena>,
    /// Places of the program's buffers with their numbers of lanes, by id.
    pub places: Vec<(Place, usize)>,
}

#[derive(Debug, thiserror::Error)]
pub enum LowerError {
    #[error("`{buffer}` has {bytes} bytes, but a kernel counts up to {limit}")]
    TooLarge { buffer: String, bytes: u64, limit: u64 },
    #[error("input `{name}` is {first} in one program and {second} in another; one name is one buffer")]
    Conflict { name: String, first: Box<Shape>, second: Box<Shape> },
    #[error("a launch needs {workgroups} workgroups, more than the device can start at once")]
    TooManyWorkgroups { workgroups: u64 },
    #[error("kernel `{kernel}` binds {buffers} buffers, the device {limit} (and {bytes} bytes of one at most)")]
    TooManyBuffers { kernel: String, buffers: usize, limit: u32, bytes: u64 },
    #[error("kernel `{kernel}` is not valid: {message}")]
    Invalid { kernel: String, message: String },
    #[error("kernel `{kernel}` cannot be written: {message}")]
    Write { kernel: String, message: String },
}

/// Lowers a program compiled for a GPU. Its inputs get places in `inputs` unless they have them already.
pub fn lower(program: &Program, inputs: &mut Inputs, limits: &Limits) -> Result<GpuProgram, LowerError> {
    let mut layout = Layout::new(program, inputs, limits)?;
    let mut launches = vec![];
    for launch in &program.launches {
        layout.next_launch();
        let kernels = parts::lower(&mut layout, *limits, launch)?;
        launches.push(GpuLaunch { name: launch.name.clone(), kernels });
    }
    let places = layout.places(program.buffers.len());
    Ok(GpuProgram { launches, arenas: layout.own, places })
}

impl Kernel {
    pub fn wgsl(&self) -> Result<String, LowerError> {
        let flags = naga::back::wgsl::WriterFlags::empty();
        naga::back::wgsl::write_string(&self.module, &self.info, flags).map_err(|e| self.write_error(&e))
    }

    /// SPIR-V 1.3 without run-time checks: indices are in range by construction, gathers clamp theirs.
    pub fn spirv(&self) -> Result<Vec<u32>, LowerError> {
        use naga::back::spv;
        let options = spv::Options {
            lang_version: (1, 3),
            flags: spv::WriterFlags::empty(),
            zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::None,
            force_loop_bounding: false,
            emit_int_div_checks: false,
            // Kernels pass no halves between stages, which not every device can.
            use_storage_input_output_16: false,
            ..Default::default()
        };
        spv::write_vec(&self.module, &self.info, &options, None).map_err(|e| self.write_error(&e))
    }

    /// Memory that a workgroup shares.
    pub fn workgroup_bytes(&self) -> u32 {
        let module = &self.module;
        let shared = module.global_variables.iter().filter(|(_, v)| v.space == naga::AddressSpace::WorkGroup);
        shared.map(|(_, v)| module.types[v.ty].inner.size(module.to_ctx())).sum()
    }

    fn write_error(&self, e: &dyn std::fmt::Display) -> LowerError {
        LowerError::Write { kernel: self.name.clone(), message: e.to_string() }
    }
}
