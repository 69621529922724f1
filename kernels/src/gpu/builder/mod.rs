//! A small typed builder of naga IR: one compute entry point, written statement by statement.
//!
//! naga's rules are kept here so that the lowering need not know them: what is emitted and in which block, that values
//! of an inner block end with it, that loop-carried values are local variables, and that long expressions need names
//! (parsers of the printed WGSL recurse). Equal pure expressions are built once a block, and index arithmetic on
//! constants is folded.

mod blocks;
mod matrices;
mod memory;
mod values;

use super::half::Storage;
use naga::{
    BinaryOperator, Block, Expression, Function, Handle, MathFunction, Module, Range, Scalar, Span, Statement, Type,
    TypeInner, UnaryOperator, VectorSize,
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

    fn ty(&mut self, kind: Kind, vector: bool) -> Handle<Type> {
        let scalar = kind.scalar();
        let inner =
            if vector { TypeInner::Vector { size: VectorSize::Quad, scalar } } else { TypeInner::Scalar(scalar) };
        let types = &mut self.module.types;
        *self.types.entry((kind, vector)).or_insert_with(|| types.insert(Type { name: None, inner }, Span::UNDEFINED))
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
            self.function.body = blocks::merge_emits(body.block);
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
