//! Values in the scratch arena: lifetimes, sharing, contiguity.

use super::allocate::Arena;
use super::{Place, Value};
use raygrad_compiler::plan::region::{InstId, Region, RegionOp};

/// One allocation, shared by a value and everything picked from it.
struct Storage {
    start: usize,
    lanes: usize,
    /// Instructions and stores that still read it.
    users: usize,
}

/// Places of all values of a region while it is lowered.
pub(super) struct Values {
    arena: Arena,
    storage: Vec<Storage>,
    /// Value and the allocations it lives in.
    values: Vec<Option<(Value, Vec<usize>)>>,
    /// Users of every instruction's value.
    users: Vec<usize>,
    pub ld: usize,
}

impl Values {
    pub fn new(region: &Region, ld: usize) -> Values {
        let mut users = vec![0; region.body.len()];
        for input in region.body.iter().flat_map(|i| &i.inputs) {
            users[input.0 as usize] += 1;
        }
        for value in region.stores.iter().flat_map(|s| s.values()) {
            users[value.0 as usize] += 1;
        }
        Values { arena: Arena::default(), storage: vec![], values: vec![None; region.body.len()], users, ld }
    }

    pub fn get(&self, id: InstId) -> &Value {
        match &self.values[id.0 as usize] {
            Some((value, _)) => value,
            None => unreachable!("instruction {} has no value yet", id.0),
        }
    }

    /// Whether `id` has a value yet: a layer that its reader computes never gets one.
    pub fn known(&self, id: InstId) -> bool {
        self.values[id.0 as usize].is_some()
    }

    /// Number of instructions and stores that read `id`.
    pub fn users(&self, id: InstId) -> usize {
        self.users[id.0 as usize]
    }

    fn lanes(&self, channels: usize, full: bool) -> usize {
        if full { channels * self.ld } else { channels }
    }

    /// Scratch for something that dies with the current instruction.
    pub fn temporary(&mut self, channels: usize, full: bool) -> (Place, usize) {
        let lanes = self.lanes(channels, full);
        (self.arena.take(lanes), lanes)
    }

    pub fn release_temporary(&mut self, (place, lanes): (Place, usize)) {
        self.arena.give(place, lanes);
    }

    /// A new value for `id`, in channels next to each other.
    pub fn create(&mut self, id: InstId, channels: usize, full: bool) -> Place {
        let lanes = self.lanes(channels, full);
        let start = self.arena.take(lanes);
        self.storage.push(Storage { start, lanes, users: self.users(id) });
        let step = if full { self.ld } else { 1 };
        let places = (0..channels).map(|c| start + c * step).collect();
        self.values[id.0 as usize] = Some((Value { places, full }, vec![self.storage.len() - 1]));
        start
    }

    /// A value for `id` that is `from` overwritten: only where `from` has no other reader and the same layout.
    pub fn overwrite(&mut self, id: InstId, from: InstId, channels: usize, full: bool) -> Option<Place> {
        let (value, storage) = self.values[from.0 as usize].as_ref()?;
        let [only] = storage[..] else { return None };
        let sole = self.storage[only].users == 1 && value.full == full && value.places.len() == channels;
        let start = self.storage[only].start;
        let whole = self.storage[only].lanes == self.lanes(channels, full) && self.contiguous(value) == Some(start);
        if !(sole && whole) {
            return None;
        }
        // The reader that is left is the instruction that overwrites it: hand the allocation over.
        self.storage[only].users += self.users(id);
        self.values[id.0 as usize] = Some((value.clone(), vec![only]));
        Some(start)
    }

    /// A value for `id` made of channels of other values.
    pub fn alias(&mut self, id: InstId, picks: &[(InstId, u32)], full: bool) {
        let mut places = vec![];
        let mut storage: Vec<usize> = vec![];
        for (from, channel) in picks {
            let Some((value, owners)) = &self.values[from.0 as usize] else { unreachable!("operands come first") };
            places.push(value.places[*channel as usize]);
            storage.extend(owners);
        }
        storage.sort_unstable();
        storage.dedup();
        for s in &storage {
            self.storage[*s].users += self.users(id);
        }
        self.values[id.0 as usize] = Some((Value { places, full }, storage));
    }

    /// Notes that one reader of `id` is done; allocations without readers are freed.
    pub fn done(&mut self, id: InstId) {
        let Some((_, owners)) = &self.values[id.0 as usize] else { unreachable!("operands come first") };
        for s in owners {
            let storage = &mut self.storage[*s];
            storage.users -= 1;
            if storage.users == 0 {
                self.arena.give(storage.start, storage.lanes);
            }
        }
    }

    /// The first place, if the channels follow each other.
    pub fn contiguous(&self, value: &Value) -> Option<Place> {
        let step = if value.full { self.ld } else { 1 };
        let first = *value.places.first()?;
        value.places.iter().enumerate().all(|(c, p)| *p == first + c * step).then_some(first)
    }

    pub fn arena_len(&self) -> usize {
        self.arena.len()
    }
}

/// Whether the instruction only renames channels: it costs nothing if all it picks from have the same extent.
pub(super) fn is_alias(region: &Region, id: InstId) -> bool {
    let inst = region.inst(id);
    matches!(inst.op, RegionOp::Pick(_)) && inst.inputs.iter().all(|i| region.is_uniform(*i) == region.is_uniform(id))
}
