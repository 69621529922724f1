//! Every primitive against `f64` or integer references, on every instruction set.
use super::*;
use raygrad_compiler::scalar::Prim;

fn run(isa: Isa, prim: Prim, operands: [Operand; 3], len: usize) -> Vec<f32> {
    let mut out = vec![0.0; len];
    // SAFETY: `isa` is available; the tests pass operands of at least `len` lanes.
    unsafe { apply(isa, prim, out.as_mut_ptr(), &operands.into(), len) };
    out
}

fn lanes(values: &[f32]) -> Operand {
    Operand::Lanes(values.as_ptr())
}

fn unary(isa: Isa, prim: Prim, x: &[f32]) -> Vec<f32> {
    run(isa, prim, [lanes(x), Operand::Splat(0), Operand::Splat(0)], x.len())
}

fn binary(isa: Isa, prim: Prim, a: &[f32], b: &[f32]) -> Vec<f32> {
    run(isa, prim, [lanes(a), lanes(b), Operand::Splat(0)], a.len())
}

/// `n` evenly spaced values from `low` to `high`.
fn linear(low: f64, high: f64, n: usize) -> Vec<f32> {
    (0..n).map(|i| (low + (high - low) * i as f64 / (n - 1) as f64) as f32).collect()
}

/// Every `step`-th positive float, and the negative ones if `signed`; no NaN.
fn all_floats(step: usize, signed: bool) -> Vec<f32> {
    let positive = (0..=f32::INFINITY.to_bits()).step_by(step).map(f32::from_bits);
    let negative = positive.clone().map(|x| -x).filter(|_| signed);
    positive.chain(negative).collect()
}

/// Distance from the true value in units of the last place of a float of that size.
fn ulp_error(got: f32, expected: f64) -> f64 {
    let rounded = expected as f32;
    if got.to_bits() == rounded.to_bits() || (got.is_nan() && rounded.is_nan()) {
        return 0.0;
    }
    if !got.is_finite() || !rounded.is_finite() {
        // The largest float and infinity are neighbours.
        let clamp = |x: f64| x.clamp(-f32::MAX as f64 * 1.000_000_06, f32::MAX as f64 * 1.000_000_06);
        return (clamp(got as f64) - clamp(expected)).abs() / 2f64.powi(127 - 23);
    }
    let exponent = expected.abs().max(f32::MIN_POSITIVE as f64).log2().floor() as i32;
    (got as f64 - expected).abs() / 2f64.powi(exponent - 23)
}

/// Largest error of a unary primitive on `x`, which must not exceed `bound` ulp.
fn check(prim: Prim, x: &[f32], reference: impl Fn(f64) -> f64, bound: f64) {
    for isa in Isa::available() {
        let y = unary(isa, prim, x);
        // Multiply-adds that round twice cost up to half an ulp more.
        let bound = if isa == Isa::Portable { bound + 0.5 } else { bound };
        for (&x, &y) in x.iter().zip(&y) {
            let error = ulp_error(y, reference(x as f64));
            assert!(error <= bound, "{isa} {prim:?}({x:e}) = {y:e}: {error} ulp, not {:e}", reference(x as f64));
        }
    }
}

fn check_absolute(prim: Prim, x: &[f32], reference: impl Fn(f64) -> f64, bound: f64) {
    for isa in Isa::available() {
        for (&x, &y) in x.iter().zip(&unary(isa, prim, x)) {
            let error = (y as f64 - reference(x as f64)).abs();
            assert!(error <= bound, "{isa} {prim:?}({x:e}) = {y:e}: error {error:e}");
        }
    }
}

/// Results that every instruction set must return bit for bit, except that NaN matches any NaN.
fn expect(prim: Prim, operands: &[&[f32]], expected: &[f32]) {
    let operand = |i: usize| operands.get(i).map_or(Operand::Splat(0), |v| lanes(v));
    for isa in Isa::available() {
        let got = run(isa, prim, [operand(0), operand(1), operand(2)], expected.len());
        for (i, (g, e)) in got.iter().zip(expected).enumerate() {
            let same = g.to_bits() == e.to_bits() || (g.is_nan() && e.is_nan());
            assert!(same, "{isa} {prim:?} lane {i}: {g:?} ({:#x}), not {e:?} ({:#x})", g.to_bits(), e.to_bits());
        }
    }
}

