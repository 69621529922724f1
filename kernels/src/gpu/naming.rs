//! Names for the values of a kernel: the printed WGSL is a snapshot people review, and unnamed values would print as
//! numbers that all change when one is inserted. Values used more than once, and every so often one of a long chain
//! (parsers recurse), are named after what they are about.

use naga::{Block, Expression, Function, Handle, Statement};
use std::collections::HashMap;

/// Longest chain of nested expressions without a name; Tint refuses 127 levels.
const MAX_DEPTH: u32 = 24;

pub(super) fn name_values(
    function: &mut Function,
    names: HashMap<Handle<Expression>, String>,
    pointers: &[bool],
    topics: &[String],
    topic_of: &[u32],
) {
    let mut uses = vec![0u32; function.expressions.len()];
    let mut depth = vec![0u32; function.expressions.len()];
    for (_, e) in function.expressions.iter() {
        operands(e, |o| uses[o.index()] += 1);
    }
    count_statements(&function.body, &mut uses);
    let mut counters: HashMap<u32, u32> = HashMap::new();
    for (handle, e) in function.expressions.iter() {
        let at = handle.index();
        let mut deepest = 0;
        operands(e, |o| deepest = deepest.max(depth[o.index()]));
        depth[at] = deepest + 1;
        if e.needs_pre_emit() || pointers[at] {
            continue;
        }
        if let Some(name) = names.get(&handle) {
            function.named_expressions.insert(handle, name.clone());
            depth[at] = 0;
        } else if uses[at] > 1 || depth[at] > MAX_DEPTH || matches!(e, Expression::Load { .. }) && uses[at] > 0 {
            let counter = counters.entry(topic_of[at]).or_default();
            let name = format!("{}_{}", topics[topic_of[at] as usize], letters(*counter));
            *counter += 1;
            function.named_expressions.insert(handle, name);
            depth[at] = 0;
        }
    }
}

/// `a`, `b`, .., `z`, `aa`, ..
fn letters(mut n: u32) -> String {
    let mut text = vec![];
    loop {
        text.push(b'a' + (n % 26) as u8);
        if n < 26 {
            break;
        }
        n = n / 26 - 1;
    }
    text.iter().rev().map(|b| *b as char).collect()
}

fn operands(e: &Expression, mut f: impl FnMut(Handle<Expression>)) {
    match e {
        Expression::Compose { components, .. } => components.iter().for_each(|c| f(*c)),
        Expression::Access { base, index } => [*base, *index].into_iter().for_each(f),
        Expression::AccessIndex { base, .. } => f(*base),
        Expression::Splat { value, .. } => f(*value),
        Expression::Load { pointer } => f(*pointer),
        Expression::Unary { expr, .. } | Expression::As { expr, .. } => f(*expr),
        Expression::Binary { left, right, .. } => [*left, *right].into_iter().for_each(f),
        Expression::Select { condition, accept, reject } => [*condition, *accept, *reject].into_iter().for_each(f),
        Expression::Math { arg, arg1, arg2, arg3, .. } => {
            [Some(*arg), *arg1, *arg2, *arg3].into_iter().flatten().for_each(f)
        }
        _ => {}
    }
}

fn count_statements(block: &Block, uses: &mut [u32]) {
    for statement in block.iter() {
        match statement {
            Statement::If { condition, accept, reject } => {
                uses[condition.index()] += 1;
                count_statements(accept, uses);
                count_statements(reject, uses);
            }
            Statement::Loop { body, continuing, .. } => {
                count_statements(body, uses);
                count_statements(continuing, uses);
            }
            Statement::Store { pointer, value } => {
                uses[pointer.index()] += 1;
                uses[value.index()] += 1;
            }
            _ => {}
        }
    }
}
