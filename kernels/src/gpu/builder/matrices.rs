//! Cooperative matrices.

use super::{Builder, Factor, Matrix, MatrixAt, MatrixSum};
use naga::{Expression, LocalVariable, Scalar, Span, Statement, Type, TypeInner};

impl Builder {
    /// A sum of products of matrices, zero at first.
    pub fn matrix_sum(&mut self, name: &str, side: u32) -> MatrixSum {
        let inner = TypeInner::CooperativeMatrix {
            columns: cooperative_size(side),
            rows: cooperative_size(side),
            scalar: Scalar::F32,
            role: naga::CooperativeRole::C,
        };
        let ty = self.module.types.insert(Type { name: None, inner }, Span::UNDEFINED);
        let variable = LocalVariable { name: Some(name.into()), ty, init: None };
        let variable = self.function.local_variables.append(variable, Span::UNDEFINED);
        let pointer = self.free(Expression::LocalVariable(variable));
        let zeros = self.free(Expression::ZeroValue(ty));
        self.push(Statement::Store { pointer, value: zeros });
        MatrixSum { pointer }
    }

    /// The left (`M x K`) or right (`K x N`) factor of a product, from workgroup memory of halves.
    pub fn matrix(&mut self, factor: Factor, side: u32, at: MatrixAt) -> Matrix {
        let role = match factor {
            Factor::Left => naga::CooperativeRole::A,
            Factor::Right => naga::CooperativeRole::B,
        };
        let data = self.matrix_data(at);
        let (columns, rows) = (cooperative_size(side), cooperative_size(side));
        Matrix(self.emit(Expression::CooperativeLoad { columns, rows, role, data }))
    }

    pub fn matrix_multiply_add(&mut self, a: Matrix, b: Matrix, sum: MatrixSum) {
        let c = self.emit(Expression::Load { pointer: sum.pointer });
        let value = self.emit(Expression::CooperativeMultiplyAdd { a: a.0, b: b.0, c });
        self.push(Statement::Store { pointer: sum.pointer, value });
    }

    /// Writes a sum to workgroup memory of floats.
    pub fn matrix_store(&mut self, sum: MatrixSum, at: MatrixAt) {
        let target = self.emit(Expression::Load { pointer: sum.pointer });
        let data = self.matrix_data(at);
        self.push(Statement::CooperativeStore { target, data });
    }

    fn matrix_data(&mut self, at: MatrixAt) -> naga::CooperativeData {
        let stride = self.u(at.line);
        let pointer = self.at(at.memory, at.first);
        naga::CooperativeData { pointer, stride: stride.handle, row_major: at.row_major }
    }
}

fn cooperative_size(side: u32) -> naga::CooperativeSize {
    if side == 8 { naga::CooperativeSize::Eight } else { naga::CooperativeSize::Sixteen }
}
