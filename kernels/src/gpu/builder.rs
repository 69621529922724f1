//! A small typed builder of naga IR: one compute entry point, written statement by statement.
//!
//! naga's rules are kept here so that the lowering need not know them: what is emitted and in which block, that values
//! of an inner block end with it, that loop-carried values are local variables, and that long expressions need names
//! (parsers of the printed WGSL recurse). Equal pure expressions are built once a block, and index arithmetic on
//! constants is folded.
//!
//! One file above 400 lines: all of it keeps the same few invariants of the block that is being written.

use super::half::Storage;
use naga::{
    AddressSpace, ArraySize, BinaryOperator, Block, Expression, Function, GlobalVariable, Handle, Literal,
    LocalVariable, MathFunction, Module, Range, ResourceBinding, Scalar, ScalarKind, Span, Statement, StorageAccess,
    Type, TypeInner, UnaryOperator, VectorSize,
};
use raygrad_compiler::scalar::DType;
use std::collections::HashMap;

/// Scalar type of a value. Halves are only stored and multiplied as matrices; everything else is computed in `F32`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    F32,
    F16,
    U32,
    Bool,
}

impl From<DType> for Kind {
    fn from(t: DType) -> Kind {
        match t {
            DType::F32 => Kind::F32,
            DType::U32 => Kind::U32,
        }
    }
}

impl From<Storage> for Kind {
    fn from(s: Storage) -> Kind {
        match s {
            Storage::F32 => Kind::F32,
            Storage::F16 => Kind::F16,
            Storage::U32 => Kind::U32,
        }
    }
}

impl Kind {
    fn scalar(self) -> Scalar {
        match self {
            Kind::F32 => Scalar::F32,
            Kind::F16 => Scalar::F16,
            Kind::U32 => Scalar::U32,
            Kind::Bool => Scalar::BOOL,
        }
    }
}

/// A value of the kernel: a scalar, or four of them side by side.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Value {
    handle: Handle<Expression>,
    pub kind: Kind,
    pub vector: bool,
}

/// A mutable variable of an invocation.
#[derive(Clone, Copy, Debug)]
pub struct Var {
    pointer: Handle<Expression>,
    kind: Kind,
    vector: bool,
}

impl Var {
    pub fn is_vector(self) -> bool {
        self.vector
    }
}

/// An array in workgroup memory, private memory or a storage buffer.
#[derive(Clone, Copy, Debug)]
pub struct Memory {
    pointer: Handle<Expression>,
    kind: Kind,
    /// Its elements are four lanes each.
    pub vector: bool,
}

/// A factor of a product of cooperative matrices.
#[derive(Clone, Copy, Debug)]
pub struct Matrix(Handle<Expression>);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Factor {
    Left,
    Right,
}

/// A sum of products of cooperative matrices.
#[derive(Clone, Copy, Debug)]
pub struct MatrixSum {
    pointer: Handle<Expression>,
}

/// Where a cooperative matrix lies: lines of so many elements of memory, from element `first` on. Lines are rows or columns.
#[derive(Clone, Copy, Debug)]
pub struct MatrixAt {
    pub memory: Memory,
    pub first: Value,
    pub line: u32,
    pub row_major: bool,
}

/// Key of a pure expression; equal ones are built once a block.
#[derive(PartialEq, Eq, Hash)]
enum Pure {
    Unary(UnaryOperator, Handle<Expression>),
    Binary(BinaryOperator, Handle<Expression>, Handle<Expression>),
    Math(MathFunction, Handle<Expression>, Option<Handle<Expression>>, Option<Handle<Expression>>),
    Select(Handle<Expression>, Handle<Expression>, Handle<Expression>),
    As(Handle<Expression>, Kind, bool),
    Splat(Handle<Expression>),
    Component(Handle<Expression>, u32),
}

enum Frame {
    Body,
    If(Handle<Expression>),
    Else(Handle<Expression>, Block),
    Loop { counter: Var, step: u32 },
}

/// A block being written.
struct Scope {
    id: u32,
    frame: Frame,
    block: Block,
    pure: HashMap<Pure, Value>,
}

