//! Half precision: what a device has for it, and what is stored in it.

use super::tile::Tile;
use raygrad_compiler::graph::Shape;
use raygrad_compiler::plan::region::{Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::plan::{Buffer, BufferKind, Program};
use raygrad_compiler::scalar::DType;
use std::fmt;

/// What a device has for half precision, beside storing it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Half {
    pub matrices: Option<Matrices>,
}

impl fmt::Display for Half {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.matrices {
            Some(Matrices { side, .. }) => write!(f, "matrices of {side} x {side} halves"),
            None => f.write_str("halves"),
        }
    }
}

/// Cooperative matrices of `side x side` that a subgroup multiplies: halves, summed in single precision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matrices {
    pub side: u32,
    /// Invocations of a subgroup.
    pub subgroup: u32,
}

impl Matrices {
    /// If tiles are made for subgroups of so many invocations: a workgroup needs at least four, and each has something of two
    /// matrices, so that matrices of 8 suit no more than 32. The smallest tile must start, which they do up to 16.
    pub fn new(side: u32, subgroup: u32) -> Option<Matrices> {
        let sizes = Matrices { side, subgroup };
        let known = [8, 16].contains(&side) && (4..=64).contains(&subgroup) && subgroup.is_power_of_two();
        (known && 2 * subgroup <= side * side && Tile::smallest(sizes).starts()).then_some(sizes)
    }
}

/// How a lane is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    F32,
    F16,
    U32,
}

impl Storage {
    pub fn bytes(self) -> u64 {
        match self {
            Storage::F32 | Storage::U32 => 4,
            Storage::F16 => 2,
        }
    }
}

impl From<DType> for Storage {
    fn from(t: DType) -> Storage {
        match t {
            DType::F32 => Storage::F32,
            DType::U32 => Storage::U32,
        }
    }
}

/// Channels from which a value may be stored in half precision: features, not coordinates.
const WIDE: usize = 16;

pub(super) fn may_be_half(shape: &Shape) -> bool {
    shape.dtype == DType::F32 && shape.channels.count() >= WIDE
}

/// How the buffers of a program are stored, by id; `half`: in mixed precision.
pub fn storages(program: &Program, half: bool) -> Vec<Storage> {
    let one = |(buffer, multiplied): (&Buffer, bool)| {
        let temporary = matches!(buffer.kind, BufferKind::Temporary { .. });
        match half && temporary && multiplied && may_be_half(&buffer.shape) {
            true => Storage::F16,
            false => buffer.shape.dtype.into(),
        }
    };
    program.buffers.iter().zip(multiplied(program)).map(one).collect()
}

/// Which buffers of a program a matrix product reads: it rounds them in any case.
fn multiplied(program: &Program) -> Vec<bool> {
    let mut found = vec![false; program.buffers.len()];
    for launch in &program.launches {
        let region = &launch.region;
        for id in region.ids().filter(|id| is_multiplied(region, *id)) {
            if let RegionOp::Load(buffer) = region.inst(id).op {
                found[buffer.0 as usize] = true;
            }
        }
    }
    found
}

/// Whether a value is an operand of a product that gets a kernel of its own: the input of a layer, or either side of an
/// outer product.
pub(super) fn is_multiplied(region: &Region, id: InstId) -> bool {
    let by_layer = |i: &Inst| matches!(i.op, RegionOp::Linear(_)) && i.inputs[0] == id;
    let by_outer = |s: &Store| matches!(s, Store::Outer { x, d, .. } if *x == id || *d == id);
    region.body.iter().any(by_layer) || region.stores.iter().any(by_outer)
}
