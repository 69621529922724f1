//! A kernel being built: naga statements, and the arenas it binds.

use super::builder::{Builder, Kind, Memory, Value};
use super::half::{Half, Storage};
use super::layout::{Arena, ArenaId, Layout, Limits, Part, Place};
use super::{Access, Binding, Kernel, LowerError};
use naga::BuiltIn;
use naga::valid::Capabilities;
use raygrad_compiler::plan::region::BufferId;
use raygrad_compiler::scalar::DType;
use std::collections::BTreeSet;

/// Invocations in a workgroup, unless a kernel needs another number.
pub(super) const WORKGROUP: u32 = 64;

pub(super) struct Emit<'l, 'a> {
    pub b: Builder,
    pub layout: &'l Layout<'a>,
    bound: Vec<(ArenaId, Memory, bool)>,
    /// What a workgroup of a resident network shares.
    shared: Option<Memory>,
    /// Buffers that the kernel reads (false) or writes (true).
    touched: BTreeSet<(BufferId, bool)>,
    /// Workgroup number in a dispatch of one dimension.
    pub workgroup: Value,
    /// Number of the invocation in its workgroup.
    pub invocation: Value,
    groups: [u32; 3],
    limits: Limits,
    /// Whether float arenas are bound as vectors of four lanes.
    vectors: bool,
    /// See [`Emit::in_order`].
    in_order: bool,
}

impl<'l, 'a> Emit<'l, 'a> {
    /// Starts a kernel of `workgroups` workgroups.
    pub fn new(layout: &'l Layout<'a>, limits: Limits, workgroups: u64, size: u32) -> Result<Emit<'l, 'a>, LowerError> {
        let mut b = Builder::new(size);
        let group = b.built_in("workgroup", BuiltIn::WorkGroupId);
        let invocation = b.built_in("invocation", BuiltIn::LocalInvocationIndex);
        let most = limits.max_workgroups as u64;
        let rows = workgroups.div_ceil(most);
        if rows > most {
            return Err(LowerError::TooManyWorkgroups { workgroups });
        }
        let columns = workgroups.div_ceil(rows.max(1)).max(1);
        let mut workgroup = b.component(group, 0);
        if rows > 1 {
            let (row, length) = (b.component(group, 1), b.u(columns as u32));
            let before = b.mul(row, length);
            workgroup = b.add(before, workgroup);
        }
        let groups = [columns as u32, rows.max(1) as u32, 1];
        Ok(Emit {
            b,
            layout,
            bound: vec![],
            shared: None,
            touched: BTreeSet::new(),
            workgroup,
            invocation,
            groups,
            limits,
            vectors: false,
            in_order: false,
        })
    }

    /// Binds float arenas as vectors of four lanes if `vectors`, for kernels that mostly access four neighbours at once.
    pub fn with_vectors(mut self, vectors: bool) -> Emit<'l, 'a> {
        self.vectors = vectors;
        self
    }

    /// Keeps reads on their side of barriers: drivers may put off those of buffers that nothing writes until they are needed, and
    /// then wait for them. So all buffers are bound as if they were written.
    pub fn in_order(mut self) -> Emit<'l, 'a> {
        self.in_order = true;
        self
    }

    /// Starts a kernel of `count` invocations; leaves the spare ones of the last workgroup. Returns its number, too.
    pub fn over(layout: &'l Layout<'a>, limits: Limits, count: u64) -> Result<(Emit<'l, 'a>, Value), LowerError> {
        let mut e = Emit::new(layout, limits, count.div_ceil(WORKGROUP as u64), WORKGROUP)?;
        let size = e.b.u(WORKGROUP);
        let first = e.b.mul(e.workgroup, size);
        let number = e.b.add(first, e.invocation);
        e.b.name(number, "number");
        if e.groups[1] > 1 || !count.is_multiple_of(WORKGROUP as u64) {
            e.leave_from(number, count as u32);
        }
        Ok((e, number))
    }