/// Builds one kernel.
pub struct Builder {
    module: Module,
    function: Function,
    frames: Vec<Scope>,
    scopes: u32,
    literals: HashMap<(Kind, u32), Value>,
    /// Floats that were converted from halves, with what they were.
    halves: HashMap<Handle<Expression>, Value>,
    types: HashMap<(Kind, bool), Handle<Type>>,
    /// What values are called that are used more than once and have no name of their own.
    topics: Vec<String>,
    topic_of: Vec<u32>,
    pointers: Vec<bool>,
    names: HashMap<Handle<Expression>, String>,
    pub workgroup_size: u32,
    bindings: u32,
}

impl Builder {
    pub fn new(workgroup_size: u32) -> Builder {
        Builder {
            module: Module::default(),
            function: Function::default(),
            frames: vec![Scope { id: 0, frame: Frame::Body, block: Block::new(), pure: HashMap::new() }],
            scopes: 1,
            literals: HashMap::new(),
            halves: HashMap::new(),
            types: HashMap::new(),
            topics: vec!["value".into()],
            topic_of: vec![],
            pointers: vec![],
            names: HashMap::new(),
            workgroup_size,
            bindings: 0,
        }
    }

    // Types and memory.

    fn ty(&mut self, kind: Kind, vector: bool) -> Handle<Type> {
        let scalar = kind.scalar();
        let inner =
            if vector { TypeInner::Vector { size: VectorSize::Quad, scalar } } else { TypeInner::Scalar(scalar) };
        let types = &mut self.module.types;
        *self.types.entry((kind, vector)).or_insert_with(|| types.insert(Type { name: None, inner }, Span::UNDEFINED))
    }

    fn array(&mut self, kind: Kind, vector: bool, size: ArraySize) -> Handle<Type> {
        let base = self.ty(kind, vector);
        let stride = u32::from(kind.scalar().width) * if vector { 4 } else { 1 };
        let inner = TypeInner::Array { base, size, stride };
        self.module.types.insert(Type { name: None, inner }, Span::UNDEFINED)
    }

    /// A read-only storage buffer, bound in the order of these calls, of single lanes or of vectors of four.
    pub fn storage(&mut self, name: &str, kind: Kind, vector: bool) -> Memory {
        let ty = self.array(kind, vector, ArraySize::Dynamic);
        let access = StorageAccess::LOAD;
        let binding = Some(ResourceBinding { group: 0, binding: self.bindings });
        self.bindings += 1;
        self.global(name, AddressSpace::Storage { access }, binding, ty, kind, vector)
    }

    /// Allows writing to a storage buffer.
    pub fn make_writable(&mut self, memory: Memory) {
        if let Expression::GlobalVariable(variable) = self.function.expressions[memory.pointer] {
            let access = StorageAccess::LOAD | StorageAccess::STORE;
            self.module.global_variables.get_mut(variable).space = AddressSpace::Storage { access };
        }
    }

    /// An array in workgroup memory.
    pub fn workgroup(&mut self, name: &str, kind: Kind, vector: bool, size: u32) -> Memory {
        let ty = self.array(kind, vector, fixed(size));
        self.global(name, AddressSpace::WorkGroup, None, ty, kind, vector)
    }

    fn global(
        &mut self,
        name: &str,
        space: AddressSpace,
        binding: Option<ResourceBinding>,
        ty: Handle<Type>,
        kind: Kind,
        vector: bool,
    ) -> Memory {
        let memory_decorations = naga::MemoryDecorations::empty();
        let variable = GlobalVariable { name: Some(name.into()), space, binding, ty, init: None, memory_decorations };
        let variable = self.module.global_variables.append(variable, Span::UNDEFINED);
        Memory { pointer: self.free(Expression::GlobalVariable(variable)), kind, vector }
    }

