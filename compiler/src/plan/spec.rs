//! What a program may contain, checked after planning in debug builds and tests.

use super::region::{Grain, RegionOp, Store};
use super::{BufferKind, Program};
use crate::fuse::TargetKind;

/// Panics, in debug builds only, if the compiler built a program that breaks its own rules.
pub(super) fn check(program: &Program) {
    if cfg!(debug_assertions)
        && let Err(e) = verify(program)
    {
        unreachable!("the compiler planned an invalid program: {e}\n{program}");
    }
}

fn verify(program: &Program) -> Result<(), String> {
    let mut written: Vec<bool> = program.buffers.iter().map(|b| matches!(b.kind, BufferKind::Input { .. })).collect();
    for launch in &program.launches {
        let (region, name) = (&launch.region, &launch.name);
        for b in region.reads() {
            if !written[b.0 as usize] {
                return Err(format!("{name} reads {} before it is written", program.buffer(b).label));
            }
        }
        for (i, inst) in region.body.iter().enumerate() {
            if inst.inputs.iter().any(|x| x.0 as usize >= i) {
                return Err(format!("{name}: instruction {i} uses a later one"));
            }
            if !inst.axes.is_subset(&region.domain) {
                return Err(format!("{name}: instruction {i} varies along {}, outside {}", inst.axes, region.domain));
            }
            let fits = match &inst.op {
                RegionOp::Load(b) => {
                    let s = &program.buffer(*b).shape;
                    s.channels.count() == inst.channels && s.axes == inst.axes && s.dtype == inst.dtype
                }
                RegionOp::Linear(w) => {
                    let k = region.inst(inst.inputs[0]).channels;
                    let (contracted, out) = if w.transposed { (w.columns, w.rows) } else { (w.rows, w.columns) };
                    let inner_free =
                        region.inner.as_ref().is_none_or(|a| !program.buffer(w.buffer).shape.axes.contains(a));
                    k == contracted && out == inst.channels && inner_free
                }
                RegionOp::Pick(pick) => pick.iter().all(|(o, c)| {
                    inst.inputs.get(*o as usize).is_some_and(|x| (*c as usize) < region.inst(*x).channels)
                }),
                // A workgroup follows a line forwards.
                RegionOp::CumSum { reverse } => region.whole && !(*reverse && region.grain == Grain::Tile),
                RegionOp::Shift { .. } => region.whole,
                RegionOp::RowReduce(_) => {
                    let channels = region.inst(inst.inputs[0]).channels;
                    let uniform = region.inner.as_ref().is_some_and(|a| !inst.axes.contains(a));
                    region.whole && uniform && channels == inst.channels && program.target.kind == TargetKind::Cpu
                }
                _ => true,
            };
            if !fits {
                return Err(format!("{name}: instruction {i} ({:?}) does not fit its operands", inst.op));
            }
        }
        for store in &region.stores {
            let shape = &program.buffer(store.buffer()).shape;
            let fits = match store {
                Store::Write { value, .. } => {
                    shape.axes == region.domain && region.inst(*value).channels == shape.channels.count()
                }
                Store::Reduce { value, .. } => {
                    shape.axes.is_subset(&region.domain) && region.inst(*value).channels == shape.channels.count()
                }
                Store::Outer { x, d, .. } => {
                    let n = region.inst(*x).channels * region.inst(*d).channels;
                    n == shape.channels.count() && region.inner.as_ref().is_none_or(|a| !shape.axes.contains(a))
                }
                Store::Scatter { value, axis, .. } => {
                    shape.axes.contains(axis) && region.inst(*value).channels == shape.channels.count()
                }
            };
            if !fits {
                return Err(format!("{name}: a store does not fit {} ({shape})", program.buffer(store.buffer()).label));
            }
            written[store.buffer().0 as usize] = true;
        }
    }
    for (name, b) in &program.outputs {
        if !written[b.0 as usize] {
            return Err(format!("output `{name}` is never written"));
        }
    }
    Ok(())
}
