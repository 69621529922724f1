//! Where buffers lie: a few arenas hold everything, so that a kernel binds two or three buffers, not dozens.
//!
//! Inputs lie in arenas shared by all programs of a session; temporaries, outputs and scratch memory in arenas of the
//! program. An arena holds lanes of one type and is at most as large as the device can bind.

use super::LowerError;
use raygrad_compiler::graph::Shape;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::plan::region::BufferId;
use raygrad_compiler::plan::{BufferKind, Program};
use raygrad_compiler::scalar::DType;
use std::collections::BTreeMap;

/// Buffers start at multiples of this many lanes: 256 bytes, which suits every device's copies and cache lines.
const ALIGN: u64 = 64;

/// What a device can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Largest binding, in bytes.
    pub max_binding: u64,
    /// Most workgroups along one dimension of a dispatch.
    pub max_workgroups: u32,
}

impl Default for Limits {
    /// What WebGPU guarantees.
    fn default() -> Limits {
        Limits { max_binding: 128 << 20, max_workgroups: 65535 }
    }
}

/// A GPU buffer that holds many of a program's buffers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Arena {
    pub name: String,
    pub dtype: DType,
    pub lanes: u64,
}

/// Which arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ArenaId {
    /// Of [`Inputs::arenas`].
    Input(usize),
    /// Of the program's own arenas.
    Own(usize),
}

/// Where a buffer lies in its arena, in lanes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    pub arena: ArenaId,
    pub offset: u32,
    pub dtype: DType,
}

/// Places of the inputs of all programs of a session, by name.
#[derive(Clone, Debug, Default)]
pub struct Inputs {
    pub arenas: Vec<Arena>,
    pub places: BTreeMap<String, (Place, Shape)>,
    /// Arenas below this one exist on the device and cannot grow.
    sealed: usize,
}

/// Places of a program's buffers, in order of their ids, and its own arenas.
pub struct Layout<'a> {
    inputs: &'a mut Inputs,
    pub own: Vec<Arena>,
    buffers: Vec<(Place, Shape, String)>,
    max_lanes: u64,
    /// Scratch arenas of this launch: next free lane of each.
    scratch: Vec<(usize, u64)>,
}

