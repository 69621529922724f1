//! Which values of a region the kernels of its layers compute.

use raygrad_compiler::plan::region::{InstId, Region, RegionOp};

/// Which layer's kernel computes a value: a layer's epilogue is every pointwise value of the same channels after it.
pub(super) struct Homes {
    /// The layers, in order.
    pub layers: Vec<InstId>,
    /// Per value, the layer in whose epilogue it is.
    pub home: Vec<Option<usize>>,
    /// The last layer it depends on.
    pub level: Vec<Option<usize>>,
    /// Whether it is needed outside the kernel that computes it.
    pub cut: Vec<bool>,
}

impl Homes {
    pub fn of(region: &Region) -> Homes {
        let n = region.body.len();
        let mut homes = Homes { layers: vec![], home: vec![None; n], level: vec![None; n], cut: vec![false; n] };
        for id in region.ids() {
            let (at, inst) = (id.0 as usize, region.inst(id));
            let level = inst.inputs.iter().filter_map(|i| homes.level[i.0 as usize]).max();
            homes.level[at] = level;
            if is_layer(region, id) && !is_little(region, id) {
                homes.home[at] = Some(homes.layers.len());
                homes.level[at] = homes.home[at];
                homes.layers.push(id);
                continue;
            }
            let aligned = |i: &InstId| {
                matches!(inst.op, RegionOp::Map(_))
                    && region.inst(*i).channels == inst.channels
                    && homes.home[i.0 as usize] == level
            };
            if level.is_some() && inst.inputs.iter().any(aligned) {
                homes.home[at] = level;
            }
            for i in &inst.inputs {
                let i = i.0 as usize;
                let elsewhere = homes.home[i].is_some() && homes.home[i] != homes.home[at];
                // The epilogue works channel by channel: a narrower value of the same layer comes from memory.
                let narrower = homes.home[i].is_some() && region.body[i].channels != inst.channels;
                if elsewhere || narrower {
                    homes.cut[i] = true;
                }
                if narrower && homes.home[at] == homes.home[i] {
                    homes.home[at] = None;
                }
            }
            if homes.home[at].is_none() {
                inst.inputs.iter().filter(|i| homes.home[i.0 as usize].is_some()).for_each(|i| {
                    homes.cut[i.0 as usize] = true;
                });
            }
        }
        homes
    }
}

/// Terms of a layer that the epilogue of another may compute.
const LITTLE: usize = 4;

/// Whether a value is a product with weights that has a kernel.
fn is_layer(region: &Region, id: InstId) -> bool {
    let inst = region.inst(id);
    matches!(inst.op, RegionOp::Linear(_)) && matches!(region.inst(inst.inputs[0]).op, RegionOp::Load(_))
}

/// Whether a layer has so few terms that the epilogue of the one it is added to computes it.
fn is_little(region: &Region, id: InstId) -> bool {
    let terms = |id: InstId| region.inst(region.inst(id).inputs[0]).channels;
    let beside = |other: &InstId| *other != id && is_layer(region, *other) && terms(*other) > LITTLE;
    let mut users = region.body.iter().filter(|user| user.inputs.contains(&id));
    terms(id) <= LITTLE
        && !region.stores.iter().any(|s| s.values().contains(&id))
        && users.all(|user| matches!(user.op, RegionOp::Map(_)) && user.inputs.iter().any(beside))
}
