//! Runs a plan in f64, launch by launch: whether fusion and planning are right on a target that no device here has.
//!
//! A launch is evaluated value by value over its whole domain, so what only a kernel could get wrong is not seen. Buffers
//! that a launch reads and replaces are checked by rule: each position may only read what it replaces itself.

use raygrad_compiler::Program;
use raygrad_compiler::graph::{Axes, Axis, Shape};
use raygrad_compiler::ops::Reduction;
use raygrad_compiler::ops::sym_eig::jacobi;
use raygrad_compiler::plan::BufferKind;
use raygrad_compiler::plan::region::{Grain, Inst, Region, RegionOp, Store};
use raygrad_compiler::reference::{Array, Bindings, Lane};
use raygrad_compiler::scalar::{DType, Prim, ScalarProgram, Val};
use std::collections::BTreeSet;

/// Values of every buffer after one run, by [`BufferId`]; inputs are taken from `bindings`, or zero.
pub fn run(program: &Program, bindings: &Bindings) -> Result<Vec<Array>, String> {
    let start = |b: &raygrad_compiler::plan::Buffer| match &b.kind {
        BufferKind::Input { name, .. } => bindings.get(name).cloned().unwrap_or_else(|| Array::zeros(&b.shape)),
        _ => unwritten(&b.shape),
    };
    let mut buffers: Vec<Array> = program.buffers.iter().map(start).collect();
    for launch in &program.launches {
        replaced(&launch.region).map_err(|e| format!("{}: {e}", launch.name))?;
        let values = body(program, &launch.region, &buffers);
        for store in &launch.region.stores {
            let old = &buffers[store.buffer().0 as usize];
            buffers[store.buffer().0 as usize] = stored(store, &launch.region, &values, old);
        }
        overwritten(program, &launch.region, &mut buffers);
    }
    Ok(buffers)
}

/// Contents that no correct plan reads.
fn unwritten(shape: &Shape) -> Array {
    Array::from_fn(shape, |_, _| if shape.dtype == DType::F32 { Lane::F(f64::NAN) } else { Lane::U(0xDEAD_BEEF) })
}

/// Temporaries that share the slot of what was just written lose their contents.
fn overwritten(program: &Program, region: &Region, buffers: &mut [Array]) {
    let slot = |b: usize| match program.buffers[b].kind {
        BufferKind::Temporary { slot } => Some(slot),
        _ => None,
    };
    for written in region.stores.iter().map(|s| s.buffer().0 as usize) {
        for (other, array) in buffers.iter_mut().enumerate() {
            if other != written && slot(written).is_some() && slot(other) == slot(written) {
                *array = unwritten(&program.buffers[other].shape);
            }
        }
    }
}

/// Whether no channel of anything computed from instruction `at` needs another channel of it.
fn stays_in_its_channel(region: &Region, at: usize) -> bool {
    let width = region.body[at].channels;
    let mut reached = BTreeSet::from([at]);
    for (i, inst) in region.body.iter().enumerate().skip(at + 1) {
        if inst.inputs.iter().any(|input| reached.contains(&(input.0 as usize))) {
            if !matches!(inst.op, RegionOp::Map(_)) || inst.channels != width {
                return false;
            }
            reached.insert(i);
        }
    }
    true
}

/// Refuses a launch that replaces a buffer of which one position reads what another one writes.
fn replaced(region: &Region) -> Result<(), String> {
    for (at, inst) in region.body.iter().enumerate() {
        let read = match &inst.op {
            RegionOp::Load(b) | RegionOp::Take { table: b, .. } => *b,
            RegionOp::Linear(w) => w.buffer,
            _ => continue,
        };
        let Some(store) = region.stores.iter().find(|s| s.buffer() == read) else { continue };
        let own = matches!(store, Store::Write { .. })
            && matches!(inst.op, RegionOp::Load(_))
            && inst.axes == region.domain
            && (region.grain != Grain::Lane || stays_in_its_channel(region, at));
        if !own {
            return Err(format!("instruction {at} reads b{} while it is replaced", read.0));
        }
    }
    Ok(())
}

