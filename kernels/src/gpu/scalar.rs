//! Scalar programs as naga expressions, on scalars or on vectors of four.
//!
//! Where a device's function is only loosely specified, it is built from others: Vulkan promises 2^-11 for `sin`, and nothing
//! outside `[-pi, pi]`, 4096 ulp for `atan2`, and no digits for `tanh` near 0. The polynomials are those of the CPU kernels.

use super::builder::{Builder, Kind, Value};
use crate::cpu::math::{ATAN, SIN, TANH};
use naga::{BinaryOperator as Op, MathFunction as Math, UnaryOperator};
use raygrad_compiler::scalar::{Prim, ScalarProgram, Val};
use std::f32::consts;

/// Emits `program` on `inputs`; the result has the type `kind`.
pub(super) fn emit(b: &mut Builder, program: &ScalarProgram, inputs: &[Value], kind: Kind) -> Value {
    let kinds = kinds(program, inputs, kind);
    let mut values: Vec<Value> = Vec::with_capacity(program.code.len());
    for (at, (prim, args)) in program.code.iter().enumerate() {
        let wanted = operand_kinds(*prim, kinds[at]);
        let args: Vec<Value> = args
            .iter()
            .zip(wanted)
            .map(|(arg, want)| match arg {
                Val::Input(i) => inputs[*i as usize],
                Val::Inst(i) => values[*i as usize],
                Val::Const(bits) => b.literal(if want == Kind::Bool { Kind::U32 } else { want }, *bits),
            })
            .collect();
        let value = primitive(b, *prim, &args);
        values.push(value);
    }
    match values.last() {
        Some(last) if kind == Kind::U32 => integer(b, *last),
        Some(last) => *last,
        None => inputs[0],
    }
}

/// Result types. Only a `Select` between constants does not tell; then its user does.
fn kinds(program: &ScalarProgram, inputs: &[Value], last: Kind) -> Vec<Kind> {
    let mut kinds: Vec<Option<Kind>> = vec![];
    for (prim, args) in &program.code {
        let known = match prim {
            Prim::Select => args[1..].iter().find_map(|a| match a {
                Val::Input(i) => Some(inputs[*i as usize].kind),
                Val::Inst(i) => kinds[*i as usize],
                Val::Const(_) => None,
            }),
            other => Some(other.result(raygrad_compiler::scalar::DType::F32).into()),
        };
        kinds.push(known);
    }
    for at in (0..kinds.len()).rev() {
        let own = *kinds[at].get_or_insert(last);
        let (prim, args) = &program.code[at];
        for (arg, want) in args.iter().zip(operand_kinds(*prim, own)) {
            if let Val::Inst(i) = arg {
                kinds[*i as usize].get_or_insert(if want == Kind::Bool { Kind::U32 } else { want });
            }
        }
    }
    kinds.into_iter().map(|k| k.unwrap_or(last)).collect()
}

/// Types of the operands; `Bool` is a truth value as a bool or an integer.
fn operand_kinds(prim: Prim, result: Kind) -> [Kind; 3] {
    use Prim::*;
    match prim {
        UAdd | UMul | UAnd | UOr | UXor | UShl | UShr | ULt | UEq | ToF32 => [Kind::U32; 3],
        Select => [Kind::Bool, result, result],
        _ => [Kind::F32; 3],
    }
}

/// A truth value as 0 or 1.
fn integer(b: &mut Builder, v: Value) -> Value {
    if v.kind != Kind::Bool {
        return v;
    }
    let (one, zero) = (b.u(1), b.u(0));
    b.select(v, one, zero)
}

fn truth(b: &mut Builder, v: Value) -> Value {
    if v.kind == Kind::Bool {
        return v;
    }
    let zero = b.u(0);
    b.binary(Op::NotEqual, v, zero)
}

