//! What a device does at best: chains of multiply-adds and of products of matrices in registers, and a copy.

use super::builder::{Builder, Factor, Kind, MatrixAt, Value};
use super::half::{Half, Matrices, Storage};
use super::layout::{Arena, ArenaId};
use super::memory::validated;
use super::{Access, Binding, GpuLaunch, GpuProgram, Kernel, LowerError};
use naga::BuiltIn;

const INVOCATIONS: u32 = 256;
/// Products of a chain; as long as a device needs that hides the start.
const LENGTH: u32 = 512;
/// Chains of a subgroup: 2 left factors by 4 right ones.
const LEFT: u32 = 2;
const RIGHT: u32 = 4;
/// Workgroups that fill a GPU several times, and for drivers that compute on a CPU, whose matrices are small.
const WORKGROUPS: u32 = 2048;
const WORKGROUPS_OF_SMALL: u32 = 4;

/// A program that multiplies matrices, and how many operations it does.
pub fn matrix_products(sizes: Matrices) -> Result<(GpuProgram, f64), LowerError> {
    let Matrices { side, subgroup } = sizes;
    let workgroups = if side < 16 { WORKGROUPS_OF_SMALL } else { WORKGROUPS };
    let mut b = Builder::new(INVOCATIONS);
    let group = b.built_in("workgroup", BuiltIn::WorkGroupId);
    let workgroup = b.component(group, 0);
    let invocation = b.built_in("invocation", BuiltIn::LocalInvocationIndex);
    let own = b.built_in("subgroup", BuiltIn::SubgroupId);
    let out = b.storage("done", Kind::F32, false);
    b.make_writable(out);
    // Factors of small numbers that nobody knows when compiling.
    let lanes = side * side;
    let factors = b.workgroup("factors", Kind::F16, false, (LEFT + RIGHT) * lanes);
    let (from, to) = (invocation, b.u((LEFT + RIGHT) * lanes));
    let at = b.open_loop("lane", from, to, INVOCATIONS);
    let seven = b.u(7);
    let digit = b.rem(at, seven);
    let value = b.convert(digit, Kind::F32);
    let small = b.f(1e-3);
    let value = b.mul(value, small);
    b.store(factors, at, value);
    b.close_loop();
    b.barrier();
    let load = |b: &mut Builder, factor: Factor, number: u32| {
        let first = b.u(number * lanes);
        b.matrix(factor, side, MatrixAt { memory: factors, first, line: side, row_major: true })
    };
    let left: Vec<_> = (0..LEFT).map(|i| load(&mut b, Factor::Left, i)).collect();
    let right: Vec<_> = (0..RIGHT).map(|i| load(&mut b, Factor::Right, LEFT + i)).collect();
    let chains: Vec<_> = (0..LEFT * RIGHT).map(|_| b.matrix_sum("sum", side)).collect();
    let (none, length) = (b.u(0), b.u(LENGTH));
    b.open_loop("product", none, length, 1);
    for (i, left) in left.iter().enumerate() {
        for (j, right) in right.iter().enumerate() {
            b.matrix_multiply_add(*left, *right, chains[i * RIGHT as usize + j]);
        }
    }
    b.close_loop();
    // Every chain is looked at.
    let memory = b.workgroup("block", Kind::F32, false, INVOCATIONS / subgroup * lanes);
    let size = b.u(lanes);
    let first = b.mul(own, size);
    let zero = b.f(0.0);
    let total = b.var("total", zero);
    for chain in chains {
        b.barrier();
        b.matrix_store(chain, MatrixAt { memory, first, line: side, row_major: true });
        b.barrier();
        let (so_far, next) = (b.get(total), b.load(memory, first));
        let next = b.add(so_far, next);
        b.set(total, next);
    }
    let count = b.u(INVOCATIONS);
    let at = b.mul(workgroup, count);
    let at = b.add(at, invocation);
    let value = b.get(total);
    b.store(out, at, value);
    let half = Some(Half { matrices: Some(sizes) });
    let program = program(b, half, workgroups, &[("done", u64::from(workgroups * INVOCATIONS))])?;
    let subgroups = f64::from(workgroups * INVOCATIONS / subgroup);
    let operations = 2.0 * f64::from(side).powi(3) * f64::from(LEFT * RIGHT * LENGTH) * subgroups;
    Ok((program, operations))
}

/// Workgroups of the kernel of multiply-adds: all that a large device holds at once.
const WORKGROUPS_OF_FLOATS: u32 = 1024;
/// Vectors that an invocation goes through side by side.
const VECTORS: u32 = 8;

