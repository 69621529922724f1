//! Sums of many numbers on the CPU keep the digits of single precision, and their bits on any number of threads.

use raygrad_compiler::graph::{Axis, Shape, Tensor};
use raygrad_compiler::{Step, Target, compile};
use raygrad_runtime::{Device, Session};

/// Equal numbers: each addition to their sum is rounded the same way.
const EACH: f32 = 0.1;

/// `record` of a tensor of equal numbers, run on so many threads.
fn run(x: &Tensor, y: &Tensor, threads: usize) -> Vec<f32> {
    let step = Step { outputs: vec![("y".into(), y.clone())], updates: vec![] };
    let mut session = Session::new(Device::cpu(Some(threads)).unwrap()).unwrap();
    let program = session.add(compile(&step, &Target::cpu()).unwrap()).unwrap();
    session.set("x", &vec![EACH; x.shape().lanes()]).unwrap();
    session.run(program).unwrap();
    session.read(program, "y").unwrap()
}

/// Whether `y`, of numbers [`EACH`], is `expected(i)` at element i, the same with several threads.
fn check(what: &str, x: &Tensor, y: &Tensor, expected: impl Fn(usize) -> f64) {
    let found = run(x, y, 1);
    assert!(found == run(x, y, 3), "{what}: other bits on three threads");
    for (i, y) in found.iter().enumerate() {
        let expected = f64::from(EACH) * expected(i);
        let error = (f64::from(*y) - expected).abs() / expected.max(1.0);
        assert!(error < 1e-5, "{what}: element {i} is {y}, expected {expected}");
    }
}

#[test]
fn of_all_rows() {
    let row = Axis::new("row", 3_000_000);
    let x = Tensor::data("x", Shape::new(&[&row], 1));
    check("sum", &x, &x.sum(&[&row]), |_| 3e6);
}

/// Several lines of a few columns are a tile.
#[test]
fn of_rows_by_column() {
    let (row, column) = (Axis::new("row", 400_000), Axis::new("column", 4));
    let x = Tensor::data("x", Shape::new(&[&row, &column], 1));
    check("sum", &x, &x.sum(&[&row]), |_| 4e5);
}

/// A column of every tile.
#[test]
fn of_rows_by_many_columns() {
    let (row, column) = (Axis::new("row", 20_000), Axis::new("column", 100));
    let x = Tensor::data("x", Shape::new(&[&row, &column], 1));
    check("sum", &x, &x.sum(&[&row]), |_| 2e4);
}

/// So many lines that each goes straight to its buffer.
#[test]
fn of_long_lines() {
    let (line, row) = (Axis::new("line", 40), Axis::new("row", 200_000));
    let x = Tensor::data("x", Shape::new(&[&line, &row], 1));
    check("sum", &x, &x.sum(&[&row]), |_| 2e5);
}

#[test]
fn of_lines_that_are_a_tile() {
    let row = Axis::new("row", 1_000_000);
    let x = Tensor::data("x", Shape::new(&[&row], 1));
    check("cumsum", &x, &x.cumsum(&row), |i| i as f64);
    check("reverse", &x, &x.reverse_cumsum(&row), |i| (999_999 - i) as f64);
    check("neighbours", &x, &(&x + x.shift(&row, 1)).sum(&[&row]), |_| 2e6 - 1.0);
    check("total", &x, &x.cumsum(&row).sum(&[&row]), |_| 1e6 * 999_999.0 / 2.0);
}