fn primitive(b: &mut Builder, prim: Prim, args: &[Value]) -> Value {
    use Prim::*;
    let whole = matches!(operand_kinds(prim, Kind::F32)[0], Kind::U32);
    let args: Vec<Value> = args.iter().map(|a| if whole { integer(b, *a) } else { *a }).collect();
    let two = |b: &mut Builder, op| b.binary(op, args[0], args[1]);
    match prim {
        Neg => b.unary(UnaryOperator::Negate, args[0]),
        Abs => b.math(Math::Abs, &args),
        Floor => b.math(Math::Floor, &args),
        Exp => b.math(Math::Exp, &args),
        Log => b.math(Math::Log, &args),
        Sqrt => b.math(Math::Sqrt, &args),
        Sin => sine(b, args[0], 0.0),
        Cos => sine(b, args[0], 0.5),
        Tanh => tanh(b, args[0]),
        Add | UAdd => two(b, Op::Add),
        Sub => two(b, Op::Subtract),
        Mul | UMul => two(b, Op::Multiply),
        Div => two(b, Op::Divide),
        Min => {
            let below = two(b, Op::Less);
            b.select(below, args[0], args[1])
        }
        Max => {
            let above = two(b, Op::Greater);
            b.select(above, args[0], args[1])
        }
        Atan2 => atan2(b, args[0], args[1]),
        Lt | ULt => two(b, Op::Less),
        Le => two(b, Op::LessEqual),
        Eq | UEq => two(b, Op::Equal),
        Select => {
            let condition = truth(b, args[0]);
            let (accept, reject) = (integer(b, args[1]), integer(b, args[2]));
            b.select(condition, accept, reject)
        }
        UAnd => two(b, Op::And),
        UOr => two(b, Op::InclusiveOr),
        UXor => two(b, Op::ExclusiveOr),
        UShl | UShr => {
            let mask = b.u(31);
            let amount = b.and(args[1], mask);
            b.binary(if prim == UShl { Op::ShiftLeft } else { Op::ShiftRight }, args[0], amount)
        }
        ToF32 => b.convert(args[0], Kind::F32),
        ToU32 => to_u32(b, args[0]),
    }
}

/// `sin(x + shift pi)`, shift 0 or 1/2, as the CPU kernels compute it: hardware's own sines are off by a millionth, and more.
///
/// `x = q pi + r` with `q = n - shift` of a whole `n`, so that the result is `(-1)^n sin(r)`.
fn sine(b: &mut Builder, x: Value, shift: f32) -> Value {
    let (per_half_turn, shift) = (b.f(consts::FRAC_1_PI), b.f(shift));
    let half_turns = b.fma(x, per_half_turn, shift);
    let n = b.math(Math::Round, &[half_turns]);
    let q = b.sub(n, shift);
    // Pi in three parts, so that large angles keep their digits.
    let (high, middle, low) = (b.f(-3.140_625), b.f(-9.675_026e-4), b.f(-1.509_958e-7));
    let rest = b.fma(q, high, x);
    let rest = b.fma(q, middle, rest);
    let rest = b.fma(q, low, rest);
    // Huge arguments have no significant digits left; the result stays bounded nevertheless. NaN passes.
    let (least, most) = (b.f(-1.6), b.f(1.6));
    let rest = lower(b, most, rest);
    let rest = higher(b, least, rest);
    let square = b.mul(rest, rest);
    let series = polynomial(b, square, &SIN);
    let series = b.mul(series, square);
    let result = b.fma(series, rest, rest);
    let half = b.f(0.5);
    let pairs = b.mul(n, half);
    let below = b.math(Math::Floor, &[pairs]);
    let odd = b.less(below, pairs);
    let minus = b.unary(UnaryOperator::Negate, result);
    b.select(odd, minus, result)
}

/// The larger of two values; NaN if either is.
pub(super) fn larger(b: &mut Builder, x: Value, y: Value) -> Value {
    let above = b.binary(Op::GreaterEqual, x, y);
    let larger = b.select(above, x, y);
    let number = b.binary(Op::Equal, x, x);
    b.select(number, larger, x)
}

/// The lower of a number and a value; NaN if the value is, where `Math::Min` may give the number.
fn lower(b: &mut Builder, number: Value, x: Value) -> Value {
    let past = b.less(number, x);
    b.select(past, number, x)
}

