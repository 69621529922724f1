//! Launches over a single element whose channels are many: parameter updates.
//!
//! Such a region is pointwise over channels, so channels take the place of rows: each group of values of one width is
//! worked through in blocks of lanes, reading and writing the buffers directly, by any number of threads.

use super::temporaries::lane_program;
use super::*;
use crate::cpu::{Isa, Operand};
use raygrad_compiler::plan::Program;
use raygrad_compiler::plan::region::{InstId, Region, RegionOp, Store};

/// Channels from which going over them is worth it.
const MIN_WIDTH: usize = 256;

/// An operand of a flat instruction.
#[derive(Clone, Debug)]
pub enum FlatArg {
    /// Lane for lane, an earlier instruction of the group.
    Inst(usize),
    /// Lane for lane, a buffer.
    Buffer(BufferId),
    /// The buffer's one lane.
    BufferSplat(BufferId),
    Const(u32),
    /// Consecutive stretches of buffers: first lane here, buffer, first lane there.
    Pieces(Vec<(usize, BufferId, usize)>),
}

/// Pointwise instructions over `width` lanes.
#[derive(Clone, Debug)]
pub struct Flat {
    pub width: usize,
    pub insts: Vec<(LaneProgram, Vec<FlatArg>)>,
    /// What is written: an instruction's value or an operand as it is, and where.
    pub stores: Vec<(FlatArg, BufferId)>,
}

/// Splits the stores of a single-element region into flat groups and a region with what is left, if any.
pub fn split_flat(program: &Program, region: &Region) -> (Vec<Flat>, Option<Region>) {
    let mut rest = region.clone();
    let mut flats: Vec<Flat> = vec![];
    if region.domain.elements() != 1 {
        return (flats, Some(rest));
    }
    rest.stores.clear();
    // Values a group already has, by group.
    let mut known: Vec<Vec<(InstId, usize)>> = vec![];
    for store in &region.stores {
        let Store::Write { value, buffer } = store else {
            rest.stores.push(store.clone());
            continue;
        };
        let width = region.inst(*value).channels;
        let group = flats.iter().position(|f| f.width == width).unwrap_or(flats.len());
        let mut flat = flats.get(group).cloned().unwrap_or(Flat { width, insts: vec![], stores: vec![] });
        let mut have = known.get(group).cloned().unwrap_or_default();
        let arg = if width >= MIN_WIDTH { flatten(program, region, *value, &mut flat, &mut have) } else { None };
        match arg {
            None => rest.stores.push(store.clone()),
            Some(arg) => {
                flat.stores.push((arg, *buffer));
                if group == flats.len() {
                    flats.push(flat);
                    known.push(have);
                } else {
                    flats[group] = flat;
                    known[group] = have;
                }
            }
        }
    }
    // Old values leave before new ones take their place.
    for flat in &mut flats {
        flat.stores.sort_by_key(|(arg, _)| matches!(arg, FlatArg::Inst(_)));
    }
    let rest = (!rest.stores.is_empty()).then(|| rest.swept());
    if interfere(&flats, rest.as_ref()) {
        return (vec![], Some(region.clone()));
    }
    (flats, rest)
}

/// Whether one part writes, in place, what another part reads, or what it reads itself at other lanes or in a later
/// store: then there is no right order.
fn interfere(flats: &[Flat], rest: Option<&Region>) -> bool {
    if flats.iter().any(Flat::overtakes) {
        return true;
    }
    let mut parts: Vec<(Vec<BufferId>, Vec<BufferId>)> = flats.iter().map(|f| (f.reads(), f.writes())).collect();
    parts.extend(rest.map(|r| (r.reads(), r.stores.iter().map(Store::buffer).collect())));
    let clash = |i: usize, j: usize| i != j && parts[i].1.iter().any(|w| parts[j].0.contains(w));
    (0..parts.len()).any(|i| (0..parts.len()).any(|j| clash(i, j)))
}

/// The value `id` as an argument of the group, adding instructions it needs. `None` if it is not pointwise over lanes.
fn flatten(
    program: &Program,
    region: &Region,
    id: InstId,
    flat: &mut Flat,
    have: &mut Vec<(InstId, usize)>,
) -> Option<FlatArg> {
    if let Some((_, at)) = have.iter().find(|(known, _)| *known == id) {
        return Some(FlatArg::Inst(*at));
    }
    let inst = region.inst(id);
    let lanes = |b: &BufferId| program.buffer(*b).shape.lanes();
    match &inst.op {
        RegionOp::Load(b) if inst.channels == flat.width && lanes(b) == flat.width => Some(FlatArg::Buffer(*b)),
        RegionOp::Load(b) if inst.channels == 1 && lanes(b) == 1 => Some(FlatArg::BufferSplat(*b)),
        RegionOp::Const(bits) if bits.iter().all(|b| *b == bits[0]) => Some(FlatArg::Const(bits[0])),
        RegionOp::Pick(pick) if inst.channels == flat.width => {
            let mut pieces: Vec<(usize, BufferId, usize)> = vec![];
            for (lane, (operand, channel)) in pick.iter().enumerate() {
                let from = region.inst(inst.inputs[*operand as usize]);
                let RegionOp::Load(b) = from.op else { return None };
                let continues = pieces.last().is_some_and(|p| p.1 == b && p.2 + (lane - p.0) == *channel as usize);
                if !continues {
                    pieces.push((lane, b, *channel as usize));
                }
            }
            (pieces.len() <= 64).then_some(FlatArg::Pieces(pieces))
        }
        RegionOp::Map(code) if inst.channels == flat.width || inst.channels == 1 => {
            let args: Option<Vec<FlatArg>> =
                inst.inputs.iter().map(|i| flatten(program, region, *i, flat, have)).collect();
            flat.insts.push((lane_program(code), args?));
            have.push((id, flat.insts.len() - 1));
            Some(FlatArg::Inst(flat.insts.len() - 1))
        }
        _ => None,
    }
}