    /// An array of this invocation alone.
    pub fn private(&mut self, name: &str, kind: Kind, vector: bool, size: u32) -> Memory {
        let ty = self.array(kind, vector, fixed(size));
        let variable = LocalVariable { name: Some(name.into()), ty, init: None };
        let variable = self.function.local_variables.append(variable, Span::UNDEFINED);
        Memory { pointer: self.free(Expression::LocalVariable(variable)), kind, vector }
    }

    /// A variable with a first value.
    pub fn var(&mut self, name: &str, first: Value) -> Var {
        let ty = self.ty(first.kind, first.vector);
        let variable = LocalVariable { name: Some(name.into()), ty, init: None };
        let variable = self.function.local_variables.append(variable, Span::UNDEFINED);
        let pointer = self.free(Expression::LocalVariable(variable));
        let var = Var { pointer, kind: first.kind, vector: first.vector };
        self.set(var, first);
        var
    }

    pub fn set(&mut self, var: Var, value: Value) {
        debug_assert_eq!((var.kind, var.vector), (value.kind, value.vector));
        self.push(Statement::Store { pointer: var.pointer, value: value.handle });
    }

    pub fn get(&mut self, var: Var) -> Value {
        let handle = self.emit(Expression::Load { pointer: var.pointer });
        Value { handle, kind: var.kind, vector: var.vector }
    }

    fn at(&mut self, memory: Memory, index: Value) -> Handle<Expression> {
        debug_assert_eq!(index.kind, Kind::U32);
        let handle = self.emit(Expression::Access { base: memory.pointer, index: index.handle });
        self.pointers[handle.index()] = true;
        handle
    }

    /// One lane of memory whose elements may be vectors.
    fn at_lane(&mut self, memory: Memory, lane: Value) -> Handle<Expression> {
        if !memory.vector {
            return self.at(memory, lane);
        }
        let four = self.u(4);
        let (element, component) = (self.div(lane, four), self.rem(lane, four));
        let base = self.at(memory, element);
        let handle = self.emit(Expression::Access { base, index: component.handle });
        self.pointers[handle.index()] = true;
        handle
    }

    /// An element of memory; halves become floats.
    pub fn load(&mut self, memory: Memory, index: Value) -> Value {
        let pointer = self.at(memory, index);
        self.loaded(pointer, memory.kind, memory.vector)
    }

    /// One lane of memory; of halves, as a float.
    pub fn load_lane(&mut self, memory: Memory, lane: Value) -> Value {
        let pointer = self.at_lane(memory, lane);
        self.loaded(pointer, memory.kind, false)
    }

    /// An element of workgroup memory, known to be the same for all invocations; all wait for each other.
    pub fn load_uniform(&mut self, memory: Memory, index: Value) -> Value {
        let pointer = self.at(memory, index);
        let ty = self.ty(memory.kind, memory.vector);
        let result = self.append(Expression::WorkGroupUniformLoadResult { ty });
        self.push(Statement::WorkGroupUniformLoad { pointer, result });
        Value { handle: result, kind: memory.kind, vector: memory.vector }
    }

    fn loaded(&mut self, pointer: Handle<Expression>, kind: Kind, vector: bool) -> Value {
        let handle = self.emit(Expression::Load { pointer });
        let raw = Value { handle, kind, vector };
        if kind != Kind::F16 {
            return raw;
        }
        let value = self.convert(raw, Kind::F32);
        self.halves.insert(value.handle, raw);
        value
    }

    /// Sets an element of memory; floats become halves where it holds those.
    pub fn store(&mut self, memory: Memory, index: Value, value: Value) {
        debug_assert_eq!(memory.vector, value.vector);
        let value = self.stored_as(memory, value);
        let pointer = self.at(memory, index);
        self.push(Statement::Store { pointer, value: value.handle });
    }

    /// Sets one lane of memory.
    pub fn store_lane(&mut self, memory: Memory, lane: Value, value: Value) {
        debug_assert!(!value.vector);
        let value = self.stored_as(memory, value);
        let pointer = self.at_lane(memory, lane);
        self.push(Statement::Store { pointer, value: value.handle });
    }