    /// Does something where `number` is below `end`; everywhere, if there is none.
    pub fn if_below(&mut self, number: Value, end: Option<u32>, body: impl FnOnce(&mut Self)) {
        let Some(end) = end else { return body(self) };
        let end = self.b.u(end);
        let inside = self.b.less(number, end);
        self.b.open_if(inside);
        body(self);
        self.b.close_if();
    }

    /// Ends invocations whose `number` is not below `count`.
    pub fn leave_from(&mut self, number: Value, count: u32) {
        let count = self.b.u(count);
        let inside = self.b.binary(naga::BinaryOperator::GreaterEqual, number, count);
        self.b.open_if(inside);
        self.b.leave();
        self.b.close_if();
    }

    fn memory(&mut self, arena: ArenaId, write: bool) -> Memory {
        let write = write || self.in_order;
        if arena == ArenaId::Workgroup {
            let Arena { name, lanes, .. } = self.layout.arena(arena);
            let (vectors, lanes) = (self.vectors, *lanes as u32);
            let size = if vectors { lanes.div_ceil(4) } else { lanes };
            return *self.shared.get_or_insert_with(|| self.b.workgroup(name, Kind::F32, vectors, size));
        }
        if let Some(known) = self.bound.iter_mut().find(|b| b.0 == arena) {
            if write && !known.2 {
                known.2 = true;
                self.b.make_writable(known.1);
            }
            return known.1;
        }
        let Arena { name, storage, .. } = self.layout.arena(arena);
        let vector = self.vectors && *storage != Storage::U32;
        let memory = self.b.storage(name, (*storage).into(), vector);
        if write {
            self.b.make_writable(memory);
        }
        self.bound.push((arena, memory, write));
        memory
    }

    /// Lane `index` of a buffer.
    pub fn load(&mut self, buffer: BufferId, index: Value) -> Value {
        self.touched.insert((buffer, false));
        let place = self.layout.place(buffer);
        if let [part] = place.parts[..] {
            return self.load_part(part, index);
        }
        let kind = if place.storage == Storage::U32 { Kind::U32 } else { Kind::F32 };
        let nothing = self.b.literal(kind, 0);
        let found = self.b.var("found", nothing);
        self.in_part(place, index, &mut |e, part, index| {
            let value = e.load_part(part, index);
            e.b.set(found, value);
        });
        self.b.get(found)
    }

    /// Four neighbouring lanes of a buffer of floats, from a multiple of four on, in a kernel `with_vectors`.
    pub fn load_four(&mut self, buffer: BufferId, index: Value) -> Value {
        self.touched.insert((buffer, false));
        let place = self.layout.place(buffer);
        if let [part] = place.parts[..] {
            return self.load_four_of(part, index);
        }
        let zero = self.b.f(0.0);
        let zeros = self.b.splat(zero);
        let found = self.b.var("found", zeros);
        self.in_part(place, index, &mut |e, part, index| {
            let value = e.load_four_of(part, index);
            e.b.set(found, value);
        });
        self.b.get(found)
    }

    /// Sets four neighbouring lanes of a buffer of floats, as [`Emit::load_four`] reads them.
    pub fn store_four(&mut self, buffer: BufferId, index: Value, value: Value) {
        self.touched.insert((buffer, true));
        let place = self.layout.place(buffer);
        let value = self.b.splat(value);
        self.in_part(place, index, &mut |e, part, index| {
            let memory = e.memory(part.arena, true);
            let at = e.four(part, index);
            e.b.store(memory, at, value);
        });
    }

    pub fn store(&mut self, buffer: BufferId, index: Value, value: Value) {
        self.touched.insert((buffer, true));
        let place = self.layout.place(buffer);
        self.in_part(place, index, &mut |e, part, index| {
            let memory = e.memory(part.arena, true);
            let offset = e.b.u(part.offset);
            let at = e.b.add(index, offset);
            e.b.store_lane(memory, at, value);
        });
    }

    fn load_four_of(&mut self, part: Part, index: Value) -> Value {
        let memory = self.memory(part.arena, false);
        let at = self.four(part, index);
        self.b.load(memory, at)
    }