/// The higher of the two, likewise.
fn higher(b: &mut Builder, number: Value, x: Value) -> Value {
    let past = b.less(x, number);
    b.select(past, number, x)
}

/// The non-negative `magnitude` with the sign of `x`.
fn with_sign(b: &mut Builder, magnitude: Value, x: Value) -> Value {
    let (bits, sign) = (b.bitcast(x, Kind::U32), b.u(1 << 31));
    let sign = b.and(bits, sign);
    let bits = b.bitcast(magnitude, Kind::U32);
    let bits = b.binary(Op::InclusiveOr, bits, sign);
    b.bitcast(bits, Kind::F32)
}

fn polynomial(b: &mut Builder, x: Value, coefficients: &[f32]) -> Value {
    let mut sum = b.f(coefficients[coefficients.len() - 1]);
    for c in coefficients.iter().rev().skip(1) {
        let c = b.f(*c);
        sum = b.fma(sum, x, c);
    }
    sum
}

/// A polynomial near 0, else `1 - 2 / (exp(2 |x|) + 1)` with the sign of x.
fn tanh(b: &mut Builder, x: Value) -> Value {
    let (one, two, ten, near) = (b.f(1.0), b.f(2.0), b.f(10.0), b.f(0.625));
    let size = b.math(Math::Abs, &[x]);
    let size = lower(b, ten, size);
    let square = b.mul(size, size);
    let series = polynomial(b, square, &TANH);
    let series = b.mul(series, square);
    let inner = b.fma(series, size, size);
    let twice = b.mul(two, size);
    let grown = b.math(Math::Exp, &[twice]);
    let below = b.add(grown, one);
    let part = b.div(two, below);
    let outer = b.sub(one, part);
    let is_near = b.less(size, near);
    let result = b.select(is_near, inner, outer);
    with_sign(b, result, x)
}

/// The angle of the point `(x, y)`, 0 for the origin.
fn atan2(b: &mut Builder, y: Value, x: Value) -> Value {
    let (zero, tiny, largest) = (b.f(0.0), b.f(f32::MIN_POSITIVE), b.f(f32::MAX));
    let (ax, ay) = (b.math(Math::Abs, &[x]), b.math(Math::Abs, &[y]));
    // Infinities become finite, so that their quotient is 1.
    let (ax, ay) = (lower(b, largest, ax), lower(b, largest, ay));
    let steep = b.less(ax, ay);
    let smaller = b.select(steep, ax, ay);
    let larger = b.select(steep, ay, ax);
    let larger = higher(b, tiny, larger);
    // Vulkan promises nothing of quotients by more than 2^126.
    let (bound, down, as_it_is) = (b.f(1e30), b.f(1e-9), b.f(1.0));
    let huge = b.less(bound, larger);
    let scale = b.select(huge, down, as_it_is);
    let (smaller, larger) = (b.mul(smaller, scale), b.mul(larger, scale));
    let t = b.div(smaller, larger);
    let square = b.mul(t, t);
    let series = polynomial(b, square, &ATAN);
    let series = b.mul(series, square);
    let r = b.fma(series, t, t);
    let quarter = b.f(consts::FRAC_PI_2);
    let turned = b.sub(quarter, r);
    let r = b.select(steep, turned, r);
    let half = b.f(consts::PI);
    let opposite = b.sub(half, r);
    let left = b.less(x, zero);
    let r = b.select(left, opposite, r);
    with_sign(b, r, y)
}

/// Truncates towards zero and saturates; NaN gives 0.
fn to_u32(b: &mut Builder, x: Value) -> Value {
    let (zero, past, largest) = (b.f(0.0), b.f(4_294_967_296.0), b.f(4_294_967_040.0));
    let positive = b.less(zero, x);
    let x = b.select(positive, x, zero);
    let fits = b.less(x, past);
    let inside = b.select(fits, x, largest);
    let whole = b.convert(inside, Kind::U32);
    let full = b.u(u32::MAX);
    b.select(fits, whole, full)
}