impl<'a> Layout<'a> {
    pub fn new(program: &Program, inputs: &'a mut Inputs, limits: &Limits) -> Result<Layout<'a>, LowerError> {
        let max_lanes = (limits.max_binding / 4).min(u32::MAX as u64);
        let mut layout = Layout { inputs, own: vec![], buffers: vec![], max_lanes, scratch: vec![] };
        layout.inputs.sealed = layout.inputs.arenas.len();
        let mut slots: Vec<Option<Place>> = vec![None; program.slots.len()];
        for buffer in &program.buffers {
            let lanes = buffer.shape.lanes() as u64;
            let dtype = buffer.shape.dtype;
            layout.fits(&buffer.label, lanes)?;
            let place = match &buffer.kind {
                BufferKind::Input { name, role } => layout.input(name, *role, &buffer.shape)?,
                BufferKind::Output => layout.allocate("work", dtype, lanes),
                // Integers lie among integers and share no slot: their bits must not pass through float registers.
                BufferKind::Temporary { .. } if dtype == DType::U32 => layout.allocate("work", dtype, lanes),
                BufferKind::Temporary { slot } => match slots[*slot] {
                    Some(place) => place,
                    None => {
                        let place = layout.allocate("work", dtype, program.slots[*slot] as u64);
                        slots[*slot] = Some(place);
                        place
                    }
                },
            };
            // `relu network.rs:12` is called `relu` in kernels.
            let name = buffer.label.split(' ').next().unwrap_or_default();
            layout.buffers.push((place, buffer.shape.clone(), name.into()));
        }
        Ok(layout)
    }

    fn fits(&self, name: &str, lanes: u64) -> Result<(), LowerError> {
        if lanes <= self.max_lanes {
            return Ok(());
        }
        Err(LowerError::TooLarge { buffer: name.into(), bytes: 4 * lanes, limit: 4 * self.max_lanes })
    }

    fn input(&mut self, name: &str, role: Role, shape: &Shape) -> Result<Place, LowerError> {
        if let Some((place, known)) = self.inputs.places.get(name) {
            return if same_layout(known, shape) {
                Ok(*place)
            } else {
                let (first, second) = (Box::new(known.clone()), Box::new(shape.clone()));
                Err(LowerError::Conflict { name: name.into(), first, second })
            };
        }
        let sealed = self.inputs.sealed;
        // Per-step values lie together: the host writes them in one go.
        let class = if role == Role::PerStep { "per_step" } else { "inputs" };
        let (at, offset) = grow(&mut self.inputs.arenas, sealed, class, shape, self.max_lanes);
        let place = Place { arena: ArenaId::Input(at), offset, dtype: shape.dtype };
        self.inputs.places.insert(name.into(), (place, shape.clone()));
        Ok(place)
    }

    fn allocate(&mut self, class: &str, dtype: DType, lanes: u64) -> Place {
        let flat = Shape::of(Default::default(), lanes as usize, dtype);
        let (at, offset) = grow(&mut self.own, 0, class, &flat, self.max_lanes);
        Place { arena: ArenaId::Own(at), offset, dtype }
    }

    /// Starts a launch: scratch memory of the ones before it is free again.
    pub fn next_launch(&mut self) {
        self.scratch.iter_mut().for_each(|s| s.1 = 0);
    }

    /// A buffer that lives during this launch.
    pub fn scratch(&mut self, name: &str, shape: Shape) -> Result<BufferId, LowerError> {
        let lanes = (shape.lanes() as u64).next_multiple_of(ALIGN);
        self.fits("scratch memory", lanes)?;
        let room =
            |layout: &Layout, s: &(usize, u64)| layout.own[s.0].dtype == shape.dtype && s.1 + lanes <= layout.max_lanes;
        let at = match self.scratch.iter().position(|s| room(self, s)) {
            Some(at) => at,
            None => {
                let name = arena_name(&self.own, "scratch", shape.dtype);
                self.own.push(Arena { name, dtype: shape.dtype, lanes: 0 });
                self.scratch.push((self.own.len() - 1, 0));
                self.scratch.len() - 1
            }
        };
        let (arena, offset) = self.scratch[at];
        self.scratch[at].1 += lanes;
        self.own[arena].lanes = self.own[arena].lanes.max(offset + lanes);
        let place = Place { arena: ArenaId::Own(arena), offset: offset as u32, dtype: shape.dtype };
        self.buffers.push((place, shape, name.into()));
        Ok(BufferId(self.buffers.len() as u32 - 1))
    }

    pub fn place(&self, buffer: BufferId) -> Place {
        self.buffers[buffer.0 as usize].0
    }

    pub fn shape(&self, buffer: BufferId) -> &Shape {
        &self.buffers[buffer.0 as usize].1
    }

    /// What values loaded from a buffer are called.
    pub fn name(&self, buffer: BufferId) -> &str {
        &self.buffers[buffer.0 as usize].2
    }

    pub fn arena(&self, id: ArenaId) -> &Arena {
        match id {
            ArenaId::Input(i) => &self.inputs.arenas[i],
            ArenaId::Own(i) => &self.own[i],
        }
    }

    /// Places and lanes of the program's `count` buffers.
    pub fn places(&self, count: usize) -> Vec<(Place, usize)> {
        self.buffers[..count].iter().map(|b| (b.0, b.1.lanes())).collect()
    }
}

/// Programs may be recorded with axes of their own: names and sizes must agree.
fn same_layout(a: &Shape, b: &Shape) -> bool {
    let sizes = |s: &Shape| s.axes.iter().map(|x| (x.name().to_string(), x.size())).collect::<Vec<_>>();
    sizes(a) == sizes(b) && a.channels.count() == b.channels.count() && a.dtype == b.dtype
}

/// Puts `shape` into the first arena of its class and type, from `first` on, that has room, or a new one.
fn grow(arenas: &mut Vec<Arena>, first: usize, class: &str, shape: &Shape, max_lanes: u64) -> (usize, u32) {
    let lanes = (shape.lanes() as u64).next_multiple_of(ALIGN);
    let fits = |a: &Arena| a.dtype == shape.dtype && a.name.starts_with(class) && a.lanes + lanes <= max_lanes;
    let at = (first..arenas.len()).find(|i| fits(&arenas[*i])).unwrap_or_else(|| {
        let name = arena_name(arenas, class, shape.dtype);
        arenas.push(Arena { name, dtype: shape.dtype, lanes: 0 });
        arenas.len() - 1
    });
    let offset = arenas[at].lanes;
    arenas[at].lanes += lanes;
    (at, offset as u32)
}

/// `work`, `work_u32`, and with a letter from the second of a kind on.
fn arena_name(arenas: &[Arena], class: &str, dtype: DType) -> String {
    let stem = if dtype == DType::U32 { format!("{class}_u32") } else { class.to_string() };
    let same = arenas.iter().filter(|a| a.dtype == dtype && a.name.starts_with(class)).count();
    if same == 0 { stem } else { format!("{stem}_{}", (b'a' + (same % 26) as u8) as char) }
}
