//! An op of a user's own, which prints like a built-in one.

use raygrad_compiler::Tensor;
use raygrad_compiler::ops::Pointwise;
use raygrad_compiler::reference::Lane;
use raygrad_compiler::scalar::{DType, Prim, ScalarBuilder, Val};

/// Twice its operand, whatever it is called.
#[derive(Clone, Debug)]
pub struct Neg;

impl Pointwise for Neg {
    fn name(&self) -> &'static str {
        "twice"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::F32)]
    }
    fn eval(&self, args: &[Lane]) -> Lane {
        Lane::F(2.0 * args[0].f())
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, grad: &Tensor) -> Vec<Option<Tensor>> {
        vec![Some(grad * 2.0)]
    }
    fn lower(&self, b: &mut ScalarBuilder, args: &[Val]) -> Val {
        b.emit(Prim::Add, &[args[0], args[0]])
    }
}
