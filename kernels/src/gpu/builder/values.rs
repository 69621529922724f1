//! Values: inputs, constants and arithmetic.

use super::{Builder, Kind, Pure, Value};
use naga::{
    BinaryOperator, Expression, Literal, MathFunction, Scalar, ScalarKind, Span, Type, TypeInner, UnaryOperator,
    VectorSize,
};

impl Builder {
    /// A built-in input of the entry point.
    pub fn built_in(&mut self, name: &str, what: naga::BuiltIn) -> Value {
        let three = !matches!(what, naga::BuiltIn::LocalInvocationIndex | naga::BuiltIn::SubgroupId);
        let inner = TypeInner::Vector { size: VectorSize::Tri, scalar: Scalar::U32 };
        let ty = match three {
            true => self.module.types.insert(Type { name: None, inner }, Span::UNDEFINED),
            false => self.ty(Kind::U32, false),
        };
        let binding = Some(naga::Binding::BuiltIn(what));
        self.function.arguments.push(naga::FunctionArgument { name: Some(name.into()), ty, binding });
        let at = self.function.arguments.len() as u32 - 1;
        let handle = self.free(Expression::FunctionArgument(at));
        Value { handle, kind: Kind::U32, vector: false }
    }

    /// Component of a vector.
    pub fn component(&mut self, of: Value, index: u32) -> Value {
        let (handle, kind) = (of.handle, of.kind);
        self.pure(Pure::Component(handle, index), Expression::AccessIndex { base: handle, index }, kind, false)
    }

    pub fn u(&mut self, x: u32) -> Value {
        self.literal(Kind::U32, x)
    }

    pub fn f(&mut self, x: f32) -> Value {
        self.literal(Kind::F32, x.to_bits())
    }

    /// A constant of the given bits; of `Bool`, whether they are not 0.
    pub fn literal(&mut self, kind: Kind, bits: u32) -> Value {
        if let Some(known) = self.literals.get(&(kind, bits)) {
            return *known;
        }
        let literal = match kind {
            Kind::F32 if !f32::from_bits(bits).is_finite() => return self.not_finite(bits),
            Kind::F32 => Literal::F32(f32::from_bits(bits)),
            Kind::U32 => Literal::U32(bits),
            Kind::Bool => Literal::Bool(bits != 0),
            Kind::F16 => unreachable!("constants are floats"),
        };
        let handle = self.free(Expression::Literal(literal));
        let value = Value { handle, kind, vector: false };
        self.literals.insert((kind, bits), value);
        value
    }

    /// Infinity and NaN have no literals, not even as constant expressions: their bits take the way through a variable.
    fn not_finite(&mut self, bits: u32) -> Value {
        let bits = self.u(bits);
        let var = self.var("bits", bits);
        let bits = self.get(var);
        self.bitcast(bits, Kind::F32)
    }

    /// The constant bits of an integer, if it is one.
    fn constant(&self, v: Value) -> Option<u32> {
        match self.function.expressions[v.handle] {
            Expression::Literal(Literal::U32(x)) => Some(x),
            _ => None,
        }
    }

    /// Four equal scalars; a vector stays as it is.
    pub fn splat(&mut self, v: Value) -> Value {
        if v.vector {
            return v;
        }
        let e = Expression::Splat { size: VectorSize::Quad, value: v.handle };
        self.pure(Pure::Splat(v.handle), e, v.kind, true)
    }

    pub fn vector(&mut self, components: [Value; 4]) -> Value {
        if components.iter().all(|c| *c == components[0]) {
            return self.splat(components[0]);
        }
        let kind = components[0].kind;
        let ty = self.ty(kind, true);
        let handle = self.emit(Expression::Compose { ty, components: components.map(|c| c.handle).to_vec() });
        Value { handle, kind, vector: true }
    }

    /// Vectors where any operand is one.
    fn alike<const N: usize>(&mut self, values: [Value; N]) -> [Value; N] {
        let vector = values.iter().any(|v| v.vector);
        values.map(|v| if vector { self.splat(v) } else { v })
    }

    pub fn unary(&mut self, op: UnaryOperator, v: Value) -> Value {
        self.pure(Pure::Unary(op, v.handle), Expression::Unary { op, expr: v.handle }, v.kind, v.vector)
    }

