//! Merges chains of pointwise instructions into one scalar program each.

use crate::plan::region::{Inst, InstId, Region, RegionOp};
use crate::scalar::{ScalarProgram, Val};
use std::sync::Arc;

/// Longest scalar program; beyond it a chain is cut, so that a tile's temporaries stay few.
const MAX_CODE: usize = 48;
/// Most operands of a merged program.
const MAX_INPUTS: usize = 12;

/// Merges every pointwise instruction into its only user where both run over the same lanes, inlines constants, and
/// drops what is not used.
pub(super) fn merge(region: Region) -> Region {
    let mut users = vec![0usize; region.body.len()];
    for input in region.body.iter().flat_map(|i| &i.inputs) {
        users[input.0 as usize] += 1;
    }
    for value in region.stores.iter().flat_map(|s| s.values()) {
        users[value.0 as usize] += 1;
    }
    let mut body = region.body.clone();
    for at in 0..body.len() {
        let RegionOp::Map(program) = body[at].op.clone() else { continue };
        let mut merged = Merged { inputs: vec![], program: ScalarProgram::default() };
        let mut label: Vec<String> = vec![];
        let inst = body[at].clone();
        let operands: Vec<Operand> = inst
            .inputs
            .iter()
            .map(|i| {
                let producer = &body[i.0 as usize];
                match &producer.op {
                    RegionOp::Const(bits) if bits.iter().all(|b| *b == bits[0]) => Operand::Const(bits[0]),
                    RegionOp::Map(p)
                        if users[i.0 as usize] == 1
                            && producer.axes == inst.axes
                            && producer.channels == inst.channels
                            && p.code.len() + program.code.len() <= MAX_CODE
                            && producer.inputs.len() + inst.inputs.len() <= MAX_INPUTS =>
                    {
                        label.push(producer.label.clone());
                        Operand::Inline(p.clone(), producer.inputs.clone())
                    }
                    _ => Operand::Value(*i),
                }
            })
            .collect();
        let args: Vec<Val> = operands.iter().map(|o| merged.operand(o)).collect();
        merged.append(&program, &args);
        label.push(inst.label.clone());
        body[at] =
            Inst { op: RegionOp::Map(Arc::new(merged.program)), inputs: merged.inputs, label: label.join("+"), ..inst };
    }
    Region { body, ..region }.swept()
}

enum Operand {
    Const(u32),
    Inline(Arc<ScalarProgram>, Vec<InstId>),
    Value(InstId),
}

struct Merged {
    inputs: Vec<InstId>,
    program: ScalarProgram,
}

impl Merged {
    fn input(&mut self, id: InstId) -> Val {
        let at = self.inputs.iter().position(|i| *i == id).unwrap_or_else(|| {
            self.inputs.push(id);
            self.inputs.len() - 1
        });
        Val::Input(at as u8)
    }

    fn operand(&mut self, operand: &Operand) -> Val {
        match operand {
            Operand::Const(bits) => Val::Const(*bits),
            Operand::Value(id) => self.input(*id),
            Operand::Inline(program, inputs) => {
                let args: Vec<Val> = inputs.iter().map(|i| self.input(*i)).collect();
                self.append(program, &args)
            }
        }
    }

    fn append(&mut self, program: &ScalarProgram, args: &[Val]) -> Val {
        let offset = self.program.code.len() as u16;
        for (prim, operands) in &program.code {
            let moved = operands.iter().map(|v| match v {
                Val::Input(i) => args[*i as usize],
                Val::Inst(i) => Val::Inst(i + offset),
                Val::Const(c) => Val::Const(*c),
            });
            self.program.code.push((*prim, moved.collect()));
        }
        Val::Inst(self.program.code.len() as u16 - 1)
    }
}
