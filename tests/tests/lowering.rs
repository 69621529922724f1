//! Scalar programs of pointwise ops, run in f32, against the f64 reference.

use raygrad_compiler::graph::{Tensor, topological};
use raygrad_compiler::ops::{Form, registry};
use raygrad_compiler::reference::{Array, Lane, evaluate};
use raygrad_compiler::scalar::{DType, Prim, ScalarProgram, Val};
use raygrad_tests::MidGraph;

fn primitive(prim: Prim, a: &[u32]) -> u32 {
    use Prim::*;
    let f = |i: usize| f32::from_bits(a[i]);
    let bits = |x: f32| x.to_bits();
    match prim {
        Neg => bits(-f(0)),
        Abs => bits(f(0).abs()),
        Floor => bits(f(0).floor()),
        Exp => bits(f(0).exp()),
        Log => bits(f(0).ln()),
        Sqrt => bits(f(0).sqrt()),
        Sin => bits(f(0).sin()),
        Cos => bits(f(0).cos()),
        Tanh => bits(f(0).tanh()),
        Add => bits(f(0) + f(1)),
        Sub => bits(f(0) - f(1)),
        Mul => bits(f(0) * f(1)),
        Div => bits(f(0) / f(1)),
        Min => bits(if f(0) < f(1) { f(0) } else { f(1) }),
        Max => bits(if f(0) > f(1) { f(0) } else { f(1) }),
        Atan2 => bits(f(0).atan2(f(1))),
        Lt => (f(0) < f(1)) as u32,
        Le => (f(0) <= f(1)) as u32,
        Eq => (f(0) == f(1)) as u32,
        Select => {
            if a[0] != 0 {
                a[1]
            } else {
                a[2]
            }
        }
        UAdd => a[0].wrapping_add(a[1]),
        UMul => a[0].wrapping_mul(a[1]),
        UAnd => a[0] & a[1],
        UOr => a[0] | a[1],
        UXor => a[0] ^ a[1],
        UShl => a[0].wrapping_shl(a[1]),
        UShr => a[0].wrapping_shr(a[1]),
        ULt => (a[0] < a[1]) as u32,
        UEq => (a[0] == a[1]) as u32,
        ToF32 => bits(a[0] as f32),
        ToU32 => f(0) as u32,
    }
}

fn run(program: &ScalarProgram, inputs: &[u32]) -> u32 {
    let mut results: Vec<u32> = vec![];
    for (prim, args) in &program.code {
        assert_eq!(args.len(), prim.arity(), "{prim:?}");
        let lanes: Vec<u32> = args
            .iter()
            .map(|v| match v {
                Val::Input(i) => inputs[*i as usize],
                Val::Const(bits) => *bits,
                Val::Inst(i) => results[*i as usize],
            })
            .collect();
        results.push(primitive(*prim, &lanes));
    }
    *results.last().expect("a program has instructions")
}

fn bits(lane: Lane) -> u32 {
    match lane {
        Lane::F(x) => (x as f32).to_bits(),
        Lane::U(u) => u,
    }
}

/// Runs one recorded op on the reference values of its operands.
fn check(name: &str, t: &Tensor, program: &ScalarProgram, operands: &[Array], value: &Array) {
    for element in 0..t.axes().elements() {
        for channel in 0..t.width() {
            let inputs: Vec<u32> = operands.iter().map(|a| bits(a.lane(t.shape(), element, channel))).collect();
            let (found, expected) = (run(program, &inputs), value.at(element, channel));
            match (t.dtype(), expected) {
                (DType::U32, Lane::U(u)) => assert_eq!(found, u, "{name}: {t:?}"),
                (DType::F32, Lane::F(x)) => {
                    let error = (f32::from_bits(found) as f64 - x).abs() / x.abs().max(1e-3);
                    assert!(error < 2e-6, "{name}: {t:?} gives {}, not {x}", f32::from_bits(found));
                }
                _ => panic!("{name}: {t:?} has lanes of another type"),
            }
        }
    }
}

#[test]
fn scalar_programs_agree_with_the_reference() {
    let mut seen = std::collections::BTreeSet::new();
    for sample in registry() {
        let graph = MidGraph::new(&sample);
        for t in topological([graph.output.clone()]) {
            let Form::Pointwise(program) = t.op().form() else { continue };
            seen.insert(t.op().name());
            let mut roots = t.inputs().to_vec();
            roots.push(t.clone());
            let mut values = evaluate(&roots, &graph.bindings).expect("evaluates");
            let value = values.pop().expect("there is a root");
            // Comparisons of rounded operands may differ; the reference is given the rounded ones.
            let rounded: Vec<Array> = values.iter().map(round).collect();
            let value =
                if rounded == values { value } else { t.op().eval(&rounded.iter().collect::<Vec<_>>(), t.shape()) };
            check(&sample.name, &t, &program, &rounded, &value);
        }
    }
    assert!(seen.len() >= 34, "only {seen:?}");
}

/// Every float rounded to f32.
fn round(a: &Array) -> Array {
    Array::from_fn(&a.shape, |e, c| match a.at(e, c) {
        Lane::F(x) => Lane::F(x as f32 as f64),
        Lane::U(u) => Lane::U(u),
    })
}