fn body(program: &Program, region: &Region, buffers: &[Array]) -> Vec<Array> {
    let mut values: Vec<Array> = vec![];
    for inst in &region.body {
        let shape = Shape::of(inst.axes.clone(), inst.channels, inst.dtype);
        let inputs: Vec<&Array> = inst.inputs.iter().map(|i| &values[i.0 as usize]).collect();
        values.push(value(program, region, inst, &shape, &inputs, buffers));
    }
    values
}

/// Elements of an axis, and of all axes inside it.
fn stride(axes: &Axes, axis: &Axis) -> usize {
    axes.iter().skip_while(|a| *a != axis).skip(1).map(Axis::size).product()
}

fn value(
    program: &Program,
    region: &Region,
    inst: &Inst,
    shape: &Shape,
    inputs: &[&Array],
    buffers: &[Array],
) -> Array {
    let n = inst.channels;
    let at = |i: usize, e: usize, c: usize| inputs[i].at(inputs[i].element_of(shape, e), c);
    let sum = |terms: &mut dyn Iterator<Item = f64>| Lane::F(terms.sum());
    let matrix =
        |x: &dyn Fn(usize) -> f64, w: &dyn Fn(usize) -> f64, dims: (usize, usize), transposed: bool, o: usize| {
            let contracted = if transposed { dims.1 } else { dims.0 };
            let entry = |k: usize| if transposed { o * dims.1 + k } else { k * dims.1 + o };
            Lane::F((0..contracted).map(|k| x(k) * w(entry(k))).sum())
        };
    match &inst.op {
        RegionOp::Load(b) => {
            let buffer = &buffers[b.0 as usize];
            Array::from_fn(shape, |e, c| buffer.at(buffer.element_of(shape, e), c))
        }
        RegionOp::Const(bits) => Array::from_fn(shape, |_, c| constant(bits[c], inst.dtype)),
        RegionOp::Map(code) => Array::from_fn(shape, |e, c| {
            let args: Vec<Lane> = (0..inputs.len()).map(|i| inputs[i].lane(shape, e, c)).collect();
            scalar(code, &args, inst.dtype)
        }),
        RegionOp::Pick(pick) => Array::from_fn(shape, |e, c| at(pick[c].0 as usize, e, pick[c].1 as usize)),
        RegionOp::ChannelSum(groups) => {
            Array::from_fn(shape, |e, c| sum(&mut groups[c].iter().map(|g| at(0, e, *g as usize).f())))
        }
        RegionOp::ChannelMax => {
            let width = inputs[0].shape.channels.count();
            Array::from_fn(shape, |e, _| Lane::F((0..width).map(|c| at(0, e, c).f()).fold(f64::NEG_INFINITY, f64::max)))
        }
        RegionOp::Linear(w) => {
            let buffer = &buffers[w.buffer.0 as usize];
            Array::from_fn(shape, |e, o| {
                let element = buffer.element_of(shape, e);
                let weight = |i: usize| buffer.at(element, w.first + i).f();
                matrix(&|k| at(0, e, k).f(), &weight, (w.rows, w.columns), w.transposed, o)
            })
        }
        RegionOp::RowLinear { rows, columns, transposed } => Array::from_fn(shape, |e, o| {
            matrix(&|k| at(0, e, k).f(), &|i| at(1, e, i).f(), (*rows, *columns), *transposed, o)
        }),
        RegionOp::RowOuter => {
            let d = inputs[1].shape.channels.count();
            Array::from_fn(shape, |e, c| Lane::F(at(0, e, c / d).f() * at(1, e, c % d).f()))
        }
        RegionOp::CumSum { reverse } => along(region, shape, |e, c, position, step, size| {
            let range = if *reverse { position + 1..size } else { 0..position };
            let start = e - position * step;
            sum(&mut range.map(|p| at(0, start + p * step, c).f()))
        }),
        RegionOp::Shift { by } => along(region, shape, |e, c, position, step, size| {
            let from = position as i64 - by;
            let inside = (0..size as i64).contains(&from);
            if inside { at(0, (e as i64 - by * step as i64) as usize, c) } else { Lane::F(0.0) }
        }),
        RegionOp::RowReduce(kind) => {
            let axis = region.inner.as_ref().expect("a reduction inside tiles has an inner axis");
            let line = shape.clone().with_axes(shape.axes.union(&Axes::new([axis.clone()])));
            let (step, size) = (stride(&line.axes, axis), axis.size());
            Array::from_fn(shape, |e, c| {
                let start = e / step * step * size + e % step;
                let terms = (0..size).map(|p| inputs[0].at(inputs[0].element_of(&line, start + p * step), c).f());
                Lane::F(match kind {
                    Reduction::Sum => terms.sum(),
                    Reduction::Max => terms.fold(f64::NEG_INFINITY, f64::max),
                })
            })
        }
        RegionOp::Index(axis) => {
            let step = stride(&shape.axes, axis);
            Array::from_fn(shape, |e, _| Lane::U((e / step % axis.size()) as u32))
        }
        RegionOp::Take { table, axis } => {
            let (buffer, own) = (&buffers[table.0 as usize], &program.buffer(*table).shape);
            let without = Array::zeros(&own.clone().with_axes(own.axes.without(axis)));
            let (step, size) = (stride(&own.axes, axis), axis.size());
            Array::from_fn(shape, |e, c| {
                let slot = (at(0, e, 0).u() as usize).min(size - 1);
                let rest = without.element_of(shape, e);
                // The axis goes back to its place among the others.
                buffer.at(rest / step * step * size + slot * step + rest % step, c)
            })
        }
        RegionOp::SymEig { n: rows } => {
            let mut all = vec![];
            for e in 0..shape.axes.elements() {
                let matrix: Vec<f64> = (0..rows * rows).map(|c| at(0, e, c).f()).collect();
                let (eigenvalues, vectors) = jacobi(&matrix, *rows);
                all.extend(eigenvalues.into_iter().chain(vectors));
            }
            assert_eq!(all.len(), shape.axes.elements() * n);
            Array::floats(shape, all)
        }
    }
}