impl Flat {
    /// Lanes of scratch that [`Flat::run`] needs.
    pub fn scratch(&self) -> usize {
        let temps = self.insts.iter().map(|(p, _)| p.temps).max().unwrap_or(0);
        (self.insts.len() + temps + self.pieces().count()) * BLOCK
    }

    fn args(&self) -> impl Iterator<Item = &FlatArg> {
        self.insts.iter().flat_map(|(_, args)| args).chain(self.stores.iter().map(|s| &s.0))
    }

    fn reads(&self) -> Vec<BufferId> {
        let read = |a: &FlatArg| match a {
            FlatArg::Buffer(b) | FlatArg::BufferSplat(b) => vec![*b],
            FlatArg::Pieces(pieces) => pieces.iter().map(|p| p.1).collect(),
            FlatArg::Inst(_) | FlatArg::Const(_) => vec![],
        };
        self.args().flat_map(read).collect()
    }

    fn writes(&self) -> Vec<BufferId> {
        self.stores.iter().map(|s| s.1).collect()
    }

    /// Whether a block of lanes is written before it is read.
    fn overtakes(&self) -> bool {
        let moved = self.pieces().any(|a| match a {
            FlatArg::Pieces(pieces) => pieces.iter().any(|p| self.writes().contains(&p.1)),
            _ => false,
        });
        let copied = |(at, (arg, _)): (usize, &(FlatArg, BufferId))| match arg {
            FlatArg::Buffer(from) => self.stores[..at].iter().any(|(_, to)| to == from),
            _ => false,
        };
        moved || self.stores.iter().enumerate().any(copied)
    }

    fn pieces(&self) -> impl Iterator<Item = &FlatArg> {
        self.args().filter(|a| matches!(a, FlatArg::Pieces(_)))
    }

    /// Works through lanes `range`.
    ///
    /// # Safety
    /// As [`run_tiles`]: no other thread touches these lanes of the written buffers.
    pub unsafe fn run(&self, range: std::ops::Range<usize>, memory: Memory, isa: Isa, scratch: &mut [f32]) {
        let values = scratch.as_mut_ptr();
        let temps = values.wrapping_add(self.insts.len() * BLOCK);
        let gathered = temps.wrapping_add(self.insts.iter().map(|(p, _)| p.temps).max().unwrap_or(0) * BLOCK);
        let buffer = |b: BufferId| memory.buffers[b.0 as usize];
        let mut start = range.start;
        while start < range.end {
            let len = BLOCK.min(range.end - start);
            let mut next = gathered;
            let mut operand = |arg: &FlatArg| match arg {
                FlatArg::Inst(i) => Operand::Lanes(values.wrapping_add(i * BLOCK)),
                FlatArg::Buffer(b) => Operand::Lanes(buffer(*b).wrapping_add(start)),
                // SAFETY: a buffer of one lane.
                FlatArg::BufferSplat(b) => Operand::Splat(unsafe { (*buffer(*b)).to_bits() }),
                FlatArg::Const(bits) => Operand::Splat(*bits),
                FlatArg::Pieces(pieces) => {
                    let to = next;
                    next = next.wrapping_add(BLOCK);
                    for (i, (at, b, from)) in pieces.iter().enumerate() {
                        let end = pieces.get(i + 1).map_or(self.width, |p| p.0);
                        let (a, z) = ((*at).max(start), end.min(start + len));
                        if a < z {
                            // SAFETY: the stretch lies in both the buffer and the block.
                            unsafe {
                                std::ptr::copy_nonoverlapping(buffer(*b).add(from + a - at), to.add(a - start), z - a);
                            }
                        }
                    }
                    Operand::Lanes(to)
                }
            };
            for (i, (program, args)) in self.insts.iter().enumerate() {
                let args: Vec<Operand> = args.iter().map(&mut operand).collect();
                // SAFETY: blocks of `len` lanes.
                unsafe { program.run(isa, |a| args[a as usize], temps, values.wrapping_add(i * BLOCK), len) };
            }
            for (arg, to) in &self.stores {
                let to = buffer(*to).wrapping_add(start);
                // SAFETY: lanes `start..start + len` of a buffer of `width` lanes, this thread's own.
                unsafe {
                    match operand(arg) {
                        Operand::Lanes(from) => std::ptr::copy(from, to, len),
                        Operand::Splat(bits) => std::slice::from_raw_parts_mut(to, len).fill(f32::from_bits(bits)),
                    }
                }
            }
            start += len;
        }
    }
}
