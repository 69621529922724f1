//! Variables and arrays: storage buffers, workgroup memory, memory of an invocation.

use super::{Builder, Kind, Memory, Value, Var};
use naga::{
    AddressSpace, ArraySize, Expression, GlobalVariable, Handle, LocalVariable, ResourceBinding, Span, Statement,
    StorageAccess, Type, TypeInner,
};

impl Builder {
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

    pub(super) fn at(&mut self, memory: Memory, index: Value) -> Handle<Expression> {
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
}

fn fixed(size: u32) -> ArraySize {
    ArraySize::Constant(std::num::NonZeroU32::new(size).unwrap_or(std::num::NonZeroU32::MIN))
}