const INF: f32 = f32::INFINITY;
const NAN: f32 = f32::NAN;

#[test]
fn exp_is_accurate_over_the_whole_range() {
    check(Prim::Exp, &linear(-105.0, 90.0, 400_001), f64::exp, 2.0);
    check(Prim::Exp, &all_floats(4099, true), f64::exp, 2.0);
    expect(Prim::Exp, &[&[0.0, -INF, INF, NAN, -1e9, 1e9, 89.0]], &[1.0, 0.0, INF, NAN, 0.0, INF, INF]);
}

#[test]
fn log_is_accurate_over_the_whole_range() {
    check(Prim::Log, &all_floats(4099, false), f64::ln, 2.0);
    check(Prim::Log, &linear(0.5, 2.0, 400_001), f64::ln, 2.0);
    expect(Prim::Log, &[&[1.0, 0.0, -0.0, -1.0, -INF, INF, NAN]], &[0.0, -INF, -INF, NAN, NAN, INF, NAN]);
}

#[test]
fn sine_and_cosine_are_accurate() {
    for (prim, reference) in [(Prim::Sin, f64::sin as fn(f64) -> f64), (Prim::Cos, f64::cos)] {
        check_absolute(prim, &linear(-1e4, 1e4, 400_001), reference, 2e-7);
        check_absolute(prim, &linear(-7.0, 7.0, 400_001), reference, 1.3e-7);
        expect(prim, &[&[INF, -INF, NAN]], &[NAN, NAN, NAN]);
        for isa in Isa::available() {
            assert!(unary(isa, prim, &all_floats(99_991, true)).iter().all(|y| y.is_nan() || y.abs() < 1.000_001));
        }
    }
    check(Prim::Sin, &linear(-1.5, 1.5, 400_001), f64::sin, 2.0);
    check(Prim::Sin, &all_floats(4099, true).into_iter().filter(|x| x.abs() < 1.5).collect::<Vec<_>>(), f64::sin, 2.0);
    check(Prim::Cos, &linear(-1.5, 1.5, 400_001), f64::cos, 2.0);
}

#[test]
fn tanh_is_accurate_in_relative_terms() {
    check(Prim::Tanh, &linear(-10.0, 10.0, 400_001), f64::tanh, 2.0);
    check(Prim::Tanh, &all_floats(4099, true), f64::tanh, 2.0);
    expect(Prim::Tanh, &[&[0.0, -0.0, INF, -INF, NAN]], &[0.0, -0.0, 1.0, -1.0, NAN]);
}

#[test]
fn atan2_covers_all_quadrants() {
    let mut points = vec![];
    for i in 0..100_000 {
        let (angle, radius) = (i as f64 * 1e-3 - 50.0, 10f64.powi(i % 61 - 30));
        points.push(((radius * angle.sin()) as f32, (radius * angle.cos()) as f32));
    }
    for i in 0..2000 {
        // Steep and shallow points.
        let ratio = 2f64.powf(i as f64 * 0.01 - 10.0) as f32;
        points.extend([(ratio, 1.0), (ratio, -1.0), (-ratio, 1.0), (-ratio, -1.0)]);
    }
    let (y, x): (Vec<f32>, Vec<f32>) = points.into_iter().unzip();
    for isa in Isa::available() {
        for ((&y, &x), &got) in y.iter().zip(&x).zip(&binary(isa, Prim::Atan2, &y, &x)) {
            let error = ulp_error(got, (y as f64).atan2(x as f64));
            assert!(error <= 2.5, "{isa} atan2({y:e}, {x:e}) = {got:e}: {error} ulp");
        }
    }
    use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI};
    let y = [0.0, 1.0, -1.0, 0.0, INF, 1.0, NAN, 1.0, 0.0, 1e-45, INF, NAN];
    let x = [0.0, 0.0, 0.0, -1.0, INF, -INF, 1.0, NAN, 1.0, 0.0, 1.0, INF];
    let expected = [0.0, FRAC_PI_2, -FRAC_PI_2, PI, FRAC_PI_4, PI, NAN, NAN, 0.0, FRAC_PI_2, FRAC_PI_2, NAN];
    expect(Prim::Atan2, &[&y, &x], &expected);
}

