//! Temporaries of pointwise programs: as few blocks of lanes as the longest-lived results need.

use super::{BLOCK, LaneProgram, Source};
use crate::cpu::{Isa, Operand, Operands, apply};
use raygrad_compiler::scalar::{ScalarProgram, Val};

/// Assigns temporaries to a scalar program's intermediate results.
pub(super) fn lane_program(program: &ScalarProgram) -> LaneProgram {
    let n = program.code.len();
    let mut last_use = vec![0; n];
    for (at, (_, args)) in program.code.iter().enumerate() {
        for arg in args {
            if let Val::Inst(i) = arg {
                last_use[*i as usize] = at;
            }
        }
    }
    let mut place = vec![0u8; n];
    let mut free: Vec<u8> = vec![];
    let mut temps = 0u8;
    let mut code = vec![];
    for (at, (prim, args)) in program.code.iter().enumerate() {
        let mut sources = [Source::Const(0); 3];
        for (source, arg) in sources.iter_mut().zip(args) {
            *source = match arg {
                Val::Input(i) => Source::Arg(*i),
                Val::Const(c) => Source::Const(*c),
                Val::Inst(i) => Source::Temp(place[*i as usize]),
            };
        }
        for (i, last) in last_use.iter().enumerate().take(at) {
            let used_here = args.contains(&Val::Inst(i as u16));
            if used_here && *last == at {
                free.push(place[i]);
            }
        }
        let to = free.pop().unwrap_or_else(|| {
            temps += 1;
            temps - 1
        });
        place[at] = to;
        code.push((*prim, sources, to));
    }
    LaneProgram { code, temps: temps as usize }
}

impl LaneProgram {
    /// Computes `len` lanes, at most [`BLOCK`]; the last instruction writes `out`.
    ///
    /// # Safety
    /// `isa.supported()`. `temps` has a block for each temporary, and the arguments and `out` have `len` lanes.
    pub(super) unsafe fn run(&self, isa: Isa, arg: impl Fn(u8) -> Operand, temps: *mut f32, out: *mut f32, len: usize) {
        let temporary = |t: u8| temps.wrapping_add(t as usize * BLOCK);
        for (i, (prim, sources, to)) in self.code.iter().enumerate() {
            let out = if i + 1 == self.code.len() { out } else { temporary(*to) };
            let mut operands = Operands::NONE;
            for (i, source) in sources.iter().enumerate() {
                let operand = match *source {
                    Source::Const(bits) => Operand::Splat(bits),
                    Source::Temp(t) => Operand::Lanes(temporary(t)),
                    Source::Arg(a) => arg(a),
                };
                operands.set(i, operand);
            }
            // SAFETY: forwarded contract.
            unsafe { apply(isa, *prim, out, &operands, len) };
        }
    }
}
