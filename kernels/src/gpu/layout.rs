//! Where buffers lie: a few arenas hold everything, so that a kernel binds two or three buffers, not dozens.
//!
//! Inputs lie in arenas shared by all programs of a session; temporaries, outputs and scratch memory in arenas of the
//! program. An arena holds lanes of one type and is at most as large as the device can bind; a buffer that is larger lies in
//! parts, each in an arena.

use super::LowerError;
use super::half::{Half, Matrices, Storage, may_be_half, storages};
use super::tile::Tile;
use raygrad_compiler::cost::Rates;
use raygrad_compiler::graph::Shape;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::plan::region::BufferId;
use raygrad_compiler::plan::{BufferKind, Program};
use std::collections::BTreeMap;
use std::ops::Range;

/// Buffers start at multiples of this many lanes: 256 bytes, which suits every device's copies and cache lines.
const ALIGN: u64 = 64;

/// What kernels may use of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Largest binding, in bytes.
    pub max_binding: u64,
    /// Most buffers that a kernel binds.
    pub max_buffers: u32,
    /// Most workgroups along one dimension of a dispatch.
    pub max_workgroups: u32,
    /// Memory that a workgroup may share.
    pub max_workgroup_bytes: u32,
    /// How many of the largest tiles of matrix products not to use, which would otherwise be preferred: what is fastest
    /// depends on the device. [`TILES`] are there to choose from; the last are [`SOFTWARE_TILES`].
    pub tiles: u32,
    /// Workgroups that keep all processors busy ([`raygrad_compiler::cost::Rates::workgroups`]): what there is to do is cut into
    /// so many.
    pub workgroups: u32,
    /// Mixed precision: what matrix products read is stored in half precision, and sums stay in single. `None`: all is
    /// single.
    pub half: Option<Half>,
}

/// Choices of [`Limits::tiles`].
pub const TILES: u32 = 4;
/// The last of them, tiles for drivers in software: their "invocations" are lanes of a CPU's vectors, which take a value that is
/// the same for all at once, and values that differ one by one.
pub const SOFTWARE_TILES: u32 = TILES - 1;

impl Limits {
    /// The lower of each of two limits, with everything else as it is.
    pub fn within(self, most: Limits) -> Limits {
        Limits {
            max_binding: self.max_binding.min(most.max_binding),
            max_buffers: self.max_buffers.min(most.max_buffers),
            max_workgroups: self.max_workgroups.min(most.max_workgroups),
            max_workgroup_bytes: self.max_workgroup_bytes.min(most.max_workgroup_bytes),
            ..self
        }
    }

    /// Invocations that keep all processors busy.
    pub(super) fn invocations(&self) -> usize {
        256 * self.workgroups as usize
    }

    /// Cooperative matrices for tiles, if the smallest fits; those of drivers in software have none.
    pub(super) fn matrices(&self) -> Option<Matrices> {
        let used = |m: &Matrices| self.tiles != SOFTWARE_TILES && Tile::smallest(*m).fits(self);
        self.half.and_then(|h| h.matrices).filter(used)
    }
}

impl Default for Limits {
    /// What WebGPU guarantees.
    fn default() -> Limits {
        Limits {
            max_binding: 128 << 20,
            max_buffers: 8,
            max_workgroups: 65535,
            max_workgroup_bytes: 16 << 10,
            tiles: 0,
            workgroups: Rates::GPU.workgroups,
            half: None,
        }
    }
}

/// A GPU buffer that holds many of a program's buffers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Arena {
    pub name: String,
    pub storage: Storage,
    pub lanes: u64,
}

impl Arena {
    /// Of its buffer, which is never empty.
    pub fn bytes(&self) -> u64 {
        self.storage.bytes() * self.lanes.max(1)
    }
}

/// Which arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ArenaId {
    /// Of [`Inputs::arenas`].
    Input(usize),
    /// Of the program's own arenas.
    Own(usize),
    /// Memory of a workgroup, in a kernel of a resident network.
    Workgroup,
}

/// Where a buffer lies: its lanes in order, `stretch` of them in every part but the last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    pub parts: Vec<Part>,
    pub stretch: u32,
    pub storage: Storage,
}

/// Where a part of a buffer begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    pub arena: ArenaId,
    /// In lanes.
    pub offset: u32,
}

impl Place {
    /// The parts that hold the lanes of a range: from where on in each part, and which of the range.
    pub fn pieces(&self, lanes: Range<usize>) -> Vec<(Part, Range<usize>)> {
        let stretch = self.stretch as usize;
        let mut all = vec![];
        let mut at = lanes.start;
        while at < lanes.end {
            let number = at / stretch;
            let end = lanes.end.min((number + 1) * stretch);
            let part = self.parts[number];
            let offset = part.offset + (at - number * stretch) as u32;
            all.push((Part { offset, ..part }, at - lanes.start..end - lanes.start));
            at = end;
        }
        all
    }
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
    /// Whether matrix products work in half precision.
    half: bool,
    /// Scratch arenas of this launch: next free lane of each.
    scratch: Vec<(usize, u64)>,
    /// Memory of a workgroup of this kernel.
    workgroup: Arena,
}