#[test]
fn exact_unary_primitives() {
    let x = [0.0, -0.0, 1.5, -1.5, 0.9999, -0.0001, 8_388_609.0, -8_388_607.5, 1e20, -1e20, INF, -INF, NAN, 3e9];
    expect(Prim::Neg, &[&x], &x.map(|v| -v));
    expect(Prim::Abs, &[&x], &x.map(f32::abs));
    expect(Prim::Floor, &[&x], &x.map(f32::floor));
    expect(Prim::Sqrt, &[&x], &x.map(f32::sqrt));
    let all = all_floats(10_007, true);
    expect(Prim::Sqrt, &[&all], &all.iter().map(|v| v.sqrt()).collect::<Vec<_>>());
    expect(Prim::Floor, &[&all], &all.iter().map(|v| v.floor()).collect::<Vec<_>>());
}

#[test]
fn conversions_round_and_saturate() {
    let x =
        [0.0, -0.0, 0.99, -0.99, -5.0, 2_147_483_648.0, 4_294_967_040.0, 4_294_967_296.0, 1e20, INF, -INF, NAN, 77.7];
    let bits = |v: u32| f32::from_bits(v);
    expect(Prim::ToU32, &[&x], &x.map(|v| bits(v as u32)));
    let all = all_floats(10_007, true);
    expect(Prim::ToU32, &[&all], &all.iter().map(|&v| bits(v as u32)).collect::<Vec<_>>());
    let u: Vec<u32> =
        (0..=u32::MAX).step_by(65_521).chain([0x0100_0001, 0xffff_ffff, 0x8000_0080, 0x8000_0180]).collect();
    let lanes: Vec<f32> = u.iter().map(|&v| bits(v)).collect();
    expect(Prim::ToF32, &[&lanes], &u.iter().map(|&v| v as f32).collect::<Vec<_>>());
}

/// A binary primitive and its reference.
type Case<T, U> = (Prim, fn(T, T) -> U);

/// Values whose pairs cover equality, order, signed zeros, infinities and NaN.
const SPECIAL: [f32; 12] = [0.0, -0.0, 1.0, -1.0, 2.5, -2.5, 1e30, 1e-40, INF, -INF, NAN, 3.0];

/// All pairs of `values`.
fn pairs<T: Copy>(values: &[T]) -> (Vec<T>, Vec<T>) {
    values.iter().flat_map(|&a| values.iter().map(move |&b| (a, b))).unzip()
}

#[test]
fn float_binary_primitives() {
    let (a, b) = pairs(&SPECIAL);
    let truth = |v: bool| f32::from_bits(v as u32);
    let table: [Case<f32, f32>; 6] = [
        (Prim::Add, |a, b| a + b),
        (Prim::Sub, |a, b| a - b),
        (Prim::Mul, |a, b| a * b),
        (Prim::Div, |a, b| a / b),
        (Prim::Min, |a, b| if a < b { a } else { b }),
        (Prim::Max, |a, b| if a > b { a } else { b }),
    ];
    for (prim, f) in table {
        expect(prim, &[&a, &b], &a.iter().zip(&b).map(|(&a, &b)| f(a, b)).collect::<Vec<_>>());
    }
    let table: [Case<f32, bool>; 3] = [(Prim::Lt, |a, b| a < b), (Prim::Le, |a, b| a <= b), (Prim::Eq, |a, b| a == b)];
    for (prim, f) in table {
        expect(prim, &[&a, &b], &a.iter().zip(&b).map(|(&a, &b)| truth(f(a, b))).collect::<Vec<_>>());
    }
}