    fn stored_as(&mut self, memory: Memory, value: Value) -> Value {
        let value = if memory.kind == Kind::F16 { self.half(value) } else { value };
        debug_assert_eq!(memory.kind, value.kind);
        value
    }

    /// A float as a half: the one that it was converted from, if it was.
    pub fn half(&mut self, value: Value) -> Value {
        match self.halves.get(&value.handle) {
            _ if value.kind == Kind::F16 => value,
            Some(raw) => *raw,
            None => self.convert(value, Kind::F16),
        }
    }

    // Cooperative matrices.

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

    // Values.

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

    // Statements.

    fn open(&mut self, frame: Frame) {
        self.frames.push(Scope { id: self.scopes, frame, block: Block::new(), pure: HashMap::new() });
        self.scopes += 1;
    }

    /// The block being written; values built now are visible while [`Builder::is_open`] is true of it.
    pub fn scope(&self) -> u32 {
        self.frames.last().map_or(0, |f| f.id)
    }

    pub fn is_open(&self, scope: u32) -> bool {
        self.frames.iter().any(|f| f.id == scope)
    }

    pub fn open_if(&mut self, condition: Value) {
        self.open(Frame::If(condition.handle));
    }

    pub fn open_else(&mut self) {
        if let Some(Scope { frame: Frame::If(condition), block: accept, .. }) = self.frames.pop() {
            self.open(Frame::Else(condition, accept));
        }
    }

    /// Ends what `open_if` or `open_else` began.
    pub fn close_if(&mut self) {
        let (condition, accept, reject) = match self.frames.pop() {
            Some(Scope { frame: Frame::If(condition), block, .. }) => (condition, block, Block::new()),
            Some(Scope { frame: Frame::Else(condition, accept), block, .. }) => (condition, accept, block),
            _ => unreachable!("close_if without open_if"),
        };
        self.push(Statement::If { condition, accept, reject });
    }

    /// A loop of `counter` from `from` while below `to`; returns the counter.
    pub fn open_loop(&mut self, counter: &str, from: Value, to: Value, step: u32) -> Value {
        let var = self.var(counter, from);
        self.open(Frame::Loop { counter: var, step });
        let at = self.get(var);
        self.name(at, &format!("{counter}_now"));
        let inside = self.less(at, to);
        let mut leave = Block::new();
        leave.push(Statement::Break, Span::UNDEFINED);
        self.push(Statement::If { condition: inside.handle, accept: Block::new(), reject: leave });
        at
    }

    pub fn close_loop(&mut self) {
        let Some(Scope { frame: Frame::Loop { counter, step }, block: body, .. }) = self.frames.pop() else {
            unreachable!("close_loop without open_loop")
        };
        self.open(Frame::Body);
        let at = self.get(counter);
        let step = self.u(step);
        let next = self.add(at, step);
        self.set(counter, next);
        let continuing = self.frames.pop().map(|f| f.block).unwrap_or_default();
        self.push(Statement::Loop { body, continuing, break_if: None });
    }

    /// Waits for the workgroup and makes its writes to workgroup memory visible.
    pub fn barrier(&mut self) {
        self.push(Statement::ControlBarrier(naga::Barrier::WORK_GROUP));
    }

    /// The same, and for storage buffers, too.
    pub fn barrier_of_storage(&mut self) {
        self.push(Statement::ControlBarrier(naga::Barrier::WORK_GROUP | naga::Barrier::STORAGE));
    }

    /// Ends a loop.
    pub fn break_if(&mut self, condition: Value) {
        let mut leave = Block::new();
        leave.push(Statement::Break, Span::UNDEFINED);
        self.push(Statement::If { condition: condition.handle, accept: leave, reject: Block::new() });
    }

    pub fn leave(&mut self) {
        self.push(Statement::Return { value: None });
    }

    // Names.

    /// What the values built from now on are about: the stem of names of those that need one.
    pub fn topic(&mut self, name: &str) {
        let clean = identifier(name);
        if self.topics.last() != Some(&clean) {
            self.topics.push(clean);
        }
    }

