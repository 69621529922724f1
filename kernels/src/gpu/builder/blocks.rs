//! Statements that hold others: branches and loops; barriers.

use super::{Builder, Frame, Scope, Value};
use naga::{Block, Range, Span, Statement};
use std::collections::HashMap;

impl Builder {
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
}

/// Joins neighbouring emits of consecutive expressions into one.
pub(super) fn merge_emits(block: Block) -> Block {
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
