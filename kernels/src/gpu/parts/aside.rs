//! Values that replace an input which is still read.

use super::Part;
use crate::gpu::LowerError;
use crate::gpu::layout::Layout;
use crate::gpu::regions::{empty, push_load};
use raygrad_compiler::plan::region::{BufferId, Region, Store};

/// Redirects writes that replace a buffer which a later part, or another invocation of the same part, still reads.
pub(super) fn put_aside(layout: &mut Layout, original: &Region, parts: &mut Vec<Part>) -> Result<(), LowerError> {
    let replaced: Vec<BufferId> = {
        let reads = original.reads();
        original.stores.iter().map(Store::buffer).filter(|b| reads.contains(b)).collect()
    };
    let mut copies = vec![];
    for buffer in replaced {
        let writes = |p: &mut Part| p.region().stores.iter().any(|s| s.buffer() == buffer);
        let Some(writer) = parts.iter_mut().position(writes) else { continue };
        let later = parts[writer + 1..].iter_mut().any(|p| p.region().reads().contains(&buffer));
        if !later && matches!(parts[writer], Part::Elements(_)) {
            continue;
        }
        let aside = layout.scratch("aside", layout.shape(buffer).clone())?;
        for store in &mut parts[writer].region().stores {
            if let Store::Write { buffer: b, .. } = store
                && *b == buffer
            {
                *b = aside;
            }
        }
        let mut copy = Region { domain: layout.shape(buffer).axes.clone(), ..empty(original) };
        let value = push_load(layout, &mut copy, aside);
        copy.stores.push(Store::Write { value, buffer });
        copies.push(Part::Elements(copy));
    }
    parts.extend(copies);
    Ok(())
}