    pub fn name(&mut self, v: Value, name: &str) {
        if !self.is_free(v.handle) && !self.pointers[v.handle.index()] {
            self.names.entry(v.handle).or_insert_with(|| identifier(name));
        }
    }

    // Expressions.

    fn is_free(&self, h: Handle<Expression>) -> bool {
        self.function.expressions[h].needs_pre_emit()
    }

    fn append(&mut self, e: Expression) -> Handle<Expression> {
        self.topic_of.push(self.topics.len() as u32 - 1);
        self.pointers.push(false);
        self.function.expressions.append(e, Span::UNDEFINED)
    }

    /// An expression that is in scope everywhere and never emitted.
    fn free(&mut self, e: Expression) -> Handle<Expression> {
        self.append(e)
    }

    fn emit(&mut self, e: Expression) -> Handle<Expression> {
        let handle = self.append(e);
        self.push(Statement::Emit(Range::new_from_bounds(handle, handle)));
        handle
    }

    fn pure(&mut self, key: Pure, e: Expression, kind: Kind, vector: bool) -> Value {
        if let Some(known) = self.frames.iter().rev().find_map(|f| f.pure.get(&key)) {
            return *known;
        }
        let value = Value { handle: self.emit(e), kind, vector };
        if let Some(frame) = self.frames.last_mut() {
            frame.pure.insert(key, value);
        }
        value
    }

    fn push(&mut self, statement: Statement) {
        if let Some(scope) = self.frames.last_mut() {
            scope.block.push(statement, Span::UNDEFINED);
        }
    }

    /// The finished module, with one entry point `main`.
    pub fn finish(mut self) -> Module {
        debug_assert_eq!(self.frames.len(), 1, "an if or a loop is still open");
        if let Some(body) = self.frames.pop() {
            self.function.body = merge_emits(body.block);
        }
        super::naming::name_values(&mut self.function, self.names, &self.pointers, &self.topics, &self.topic_of);
        self.module.entry_points.push(naga::EntryPoint {
            name: "main".into(),
            stage: naga::ShaderStage::Compute,
            early_depth_test: None,
            workgroup_size: [self.workgroup_size, 1, 1],
            workgroup_size_overrides: None,
            function: self.function,
            mesh_info: None,
            task_payload: None,
            incoming_ray_payload: None,
        });
        self.module
    }
}

fn cooperative_size(side: u32) -> naga::CooperativeSize {
    if side == 8 { naga::CooperativeSize::Eight } else { naga::CooperativeSize::Sixteen }
}

fn fixed(size: u32) -> ArraySize {
    ArraySize::Constant(std::num::NonZeroU32::new(size).unwrap_or(std::num::NonZeroU32::MIN))
}

/// Letters, digits and underscores only, not ending in a digit alone where naga would append an underscore.
fn identifier(name: &str) -> String {
    let mut clean: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' }).collect();
    while clean.contains("__") {
        clean = clean.replace("__", "_");
    }
    let clean = clean.trim_matches('_');
    if clean.is_empty() || clean.starts_with(|c: char| c.is_ascii_digit()) {
        format!("v_{clean}")
    } else {
        clean.into()
    }
}

/// Joins neighbouring emits of consecutive expressions into one.
fn merge_emits(block: Block) -> Block {
    let mut merged: Vec<Statement> = vec![];
    for (statement, _) in block.span_into_iter() {
        let statement = match statement {
            Statement::If { condition, accept, reject } => {
                Statement::If { condition, accept: merge_emits(accept), reject: merge_emits(reject) }
            }
            Statement::Loop { body, continuing, break_if } => {
                Statement::Loop { body: merge_emits(body), continuing: merge_emits(continuing), break_if }
            }
            other => other,
        };
        if let (Statement::Emit(new), Some(Statement::Emit(last))) = (&statement, merged.last_mut())
            && let (Some((first, end)), Some((begin, before))) = (new.first_and_last(), last.first_and_last())
            && before.index() + 1 == first.index()
        {
            *last = Range::new_from_bounds(begin, end);
            continue;
        }
        merged.push(statement);
    }
    Block::from_vec(merged)
}