/// A program of multiply-adds in registers, and how many operations it does, two each; by one workgroup, or as many as fill any
/// device.
pub fn multiply_adds(alone: bool) -> Result<(GpuProgram, f64), LowerError> {
    let workgroups = if alone { 1 } else { WORKGROUPS_OF_FLOATS };
    let mut b = Builder::new(INVOCATIONS);
    let at = number(&mut b);
    let out = b.storage("done", Kind::F32, false);
    b.make_writable(out);
    // Factors that nobody knows when compiling: the buffer's zeros.
    let (factor, zero, half) = (b.load(out, at), b.u(0), b.f(0.5));
    let factor = b.add(factor, half);
    let start = b.convert(at, Kind::F32);
    let start = b.splat(start);
    let (factor, addend) = (b.splat(factor), b.splat(half));
    let vars: Vec<_> = (0..VECTORS).map(|_| b.var("x", start)).collect();
    let length = b.u(LENGTH);
    b.open_loop("round", zero, length, 4);
    for var in (0..4).flat_map(|_| &vars) {
        let x = b.get(*var);
        let x = b.fma(x, factor, addend);
        b.set(*var, x);
    }
    b.close_loop();
    let mut sum = addend;
    for var in vars {
        let x = b.get(var);
        sum = b.add(sum, x);
    }
    let lanes = [0, 1, 2, 3].map(|i| b.component(sum, i));
    let total = lanes[1..].iter().fold(lanes[0], |sum, lane| b.add(sum, *lane));
    // All terms are positive, which nobody knows when compiling either.
    let none = b.f(0.0);
    let nothing = b.math(naga::MathFunction::Min, &[total, none]);
    b.store(out, at, nothing);
    let invocations = u64::from(workgroups * INVOCATIONS);
    let operations = (2 * 4 * VECTORS * LENGTH) as f64 * invocations as f64;
    Ok((program(b, None, workgroups, &[("done", invocations)])?, operations))
}

/// Lanes of a buffer that passes through memory: more than caches hold, with its copy.
const LANES: u64 = 16 << 20;

/// A program that copies a buffer, and how many bytes it reads and writes.
pub fn copy() -> Result<(GpuProgram, f64), LowerError> {
    let mut b = Builder::new(INVOCATIONS);
    let at = number(&mut b);
    let (to, from) = (b.storage("to", Kind::F32, true), b.storage("from", Kind::F32, true));
    b.make_writable(to);
    let value = b.load(from, at);
    b.store(to, at, value);
    let workgroups = (LANES / 4) as u32 / INVOCATIONS;
    Ok((program(b, None, workgroups, &[("to", LANES), ("from", LANES)])?, 8.0 * LANES as f64))
}

/// A program of so many launches that wait for each other and do next to nothing.
pub fn launches(count: usize) -> Result<GpuProgram, LowerError> {
    let mut b = Builder::new(INVOCATIONS);
    let at = number(&mut b);
    let out = b.storage("done", Kind::F32, false);
    b.make_writable(out);
    let (value, one) = (b.load(out, at), b.f(1.0));
    let value = b.add(value, one);
    b.store(out, at, value);
    let mut all = program(b, None, 1, &[("done", u64::from(INVOCATIONS))])?;
    all.launches = vec![all.launches[0].clone(); count];
    Ok(all)
}

/// The number of an invocation.
fn number(b: &mut Builder) -> Value {
    let group = b.built_in("workgroup", BuiltIn::WorkGroupId);
    let invocation = b.built_in("invocation", BuiltIn::LocalInvocationIndex);
    let (workgroup, size) = (b.component(group, 0), b.u(INVOCATIONS));
    let first = b.mul(workgroup, size);
    b.add(first, invocation)
}

/// A program of one kernel that binds buffers of so many lanes, the first of them writable.
fn program(b: Builder, half: Option<Half>, workgroups: u32, buffers: &[(&str, u64)]) -> Result<GpuProgram, LowerError> {
    let (module, info) = validated(b.finish(), half, "peak")?;
    let bindings = (0..buffers.len()).map(|i| Binding { arena: ArenaId::Own(i), writable: i == 0 }).collect();
    let workgroup_size = INVOCATIONS;
    let access = |i: usize, lanes| Access { arena: ArenaId::Own(i), lanes: 0..lanes, write: i == 0 };
    let accesses = buffers.iter().enumerate().map(|(i, b)| access(i, b.1)).collect();
    let kernel = Kernel {
        name: "peak".into(),
        module,
        info,
        bindings,
        accesses,
        workgroups: [workgroups, 1, 1],
        workgroup_size,
    };
    let arena = |(name, lanes): &(&str, u64)| Arena { name: name.to_string(), storage: Storage::F32, lanes: *lanes };
    Ok(GpuProgram {
        launches: vec![GpuLaunch { name: "peak".into(), kernels: vec![kernel] }],
        arenas: buffers.iter().map(arena).collect(),
        places: vec![],
    })
}