    /// Number of the vector that begins with a lane of a part. Parts begin at multiples of four.
    fn four(&mut self, part: Part, index: Value) -> Value {
        let (offset, four) = (self.b.u(part.offset), self.b.u(4));
        let at = self.b.add(index, offset);
        self.b.div(at, four)
    }

    fn load_part(&mut self, part: Part, index: Value) -> Value {
        let memory = self.memory(part.arena, false);
        let offset = self.b.u(part.offset);
        let at = self.b.add(index, offset);
        self.b.load_lane(memory, at)
    }

    /// Does something in the part that holds lane `index`, with the number that the lane has there.
    fn in_part(&mut self, place: &Place, index: Value, access: &mut dyn FnMut(&mut Self, Part, Value)) {
        let last = place.parts.len() - 1;
        for (i, part) in place.parts.iter().enumerate() {
            if i < last {
                let end = self.b.u((i as u32 + 1) * place.stretch);
                let here = self.b.less(index, end);
                self.b.open_if(here);
            }
            let first = self.b.u(i as u32 * place.stretch);
            let own = self.b.sub(index, first);
            access(self, *part, own);
            if i < last {
                self.b.open_else();
            }
        }
        (0..last).for_each(|_| self.b.close_if());
    }

    /// Lane index of a channel of an element.
    pub fn index(&mut self, buffer: BufferId, channel: Value, element: Value) -> Value {
        let elements = self.layout.shape(buffer).axes.elements() as u32;
        let stride = self.b.u(elements);
        let plane = self.b.mul(channel, stride);
        self.b.add(plane, element)
    }

    /// Validates the kernel.
    pub fn finish(self, name: impl Into<String>) -> Result<Kernel, LowerError> {
        let name = name.into();
        let Limits { max_buffers: limit, max_binding: bytes, .. } = self.limits;
        if self.bound.len() > limit as usize {
            return Err(LowerError::TooManyBuffers { kernel: name, buffers: self.bound.len(), limit, bytes });
        }
        let workgroup_size = self.b.workgroup_size;
        let (module, info) = validated(self.b.finish(), self.limits.half, &name)?;
        let bindings = self.bound.iter().map(|(arena, _, writable)| Binding { arena: *arena, writable: *writable });
        let mut accesses = vec![];
        for (buffer, write) in &self.touched {
            let place = self.layout.place(*buffer);
            if place.parts[0].arena == ArenaId::Workgroup {
                continue;
            }
            let pieces = place.pieces(0..self.layout.shape(*buffer).lanes());
            accesses.extend(pieces.into_iter().map(|(part, lanes)| {
                let first = u64::from(part.offset);
                Access { arena: part.arena, lanes: first..first + lanes.len() as u64, write: *write }
            }));
        }
        let (bindings, workgroups) = (bindings.collect(), self.groups);
        Ok(Kernel { name, module, info, bindings, accesses, workgroups, workgroup_size })
    }

    /// Whether the dispatch has more workgroups than were asked for.
    pub fn spare_workgroups(&self) -> bool {
        self.groups[1] > 1
    }
}

/// A module of a kernel with what naga knows of it.
pub(super) fn validated(
    module: naga::Module,
    half: Option<Half>,
    kernel: &str,
) -> Result<(naga::Module, naga::valid::ModuleInfo), LowerError> {
    let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities(half));
    let info = validator
        .validate(&module)
        .map_err(|e| LowerError::Invalid { kernel: kernel.into(), message: e.emit_to_string("") })?;
    Ok((module, info))
}

/// What modules may use.
fn capabilities(half: Option<Half>) -> Capabilities {
    match half {
        None => Capabilities::empty(),
        Some(Half { matrices: None }) => Capabilities::SHADER_FLOAT16,
        Some(Half { matrices: Some(_) }) => {
            Capabilities::SHADER_FLOAT16 | Capabilities::COOPERATIVE_MATRIX | Capabilities::SUBGROUP
        }
    }
}

/// The scalar type of a lane.
pub(super) fn kind(dtype: DType) -> Kind {
    dtype.into()
}