impl<'a> Layout<'a> {
    pub fn new(program: &Program, inputs: &'a mut Inputs, limits: &Limits) -> Result<Layout<'a>, LowerError> {
        // Whole stretches of aligned lanes, at least one.
        let max_lanes = ((limits.max_binding / 4).min(u32::MAX as u64) / ALIGN * ALIGN).max(ALIGN);
        let half = limits.half.is_some();
        let workgroup = Arena { name: "tile".into(), storage: Storage::F32, lanes: 0 };
        let mut layout = Layout { inputs, own: vec![], buffers: vec![], max_lanes, half, scratch: vec![], workgroup };
        layout.inputs.sealed = layout.inputs.arenas.len();
        // A slot may hold floats for some launches and halves for others.
        let mut slots: BTreeMap<(usize, bool), Place> = BTreeMap::new();
        for (buffer, storage) in program.buffers.iter().zip(storages(program, layout.half)) {
            let lanes = buffer.shape.lanes() as u64;
            fits(&buffer.label, lanes)?;
            let place = match &buffer.kind {
                BufferKind::Input { name, role } => layout.input(name, *role, &buffer.shape)?,
                BufferKind::Output => layout.allocate("work", storage, lanes),
                // Integers lie among integers and share no slot: their bits must not pass through float registers.
                BufferKind::Temporary { .. } if storage == Storage::U32 => layout.allocate("work", storage, lanes),
                BufferKind::Temporary { slot } => slots
                    .entry((*slot, storage == Storage::F16))
                    .or_insert_with(|| layout.allocate("work", storage, program.slots[*slot] as u64))
                    .clone(),
            };
            // `relu network.rs:12` is called `relu` in kernels.
            let name = buffer.label.split(' ').next().unwrap_or_default();
            layout.buffers.push((place, buffer.shape.clone(), name.into()));
        }
        Ok(layout)
    }

    fn input(&mut self, name: &str, role: Role, shape: &Shape) -> Result<Place, LowerError> {
        if let Some((place, known)) = self.inputs.places.get(name) {
            return if same_layout(known, shape) {
                Ok(place.clone())
            } else {
                let (first, second) = (Box::new(known.clone()), Box::new(shape.clone()));
                Err(LowerError::Conflict { name: name.into(), first, second })
            };
        }
        let sealed = self.inputs.sealed;
        // Per-step values lie together: the host writes them in one go.
        let class = if role == Role::PerStep { "per_step" } else { "inputs" };
        let (arenas, most) = (&mut self.inputs.arenas, self.max_lanes);
        let storage = shape.dtype.into();
        let place = in_parts(storage, shape.lanes() as u64, most, |lanes| {
            let (at, offset) = grow(arenas, sealed, class, storage, lanes, most);
            Part { arena: ArenaId::Input(at), offset }
        });
        self.inputs.places.insert(name.into(), (place.clone(), shape.clone()));
        Ok(place)
    }

    fn allocate(&mut self, class: &str, storage: Storage, lanes: u64) -> Place {
        let (arenas, most) = (&mut self.own, self.max_lanes);
        in_parts(storage, lanes, most, |lanes| {
            let (at, offset) = grow(arenas, 0, class, storage, lanes, most);
            Part { arena: ArenaId::Own(at), offset }
        })
    }

    /// Starts a launch. Scratch memory of earlier ones is used again after a while, not at once, or kernels that have nothing else
    /// in common would wait for each other.
    pub fn next_launch(&mut self) {
        const LANES: u64 = 1 << 24;
        let most = LANES.min(self.max_lanes / 2);
        self.scratch.iter_mut().filter(|s| s.1 > most).for_each(|s| s.1 = 0);
    }

    /// A buffer that lives during this launch.
    pub fn scratch(&mut self, name: &str, shape: Shape) -> Result<BufferId, LowerError> {
        let storage = shape.dtype.into();
        self.scratch_stored(name, shape, storage)
    }

    /// The same for what a matrix product reads.
    pub fn scratch_for_product(&mut self, name: &str, shape: Shape) -> Result<BufferId, LowerError> {
        let half = self.half && may_be_half(&shape);
        let storage = if half { Storage::F16 } else { shape.dtype.into() };
        self.scratch_stored(name, shape, storage)
    }

    /// Starts a kernel whose workgroups hold so many lanes.
    pub fn hold(&mut self, lanes: u32) {
        self.workgroup.lanes = u64::from(lanes);
    }

    /// A buffer of floats in the memory of a workgroup, from lane `offset` on.
    pub fn in_workgroup(&mut self, name: &str, shape: Shape, offset: u32) -> BufferId {
        let parts = vec![Part { arena: ArenaId::Workgroup, offset }];
        self.buffers.push((Place { parts, stretch: u32::MAX, storage: Storage::F32 }, shape, name.into()));
        BufferId(self.buffers.len() as u32 - 1)
    }

    /// Neighbouring channels of a buffer as a buffer of their own, if it lies in one piece and they begin at a multiple of four
    /// lanes.
    pub fn slice(&mut self, buffer: BufferId, channels: Range<usize>) -> Option<BufferId> {
        let (place, shape, name) = &self.buffers[buffer.0 as usize];
        let first = channels.start * shape.axes.elements();
        let ([part], true) = (&place.parts[..], first.is_multiple_of(4)) else { return None };
        let part = Part { offset: part.offset + first as u32, ..*part };
        let shape = Shape::of(shape.axes.clone(), channels.len(), shape.dtype);
        self.buffers.push((Place { parts: vec![part], ..place.clone() }, shape, name.clone()));
        Some(BufferId(self.buffers.len() as u32 - 1))
    }

    fn scratch_stored(&mut self, name: &str, shape: Shape, storage: Storage) -> Result<BufferId, LowerError> {
        let lanes = shape.lanes() as u64;
        fits("scratch memory", lanes)?;
        let most = self.max_lanes;
        let place = in_parts(storage, lanes, most, |lanes| self.scratch_part(storage, lanes));
        self.buffers.push((place, shape, name.into()));
        Ok(BufferId(self.buffers.len() as u32 - 1))
    }

    fn scratch_part(&mut self, storage: Storage, lanes: u64) -> Part {
        let room = |s: &(usize, u64)| self.own[s.0].storage == storage && s.1 + lanes <= self.max_lanes;
        let at = match self.scratch.iter().position(room) {
            Some(at) => at,
            None => {
                let name = arena_name(&self.own, "scratch", storage);
                self.own.push(Arena { name, storage, lanes: 0 });
                self.scratch.push((self.own.len() - 1, 0));
                self.scratch.len() - 1
            }
        };
        let (arena, offset) = self.scratch[at];
        self.scratch[at].1 += lanes;
        self.own[arena].lanes = self.own[arena].lanes.max(offset + lanes);
        Part { arena: ArenaId::Own(arena), offset: offset as u32 }
    }

    pub fn place(&self, buffer: BufferId) -> &Place {
        &self.buffers[buffer.0 as usize].0
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
            ArenaId::Workgroup => &self.workgroup,
        }
    }