#[test]
fn integer_primitives() {
    let values =
        [0u32, 1, 2, 31, 32, 33, 77, 0x7fff_ffff, 0x8000_0000, 0x8000_0001, 0xffff_ffff, 0x1234_5678, 0x9e37_79b9];
    let (a, b) = pairs(&values);
    let lanes = |v: &[u32]| v.iter().map(|&v| f32::from_bits(v)).collect::<Vec<_>>();
    let table: [Case<u32, u32>; 9] = [
        (Prim::UAdd, u32::wrapping_add),
        (Prim::UMul, u32::wrapping_mul),
        (Prim::UAnd, |a, b| a & b),
        (Prim::UOr, |a, b| a | b),
        (Prim::UXor, |a, b| a ^ b),
        (Prim::UShl, |a, b| a << (b % 32)),
        (Prim::UShr, |a, b| a >> (b % 32)),
        (Prim::ULt, |a, b| (a < b) as u32),
        (Prim::UEq, |a, b| (a == b) as u32),
    ];
    for (prim, f) in table {
        let expected: Vec<u32> = a.iter().zip(&b).map(|(&a, &b)| f(a, b)).collect();
        let (a, b) = (lanes(&a), lanes(&b));
        for isa in Isa::available() {
            let got: Vec<u32> = binary(isa, prim, &a, &b).into_iter().map(f32::to_bits).collect();
            assert_eq!(got, expected, "{isa} {prim:?}");
        }
    }
}

#[test]
fn select_takes_any_nonzero_condition() {
    let c: Vec<f32> = [0, 1, 2, 0x8000_0000, 0, u32::MAX, 0, 5].map(f32::from_bits).to_vec();
    let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
    let b = a.map(|v| -v);
    expect(Prim::Select, &[&c, &a, &b], &[-1.0, 2.0, 3.0, 4.0, -5.0, 6.0, -7.0, 8.0]);
}

/// Every primitive with every combination of operand kinds, length remainders and aliasing gives what plain runs give.
#[test]
fn operand_kinds_lengths_and_aliasing_agree() {
    use Prim::*;
    let prims = [
        Neg, Abs, Floor, Exp, Log, Sqrt, Sin, Cos, Tanh, Add, Sub, Mul, Div, Min, Max, Atan2, Lt, Le, Eq, Select, UAdd,
        UMul, UAnd, UOr, UXor, UShl, UShr, ULt, UEq, ToF32, ToU32,
    ];
    let splats = [1.25f32, 0.75, -3.5];
    for isa in Isa::available() {
        for prim in prims {
            for kinds in 0..1 << prim.arity() {
                for len in [1, 2, 7, 8, 9, 15, 16, 17, 33, 100] {
                    let is_run = |i: usize| kinds >> i & 1 == 0;
                    let runs: [Vec<f32>; 3] = std::array::from_fn(|i| {
                        let value =
                            |j: usize| if is_run(i) { (j * 7 % 13) as f32 - 6.0 + i as f32 * 0.5 } else { splats[i] };
                        (0..len).map(value).collect()
                    });
                    let reference = run(isa, prim, std::array::from_fn(|i| lanes(&runs[i])), len);
                    let operands: [Operand; 3] =
                        std::array::from_fn(|i| if is_run(i) { lanes(&runs[i]) } else { Operand::splat(splats[i]) });
                    let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                    let mut out = vec![99.0; len + 20];
                    // SAFETY: all runs have `len` lanes, `out` more.
                    unsafe { apply(isa, prim, out.as_mut_ptr(), &operands.into(), len) };
                    assert_eq!(bits(&out[..len]), bits(&reference), "{isa} {prim:?} kinds {kinds} len {len}");
                    assert!(out[len..].iter().all(|&v| v == 99.0), "{isa} {prim:?} writes beyond {len} lanes");
                    if is_run(0) {
                        let mut aliased = runs[0].clone();
                        let mut operands = operands;
                        operands[0] = Operand::Lanes(aliased.as_mut_ptr());
                        // SAFETY: as above; `out` is exactly the first operand.
                        unsafe { apply(isa, prim, aliased.as_mut_ptr(), &operands.into(), len) };
                        assert_eq!(bits(&aliased), bits(&reference), "{isa} {prim:?} in place");
                    }
                }
            }
        }
    }
}

#[test]
fn fused_functions_are_bitwise_equal_across_instruction_sets() {
    let x = all_floats(40_009, true);
    for prim in [Prim::Exp, Prim::Log, Prim::Sin, Prim::Cos, Prim::Tanh] {
        let mut first: Option<Vec<f32>> = None;
        for isa in Isa::available().into_iter().filter(|&isa| isa != Isa::Portable) {
            let y = unary(isa, prim, &x);
            let first = first.get_or_insert(y.clone());
            for (i, (a, b)) in first.iter().zip(&y).enumerate() {
                assert!(a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()), "{prim:?}({:e}): {a:e} {b:e}", x[i]);
            }
        }
    }
}
