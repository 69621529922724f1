//! What must hold of any step: the same values simplified and recorded, planned for every target, on every device and in
//! the f64 reference, for any number of threads, and in the step after.

use crate::backend::{load, round};
use crate::{Rng, worst};
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::graph::{Tensor, topological};
use raygrad_compiler::plan::{Buffer, BufferKind};
use raygrad_compiler::reference::{Array, Bindings, Data, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::simplify::simplify;
use raygrad_compiler::{Step, Target, compile};
use raygrad_runtime::Device;
use std::collections::HashMap;

/// A named result: an output, or an input after its update.
pub type Results = Vec<(String, Vec<f64>)>;

/// How far results may be off.
#[derive(Clone, Copy)]
struct Allowed {
    /// Relative to the largest value of a tensor ...
    relative: f64,
    /// ... or this many times what rounding every value of the graph changes, where a result is a small difference; in the worst of
    /// [`DRAWS`].
    noise: f64,
    /// The numbers that a value is rounded to.
    neighbours: fn(f64) -> [f64; 2],
}

const DRAWS: u64 = 4;
const SIMPLIFIED: Allowed = Allowed { relative: 1e-9, noise: 60.0, neighbours: double };
const PLANNED: Allowed = Allowed { relative: 1e-5, noise: 60.0, neighbours: single };
const SINGLE: Allowed = Allowed { relative: 1e-4, noise: 60.0, neighbours: single };
/// Of devices that round what they multiply in layers, CPUs and GPUs.
const PAIRS: Allowed = Allowed { relative: 3e-2, noise: 8.0, neighbours: bf16 };
const HALVES: Allowed = Allowed { relative: 1e-2, noise: 8.0, neighbours: f16 };

/// Every result of a step in the f64 reference.
pub fn expected(step: &Step, bindings: &Bindings) -> Results {
    let values = evaluate(&step.roots(), bindings).unwrap_or_else(|e| panic!("{e}"));
    name(step, values)
}

/// The same with every node's value rounded to one of its two neighbours, at random: rounding to the nearest keeps symmetries,
/// and with them exact cancellations, which another order of operations does not keep.
fn rounded(step: &Step, bindings: &Bindings, neighbours: fn(f64) -> [f64; 2], seed: u64) -> Results {
    let roots = step.roots();
    let mut rng = Rng(seed);
    let mut neighbour = |x: f64| neighbours(x)[usize::from(rng.chance(0.5))];
    let mut values: HashMap<u64, Array> = HashMap::new();
    for t in topological(roots.iter().cloned()) {
        let mut value = match t.input_name() {
            Some(name) => bindings[name].clone(),
            None => t.op().eval(&t.inputs().iter().map(|i| &values[&i.id()]).collect::<Vec<_>>(), t.shape()),
        };
        if let Data::F(lanes) = &mut value.data {
            lanes.iter_mut().for_each(|x| *x = neighbour(*x));
        }
        values.insert(t.id(), value);
    }
    name(step, roots.iter().map(|r| values[&r.id()].clone()).collect())
}

/// The values of single precision around one of double precision.
fn single(x: f64) -> [f64; 2] {
    let nearest = x as f32;
    let other = match nearest as f64 {
        same if same == x => nearest,
        above if above > x => nearest.next_down(),
        _ => nearest.next_up(),
    };
    [other, nearest].map(f64::from)
}

/// The values of bfloat16 around one of double precision.
fn bf16(x: f64) -> [f64; 2] {
    of_bits(x, 7, -126)
}

/// Those of f16, of which the smallest is 2^-24.
fn f16(x: f64) -> [f64; 2] {
    of_bits(x, 10, -14)
}

/// Those with so many bits after the first, and this least exponent.
fn of_bits(x: f64, bits: i32, least: i32) -> [f64; 2] {
    let exponent = x.abs().max(f64::MIN_POSITIVE).log2().floor() as i32;
    let step = 2f64.powi(exponent.max(least) - bits);
    let below = (x / step).floor() * step;
    [below, if below == x { x } else { below + step }]
}

/// What rounding in double precision may make of a value.
fn double(x: f64) -> [f64; 2] {
    [x, x.next_up()]
}

fn name(step: &Step, values: Vec<Array>) -> Results {
    let (outputs, updates) = values.split_at(step.outputs.len());
    let outputs = step.outputs.iter().zip(outputs).map(|((name, t), v)| (name.clone(), lanes(v, t)));
    let updates = step.updates.iter().zip(updates).map(|((input, _), v)| (after(input), lanes(v, input)));
    outputs.chain(updates).collect()
}

fn after(input: &Tensor) -> String {
    format!("`{}` afterwards", input.input_name().unwrap_or_default())
}

/// The lanes of `value` seen with the axes of `like`.
fn lanes(value: &Array, like: &Tensor) -> Vec<f64> {
    let flat = match &value.data {
        Data::F(v) => v.clone(),
        Data::U(v) => v.iter().map(|u| *u as f64).collect(),
    };
    if value.shape.axes == *like.axes() {
        return flat;
    }
    let n = like.width();
    let element = |e: usize| value.element_of(like.shape(), e);
    (0..like.axes().elements()).flat_map(|e| flat[element(e) * n..][..n].to_vec()).collect()
}

/// A step on a device: the results of two runs, the second from where the first ended, and the inputs in between.
pub fn found(device: &Device, step: &Step, bindings: &Bindings) -> [(Bindings, Results); 2] {
    let (mut session, id) = load(device, step, bindings);
    let mut now = bindings.clone();
    let mut run = || {
        let before = now.clone();
        session.run(id).unwrap_or_else(|e| panic!("{e}"));
        let mut results = vec![];
        for (name, t) in &step.outputs {
            let lanes = session.read_lanes(id, name).unwrap_or_else(|e| panic!("{e}"));
            results.push((name.clone(), values(t, &lanes)));
        }
        for (input, _) in &step.updates {
            let name = input.input_name().unwrap_or_default();
            let lanes = session.get_lanes(name).unwrap_or_else(|e| panic!("{e}"));
            results.push((after(input), values(input, &lanes)));
            let array = match input.dtype() {
                DType::F32 => Array::floats(input.shape(), values(input, &lanes)),
                DType::U32 => Array::integers(input.shape(), lanes),
            };
            now.insert(name.into(), array);
        }
        (before, results)
    };
    [run(), run()]
}

fn values(t: &Tensor, lanes: &[u32]) -> Vec<f64> {
    let value = |bits: &u32| if t.dtype() == DType::F32 { f32::from_bits(*bits) as f64 } else { *bits as f64 };
    lanes.iter().map(value).collect()
}

/// Results of the plan for `target`, run in f64.
fn planned(step: &Step, bindings: &Bindings, target: &Target) -> Result<Results, String> {
    let program = compile(step, target).map_err(|e| e.to_string())?;
    let buffers = crate::plan::run(&program, bindings).map_err(|e| format!("{e}\n{program}"))?;
    let input = |t: &Tensor| {
        let named = |b: &Buffer| matches!(&b.kind, BufferKind::Input { name, .. } if Some(&**name) == t.input_name());
        program.buffers.iter().position(named).expect("an updated input has a buffer")
    };
    let outputs = program.outputs.iter().map(|(_, b)| buffers[b.0 as usize].clone());
    let values = outputs.chain(step.updates.iter().map(|(t, _)| buffers[input(t)].clone())).collect();
    Ok(name(step, values))
}

/// All properties of one step.
pub fn check(devices: &[Device], step: &Step, bindings: &Bindings) -> Result<(), String> {
    let bindings = round(bindings);
    let reference = expected(step, &bindings);
    let agrees = |what: &str, allowed, found: &Results| agree(what, step, &bindings, &reference, found, allowed);
    agrees("the simplified graph", SIMPLIFIED, &expected(&simplify(step), &bindings))?;
    for target in [Target::cpu(), Target::gpu(), Target { resident: 128, ..Target::gpu() }] {
        agrees(&format!("the plan for {:?}", target.kind), PLANNED, &planned(step, &bindings, &target)?)?;
    }
    devices.iter().try_for_each(|device| two_runs(device, step, &bindings, SINGLE))
}

/// That a device of mixed precision gives the values of a step, but for its rounding.
pub fn check_mixed(device: &Device, step: &Step, bindings: &Bindings) -> Result<(), String> {
    let allowed = if device.target().kind == TargetKind::Cpu { PAIRS } else { HALVES };
    two_runs(device, step, &round(bindings), allowed)
}

/// Compares two runs of a step on a device with the reference.
fn two_runs(device: &Device, step: &Step, bindings: &Bindings, allowed: Allowed) -> Result<(), String> {
    for (at, (before, results)) in found(device, step, bindings).iter().enumerate() {
        let what = format!("{:?}, run {}", device.target().kind, at + 1);
        agree(&what, step, before, &expected(step, before), results, allowed).map_err(|e| {
            let program = compile(step, &device.target()).map_or_else(|e| e.to_string(), |p| p.to_string());
            format!("{e}\n{program}")
        })?;
    }
    Ok(())
}

/// The same bits for two numbers of threads.
pub fn same_bits(a: &Device, b: &Device, step: &Step, bindings: &Bindings) -> Result<(), String> {
    let bindings = round(bindings);
    for ((_, a), (_, b)) in found(a, step, &bindings).iter().zip(&found(b, step, &bindings)) {
        for ((name, a), (_, b)) in a.iter().zip(b) {
            let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            if bits(a) != bits(b) {
                return Err(format!("{name} differs with the number of threads"));
            }
        }
    }
    Ok(())
}

/// Compares results by name. What rounding makes of them is computed only where they differ.
fn agree(
    what: &str,
    step: &Step,
    bindings: &Bindings,
    expected: &Results,
    found: &Results,
    allowed: Allowed,
) -> Result<(), String> {
    for (at, ((name, expected), (_, found))) in expected.iter().zip(found).enumerate() {
        let error = worst(found, expected, 1e-30);
        if error <= allowed.relative {
            continue;
        }
        let noise = |seed| worst(&rounded(step, bindings, allowed.neighbours, seed)[at].1, expected, 1e-30);
        let rounding = (1..=DRAWS).map(noise).fold(0.0, f64::max);
        if error <= allowed.noise * rounding {
            continue;
        }
        let far = |i: &usize| {
            let scale = expected.iter().fold(1e-30f64, |m, x| m.max(x.abs()));
            ((found[*i] - expected[*i]).abs() / scale).partial_cmp(&allowed.relative) != Some(std::cmp::Ordering::Less)
        };
        let lanes: Vec<usize> = (0..expected.len()).filter(far).collect();
        let first: Vec<_> = lanes.iter().take(6).map(|i| (*i, found[*i], expected[*i])).collect();
        return Err(format!(
            "{what}: {name} is off by {error:.2e} (rounding: {rounding:.2e}) in {} of {} lanes; lane, found, expected: \
             {first:?}",
            lanes.len(),
            expected.len()
        ));
    }
    Ok(())
}
