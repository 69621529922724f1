//! Regions made of others: emptied, with values read back from memory, and without what no store needs.

use super::elements::closure;
use super::layout::Layout;
use raygrad_compiler::plan::region::{BufferId, Inst, InstId, Region, RegionOp, Store};
use raygrad_compiler::scalar::DType;

/// The same loop without contents.
pub(super) fn empty(region: &Region) -> Region {
    Region { body: vec![], stores: vec![], whole: false, ..region.clone() }
}

pub(super) fn push_load(layout: &Layout, region: &mut Region, buffer: BufferId) -> InstId {
    let shape = layout.shape(buffer);
    region.body.push(Inst {
        op: RegionOp::Load(buffer),
        inputs: vec![],
        axes: shape.axes.clone(),
        channels: shape.channels.count(),
        dtype: shape.dtype,
        label: layout.name(buffer).into(),
        source: std::panic::Location::caller(),
    });
    InstId(region.body.len() as u32 - 1)
}

/// Makes a value a load of `buffer`.
pub(super) fn replace_by_load(layout: &Layout, region: &mut Region, id: InstId, buffer: BufferId) {
    let axes = layout.shape(buffer).axes.clone();
    let inst = &mut region.body[id.0 as usize];
    debug_assert!(inst.dtype == DType::F32 || layout.shape(buffer).dtype == inst.dtype);
    *inst = Inst { op: RegionOp::Load(buffer), inputs: vec![], axes, ..inst.clone() };
}

/// Drops what no store needs; also tells the new id of a value that is needed.
pub(super) fn swept_with(region: Region, id: InstId) -> (Region, InstId) {
    let needed = closure(&region, region.stores.iter().flat_map(|s| s.values()));
    let before = needed[..id.0 as usize].iter().filter(|n| **n).count();
    (region.swept(), InstId(before as u32))
}

/// Where a value is written and a later kernel may read it: to a buffer that the region itself does not read.
pub(super) fn written_by(region: &Region, value: InstId) -> Option<BufferId> {
    let reads = region.reads();
    let written = region.stores.iter().find(|s| s.values()[0] == value && !reads.contains(&s.buffer()));
    written.map(Store::buffer)
}
