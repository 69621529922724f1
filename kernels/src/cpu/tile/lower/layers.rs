//! Layers, with the sums, rectifiers and masks after them that a matrix kernel applies itself.

use super::*;

/// A layer and what its only reader does with it.
pub(super) struct FusedLayer {
    layer: InstId,
    /// Values added to every row.
    biases: Vec<InstId>,
    epilogue: LayerEpilogue,
}

impl Lowering<'_> {
    /// A layer without a value yet whose only reader is a pointwise program that the matrix kernel can apply itself. The
    /// program's other operands are known.
    pub(super) fn layer_of(&self, id: InstId) -> Option<FusedLayer> {
        let inst = self.region.inst(id);
        let RegionOp::Map(program) = &inst.op else { return None };
        let mut unknown = inst.inputs.iter().filter(|i| !self.values.known(**i));
        let (Some(&layer), None) = (unknown.next(), unknown.next()) else { return None };
        let alone = matches!(self.region.inst(layer).op, RegionOp::Linear(_))
            && self.values.users(layer) == 1
            && self.region.inst(layer).axes == inst.axes
            && self.region.inst(layer).channels == inst.channels
            && !self.region.is_uniform(id);
        if !alone {
            return None;
        }
        let at = |i: InstId| Val::Input(inst.inputs.iter().position(|x| *x == i).unwrap_or_default() as u8);
        let others: Vec<InstId> = inst.inputs.iter().copied().filter(|i| *i != layer).collect();
        let (y, zero) = (at(layer), Val::Const(0));
        if let ([(Prim::Lt, lt), (Prim::Select, select)], [h]) = (&program.code[..], &others[..])
            && *lt == [zero, at(*h)]
            && *select == [Val::Inst(0), y, zero]
            && !self.region.is_uniform(*h)
            && self.region.inst(*h).channels == inst.channels
        {
            let h = self.values.contiguous(self.values.get(*h))?;
            return Some(FusedLayer { layer, biases: vec![], epilogue: LayerEpilogue::Mask(h) });
        }
        // Sums of the layer and values that do not vary along the tile, rectified or not.
        let is_bias = |i: &InstId| {
            self.region.is_uniform(*i)
                && self.region.inst(*i).channels == inst.channels
                && self.values.contiguous(self.values.get(*i)).is_some()
        };
        let (adds, epilogue) = match program.code.split_last()? {
            ((Prim::Max, args), adds) => {
                let rectified = adds.len().checked_sub(1).map_or(y, |last| Val::Inst(last as u16));
                (*args == [zero, rectified]).then_some((adds, LayerEpilogue::Relu))?
            }
            _ => (&program.code[..], LayerEpilogue::None),
        };
        let terms: Vec<Val> = adds.iter().flat_map(|(_, args)| args.iter().copied()).collect();
        let once = |v: Val| terms.iter().filter(|t| **t == v).count() == 1;
        let plain_sum = adds.iter().all(|(prim, _)| *prim == Prim::Add)
            && others.iter().all(|i| once(at(*i)))
            && (adds.is_empty() || once(y))
            && (1..adds.len()).all(|i| once(Val::Inst(i as u16 - 1)))
            && !terms.iter().any(|t| matches!(t, Val::Const(_)));
        (plain_sum && others.iter().all(is_bias)).then_some(FusedLayer { layer, biases: others, epilogue })
    }

    /// Whether `id` is a layer that its only reader computes, see [`Lowering::layer_of`]. Its operand stays alive till then.
    pub(super) fn fused_into_user(&self, id: InstId) -> bool {
        if !matches!(self.region.inst(id).op, RegionOp::Linear(_)) || self.values.users(id) != 1 {
            return false;
        }
        let user = self.region.ids().find(|u| self.region.inst(*u).inputs.contains(&id));
        user.and_then(|user| self.layer_of(user)).is_some()
    }

    /// Computes a layer with its epilogue as the value of `id`.
    pub(super) fn layer_as(&mut self, id: InstId, fused: &FusedLayer) {
        let mut sum = None;
        let place = |v: &Values, b: &InstId| v.contiguous(v.get(*b));
        let mut bias = fused.biases.first().and_then(|b| place(&self.values, b));
        if fused.biases.len() > 1 {
            let channels = self.region.inst(id).channels;
            let (to, lanes) = self.values.temporary(channels, false);
            for other in fused.biases[1..].iter().filter_map(|b| place(&self.values, b)) {
                let add = ScalarProgram { code: vec![(Prim::Add, vec![Val::Input(0), Val::Input(1)])] };
                let args = vec![RunArg::Lanes(bias.unwrap_or(to)), RunArg::Lanes(other)];
                let runs = vec![Run { out: to, channels, args }];
                self.out.ops.push(TileOp::Map { program: lane_program(&add), runs, full: false });
                bias = Some(to);
            }
            sum = Some((to, lanes));
        }
        self.layer(id, fused.layer, bias, fused.epilogue);
        sum.into_iter().for_each(|s| self.values.release_temporary(s));
        // The layer's operand was held for this moment; the layer itself never had a value.
        self.values.done(self.region.inst(fused.layer).inputs[0]);
        for input in self.region.inst(id).inputs.iter().filter(|i| **i != fused.layer) {
            self.values.done(*input);
        }
    }

    /// Stretches of neighbouring channels of a full value: first place, first channel, channels.
    fn stretches(&self, id: InstId) -> Vec<(Place, usize, usize)> {
        let value = self.values.get(id);
        let mut all: Vec<(Place, usize, usize)> = vec![];
        for (c, place) in value.places.iter().enumerate() {
            match all.last_mut() {
                Some((first, _, n)) if *first + *n * self.out.ld == *place => *n += 1,
                _ => all.push((*place, c, 1)),
            }
        }
        all
    }

    /// The stretches of a wide full value that is not worth copying together, if `usable` says they can be used apart.
    pub(super) fn apart(&self, id: InstId, usable: impl Fn(usize) -> bool) -> Option<Vec<(Place, usize, usize)>> {
        let value = self.values.get(id);
        if !value.full || value.places.len() < WIDE || self.values.contiguous(value).is_some() {
            return None;
        }
        let all = self.stretches(id);
        (all.len() <= 4 && all.iter().all(|(_, first, _)| usable(*first))).then_some(all)
    }

    pub(super) fn layer(&mut self, id: InstId, layer: InstId, bias: Option<Place>, epilogue: LayerEpilogue) {
        let inst = self.region.inst(layer);
        let RegionOp::Linear(weights) = inst.op else { unreachable!("only layers are passed here") };
        let full = !self.region.is_uniform(layer);
        let contraction = if weights.transposed { weights.columns } else { weights.rows };
        let outputs = inst.channels;
        // Rows of untransposed weights are a matrix of their own: one product per stretch of the operand.
        if let Some(parts) = self.apart(inst.inputs[0], |_| !weights.transposed) {
            let out = self.values.create(id, outputs, full);
            let last = parts.len() - 1;
            for (i, (x, first, n)) in parts.into_iter().enumerate() {
                let rows = Weights { first: weights.first + first * weights.columns, rows: n, ..weights };
                let pack = self.pack(rows, n, outputs, full);
                let epilogue = if i == last { epilogue } else { LayerEpilogue::None };
                let bias = if i == 0 { bias } else { None };
                let op = Layer { x, contraction: n, pack, bias, accumulate: i > 0, epilogue, out, outputs, full };
                self.out.ops.push(TileOp::Layer(op));
            }
            return;
        }
        let (x, copy) = self.side_by_side(inst.inputs[0], full);
        let out = self.values.create(id, outputs, full);
        let pack = self.pack(weights, contraction, outputs, full);
        let op = Layer { x, contraction, pack, bias, accumulate: false, epilogue, out, outputs, full };
        self.out.ops.push(TileOp::Layer(op));
        copy.into_iter().for_each(|c| self.values.release_temporary(c));
    }

    /// Weights of a layer on full values, or on uniform ones, which are few enough to be multiplied in single precision.
    fn pack(&mut self, weights: Weights, contraction: usize, outputs: usize, full: bool) -> usize {
        let products = if full { self.out.products } else { Products::F32 };
        if let Some(known) = self.out.packs.iter().position(|p| p.weights == weights && p.products == products) {
            return known;
        }
        let view = self.view(weights.buffer);
        let len = panel_len(products, contraction, outputs).next_multiple_of(16);
        let elements = view.elements;
        self.out.packs.push(Pack { weights, products, view, at: self.out.packed, len, elements });
        self.out.packed += len * elements;
        self.out.packs.len() - 1
    }
}