/// `f(element, channel, position, stride, size)` along the axis that the region runs along.
fn along(region: &Region, shape: &Shape, f: impl Fn(usize, usize, usize, usize, usize) -> Lane) -> Array {
    let axis = region.inner.as_ref().expect("a scan's region has an inner axis");
    let (step, size) = (stride(&shape.axes, axis), axis.size());
    Array::from_fn(shape, |e, c| f(e, c, e / step % size, step, size))
}

fn constant(bits: u32, dtype: DType) -> Lane {
    if dtype == DType::F32 { Lane::F(f32::from_bits(bits) as f64) } else { Lane::U(bits) }
}

/// A scalar program on one lane, in f64 where the lanes are floats.
fn scalar(code: &ScalarProgram, args: &[Lane], dtype: DType) -> Lane {
    // A constant is a float or an integer by its use.
    #[derive(Clone, Copy)]
    enum Arg {
        Typed(Lane),
        Bits(u32),
    }
    let float = |a: Arg| match a {
        Arg::Typed(lane) => lane.f(),
        Arg::Bits(bits) => f32::from_bits(bits) as f64,
    };
    let integer = |a: Arg| match a {
        Arg::Typed(lane) => lane.u(),
        Arg::Bits(bits) => bits,
    };
    let mut results: Vec<Arg> = vec![];
    for (prim, operands) in &code.code {
        let arg = |i: usize| match operands[i] {
            Val::Input(i) => Arg::Typed(args[i as usize]),
            Val::Const(bits) => Arg::Bits(bits),
            Val::Inst(i) => results[i as usize],
        };
        let (f, u) = (|i: usize| float(arg(i)), |i: usize| integer(arg(i)));
        use Prim::*;
        let result = match prim {
            Neg => Lane::F(-f(0)),
            Abs => Lane::F(f(0).abs()),
            Floor => Lane::F(f(0).floor()),
            Exp => Lane::F(f(0).exp()),
            Log => Lane::F(f(0).ln()),
            Sqrt => Lane::F(f(0).sqrt()),
            Sin => Lane::F(f(0).sin()),
            Cos => Lane::F(f(0).cos()),
            Tanh => Lane::F(f(0).tanh()),
            Add => Lane::F(f(0) + f(1)),
            Sub => Lane::F(f(0) - f(1)),
            Mul => Lane::F(f(0) * f(1)),
            Div => Lane::F(f(0) / f(1)),
            Min => Lane::F(if f(0) < f(1) { f(0) } else { f(1) }),
            Max => Lane::F(if f(0) > f(1) { f(0) } else { f(1) }),
            Atan2 => Lane::F(f(0).atan2(f(1))),
            Lt => Lane::U((f(0) < f(1)) as u32),
            Le => Lane::U((f(0) <= f(1)) as u32),
            Eq => Lane::U((f(0) == f(1)) as u32),
            Select => {
                results.push(if u(0) != 0 { arg(1) } else { arg(2) });
                continue;
            }
            UAdd => Lane::U(u(0).wrapping_add(u(1))),
            UMul => Lane::U(u(0).wrapping_mul(u(1))),
            UAnd => Lane::U(u(0) & u(1)),
            UOr => Lane::U(u(0) | u(1)),
            UXor => Lane::U(u(0) ^ u(1)),
            UShl => Lane::U(u(0).wrapping_shl(u(1))),
            UShr => Lane::U(u(0).wrapping_shr(u(1))),
            ULt => Lane::U((u(0) < u(1)) as u32),
            UEq => Lane::U((u(0) == u(1)) as u32),
            ToF32 => Lane::F(u(0) as f64),
            ToU32 => Lane::U(f(0) as u32),
        };
        results.push(Arg::Typed(result));
    }
    let last = *results.last().expect("a program has instructions");
    if dtype == DType::F32 { Lane::F(float(last)) } else { Lane::U(integer(last)) }
}