    /// Places and lanes of the program's `count` buffers.
    pub fn places(&self, count: usize) -> Vec<(Place, usize)> {
        self.buffers[..count].iter().map(|b| (b.0.clone(), b.1.lanes())).collect()
    }
}

/// Programs may be recorded with axes of their own: names and sizes must agree.
fn same_layout(a: &Shape, b: &Shape) -> bool {
    let sizes = |s: &Shape| s.axes.iter().map(|x| (x.name().to_string(), x.size())).collect::<Vec<_>>();
    sizes(a) == sizes(b) && a.channels.count() == b.channels.count() && a.dtype == b.dtype
}

/// Lanes are counted in 32 bits.
fn fits(name: &str, lanes: u64) -> Result<(), LowerError> {
    match u32::try_from(lanes) {
        Ok(_) => Ok(()),
        Err(_) => Err(LowerError::TooLarge { buffer: name.into(), bytes: 4 * lanes, limit: 4 * u64::from(u32::MAX) }),
    }
}

/// A place for so many lanes: `put` is given the lanes of one part after the other, multiples of [`ALIGN`] up to `most`.
fn in_parts(storage: Storage, lanes: u64, most: u64, mut put: impl FnMut(u64) -> Part) -> Place {
    let mut parts = vec![];
    let mut left = lanes.next_multiple_of(ALIGN).max(ALIGN);
    while left > 0 {
        let part = left.min(most);
        parts.push(put(part));
        left -= part;
    }
    Place { parts, stretch: most as u32, storage }
}

/// Puts lanes into the first arena of a class and type, from `first` on, that has room, or a new one.
fn grow(arenas: &mut Vec<Arena>, first: usize, class: &str, storage: Storage, lanes: u64, most: u64) -> (usize, u32) {
    let fits = |a: &Arena| a.storage == storage && a.name.starts_with(class) && a.lanes + lanes <= most;
    let at = (first..arenas.len()).find(|i| fits(&arenas[*i])).unwrap_or_else(|| {
        let name = arena_name(arenas, class, storage);
        arenas.push(Arena { name, storage, lanes: 0 });
        arenas.len() - 1
    });
    let offset = arenas[at].lanes;
    arenas[at].lanes += lanes;
    (at, offset as u32)
}

/// `work`, `work_u32`, `work_f16`, and with a letter or two from the second of a kind on.
fn arena_name(arenas: &[Arena], class: &str, storage: Storage) -> String {
    let stem = match storage {
        Storage::F32 => class.to_string(),
        Storage::F16 => format!("{class}_f16"),
        Storage::U32 => format!("{class}_u32"),
    };
    let same = arenas.iter().filter(|a| a.storage == storage && a.name.starts_with(class)).count();
    let letter = |n: usize| (b'a' + (n % 26) as u8) as char;
    match same {
        0 => stem,
        1..26 => format!("{stem}_{}", letter(same)),
        _ => format!("{stem}_{}{}", letter(same / 26 - 1), letter(same)),
    }
}