    pub fn binary(&mut self, op: BinaryOperator, a: Value, b: Value) -> Value {
        use BinaryOperator as Op;
        if let Some(folded) = self.fold(op, a, b) {
            return folded;
        }
        let shift = matches!(op, Op::ShiftLeft | Op::ShiftRight);
        let [a, b] = self.alike([a, b]);
        debug_assert!(shift || a.kind == b.kind, "{op:?} of {:?} and {:?}", a.kind, b.kind);
        let compares =
            matches!(op, Op::Equal | Op::NotEqual | Op::Less | Op::LessEqual | Op::Greater | Op::GreaterEqual);
        let kind = if compares { Kind::Bool } else { a.kind };
        let e = Expression::Binary { op, left: a.handle, right: b.handle };
        self.pure(Pure::Binary(op, a.handle, b.handle), e, kind, a.vector)
    }

    /// Index arithmetic on constants.
    fn fold(&mut self, op: BinaryOperator, a: Value, b: Value) -> Option<Value> {
        use BinaryOperator as Op;
        if a.kind != Kind::U32 || a.vector || b.vector {
            return None;
        }
        let (x, y) = (self.constant(a), self.constant(b));
        match (op, x, y) {
            (Op::Add, Some(x), Some(y)) => Some(self.u(x.wrapping_add(y))),
            (Op::Multiply, Some(x), Some(y)) => Some(self.u(x.wrapping_mul(y))),
            (Op::Divide, Some(x), Some(y)) if y > 0 => Some(self.u(x / y)),
            (Op::Modulo, Some(x), Some(y)) if y > 0 => Some(self.u(x % y)),
            (Op::Add, Some(0), _) => Some(b),
            (Op::Add | Op::Subtract, _, Some(0)) => Some(a),
            (Op::Multiply, Some(1), _) => Some(b),
            (Op::Multiply | Op::Divide, _, Some(1)) => Some(a),
            (Op::Multiply, Some(0), _) | (Op::Multiply, _, Some(0)) => Some(self.u(0)),
            (Op::Modulo, _, Some(1)) => Some(self.u(0)),
            _ => None,
        }
    }

    pub fn add(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Add, a, b)
    }
    pub fn sub(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Subtract, a, b)
    }
    pub fn mul(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Multiply, a, b)
    }
    pub fn div(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Divide, a, b)
    }
    pub fn rem(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Modulo, a, b)
    }
    pub fn less(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::Less, a, b)
    }
    pub fn and(&mut self, a: Value, b: Value) -> Value {
        self.binary(BinaryOperator::And, a, b)
    }

    pub fn math(&mut self, fun: MathFunction, args: &[Value]) -> Value {
        let vector = args.iter().any(|v| v.vector);
        let args: Vec<Value> = args.iter().map(|v| if vector { self.splat(*v) } else { *v }).collect();
        let (arg, kind) = (args[0].handle, args[0].kind);
        let (arg1, arg2) = (args.get(1).map(|v| v.handle), args.get(2).map(|v| v.handle));
        let e = Expression::Math { fun, arg, arg1, arg2, arg3: None };
        self.pure(Pure::Math(fun, arg, arg1, arg2), e, kind, vector)
    }

    /// `a * b + c`, as one operation where the device has it.
    pub fn fma(&mut self, a: Value, b: Value, c: Value) -> Value {
        self.math(MathFunction::Fma, &[a, b, c])
    }

    pub fn select(&mut self, condition: Value, accept: Value, reject: Value) -> Value {
        let [condition, accept, reject] = self.alike([condition, accept, reject]);
        debug_assert_eq!((condition.kind, accept.kind), (Kind::Bool, reject.kind));
        let (c, a, r) = (condition.handle, accept.handle, reject.handle);
        let e = Expression::Select { condition: c, accept: a, reject: r };
        self.pure(Pure::Select(c, a, r), e, accept.kind, accept.vector)
    }

    /// Conversion of numbers.
    pub fn convert(&mut self, v: Value, kind: Kind) -> Value {
        self.cast(v, kind, true)
    }

    /// The same bits as another type.
    pub fn bitcast(&mut self, v: Value, kind: Kind) -> Value {
        if v.kind == kind { v } else { self.cast(v, kind, false) }
    }

    fn cast(&mut self, v: Value, to: Kind, convert: bool) -> Value {
        let kind = match to {
            Kind::F32 | Kind::F16 => ScalarKind::Float,
            Kind::U32 => ScalarKind::Uint,
            Kind::Bool => ScalarKind::Bool,
        };
        let width = if to == Kind::F16 { 2 } else { 4 };
        let e = Expression::As { expr: v.handle, kind, convert: convert.then_some(width) };
        self.pure(Pure::As(v.handle, to, convert), e, to, v.vector)
    }
}