/// A buffer after a store.
fn stored(store: &Store, region: &Region, values: &[Array], old: &Array) -> Array {
    let domain = Array::zeros(&Shape::of(region.domain.clone(), 1, DType::F32)).shape;
    let lane = |v: usize, e: usize, c: usize| values[v].at(values[v].element_of(&domain, e), c);
    if let Store::Write { value, .. } = store {
        return Array::from_fn(&old.shape, |e, c| lane(value.0 as usize, e, c));
    }
    let start = match store {
        Store::Reduce { kind: Reduction::Max, .. } => f64::NEG_INFINITY,
        _ => 0.0,
    };
    let n = old.shape.channels.count();
    let mut new = Array::floats(&old.shape, vec![start; old.shape.lanes()]);
    for e in 0..region.domain.elements() {
        let mut at = new.element_of(&domain, e);
        if let Store::Scatter { index, axis, .. } = store {
            let slot = (lane(index.0 as usize, e, 0).u() as usize).min(axis.size() - 1);
            at += slot * stride(&old.shape.axes, axis);
        }
        for c in 0..n {
            let x = match store {
                Store::Outer { x, d, .. } => {
                    let width = values[d.0 as usize].shape.channels.count();
                    lane(x.0 as usize, e, c / width).f() * lane(d.0 as usize, e, c % width).f()
                }
                Store::Reduce { value, .. } | Store::Scatter { value, .. } | Store::Write { value, .. } => {
                    lane(value.0 as usize, e, c).f()
                }
            };
            let to = &mut new.f_mut()[at * n + c];
            *to = if start == 0.0 { *to + x } else { to.max(x) };
        }
    }
    new
}
