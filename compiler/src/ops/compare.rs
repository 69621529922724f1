//! Comparisons, `u32` 1 where true and 0 elsewhere; of floats or of integers.

use super::pointwise::{Map, binary};
use super::{Op, Pointwise, Sample, map};
use crate::graph::Tensor;
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Relation {
    Less,
    LessEqual,
    Equal,
}

/// Whether `a < b`, `a <= b` or `a == b`.
#[derive(Clone, Debug)]
pub struct Compare {
    pub relation: Relation,
    /// Lane type of the operands.
    pub dtype: DType,
}

impl Pointwise for Compare {
    fn name(&self) -> &'static str {
        match self.relation {
            Relation::Less => "less_than",
            Relation::LessEqual => "less_equal",
            Relation::Equal => "equal",
        }
    }
    fn operands(&self) -> &'static [Option<DType>] {
        match self.dtype {
            DType::F32 => &[Some(DType::F32), Some(DType::F32)],
            DType::U32 => &[Some(DType::U32), Some(DType::U32)],
        }
    }
    fn result(&self) -> Option<DType> {
        Some(DType::U32)
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        let holds = match (a[0], a[1]) {
            (Lane::U(a), Lane::U(b)) => self.relation.holds(&a, &b),
            (a, b) => self.relation.holds(&a.f(), &b.f()),
        };
        Lane::U(holds as u32)
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None, None]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        match (self.dtype, self.relation) {
            (DType::F32, Relation::Less) => b.emit(Prim::Lt, a),
            (DType::F32, Relation::LessEqual) => b.emit(Prim::Le, a),
            (DType::F32, Relation::Equal) => b.emit(Prim::Eq, a),
            (DType::U32, Relation::Less) => b.emit(Prim::ULt, a),
            (DType::U32, Relation::Equal) => b.emit(Prim::UEq, a),
            (DType::U32, Relation::LessEqual) => {
                let greater = b.emit(Prim::ULt, &[a[1], a[0]]);
                b.emit(Prim::UXor, &[greater, b.u(1)])
            }
        }
    }
}

impl Relation {
    fn holds<T: PartialOrd>(self, a: &T, b: &T) -> bool {
        match self {
            Relation::Less => a < b,
            Relation::LessEqual => a <= b,
            Relation::Equal => a == b,
        }
    }
}

#[track_caller]
fn compare(relation: Relation, a: &Tensor, b: &Tensor) -> Tensor {
    map(Compare { relation, dtype: a.dtype() }, &[a, b])
}

/// `b < a` or `b <= a` for the function `name` of a and b.
#[track_caller]
fn turned(name: &'static str, relation: Relation, a: &Tensor, b: &Tensor) -> Tensor {
    let op = Map(Compare { relation, dtype: a.dtype() });
    match op.shape(&[a.shape().clone(), b.shape().clone()]) {
        Ok(_) => Tensor::record(op, &[b, a]),
        Err(m) => Tensor::misfit(name, &[a, b], m.problem, m.hint),
    }
}

impl Tensor {
    /// 1 where `self < other`, else 0.
    #[track_caller]
    pub fn less_than(&self, other: &Tensor) -> Tensor {
        compare(Relation::Less, self, other)
    }
    /// 1 where `self <= other`, else 0.
    #[track_caller]
    pub fn less_equal(&self, other: &Tensor) -> Tensor {
        compare(Relation::LessEqual, self, other)
    }
    /// 1 where `self > other`, else 0.
    #[track_caller]
    pub fn greater_than(&self, other: &Tensor) -> Tensor {
        turned("greater_than", Relation::Less, self, other)
    }
    /// 1 where `self >= other`, else 0.
    #[track_caller]
    pub fn greater_equal(&self, other: &Tensor) -> Tensor {
        turned("greater_equal", Relation::LessEqual, self, other)
    }
    /// 1 where the two are equal, else 0.
    #[track_caller]
    pub fn equal(&self, other: &Tensor) -> Tensor {
        compare(Relation::Equal, self, other)
    }
}

pub fn samples() -> Vec<Sample> {
    let float = |name: &str, f: fn(&Tensor, &Tensor) -> Tensor| {
        binary(name, (-1.0, 1.0), (-1.0, 1.0), move |a, b| f(a, b).to_f32()).not_differentiable()
    };
    let integer = |name: &str, f: fn(&Tensor, &Tensor) -> Tensor| {
        binary(name, (0.0, 4.0), (0.0, 4.0), move |a, b| f(&a.to_u32(), &b.to_u32()).to_f32()).not_differentiable()
    };
    vec![
        float("less_than", Tensor::less_than),
        float("less_equal", Tensor::less_equal),
        float("greater_than", Tensor::greater_than),
        float("greater_equal", Tensor::greater_equal),
        float("equal", |a, b| a.floor().equal(&b.floor())),
        integer("less_than of integers", Tensor::less_than),
        integer("less_equal of integers", Tensor::less_equal),
        integer("greater_than of integers", Tensor::greater_than),
        integer("greater_equal of integers", Tensor::greater_equal),
        integer("equal of integers", Tensor::equal),
    ]
}
