//! Eigen-decomposition of a symmetric matrix, `A = V diag(lambda) V^T`.
//!
//! Result: the `n` eigenvalues in ascending order, then the `(n, n)` matrix V row by row, eigenvectors in its columns,
//! each with its component of largest magnitude positive. Only the symmetric part of A counts. Evaluated by cyclic Jacobi
//! rotations (Golub, Van Loan, Matrix Computations, 8.5).
//!
//! Gradient (Giles, Collected matrix derivative results for forward and reverse mode algorithmic differentiation, 2008,
//! 3.1): `dA = V (diag(d lambda) + F o (V^T dV)) V^T`, symmetrised, with `F_ij = 1 / (lambda_j - lambda_i)`, and 0 between
//! equal eigenvalues, where the eigenvectors are no function of A.

use super::pick::concat;
use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::functions::matrix::matmul;
use crate::graph::{Axis, Channels, Misfit, Shape, Tensor};
use crate::reference::Array;
use crate::scalar::DType;

#[derive(Clone, Debug)]
pub struct SymEig {
    pub n: usize,
}

/// Eigenvalues closer than this part of the largest one count as equal.
const EQUAL: f64 = 1e-13;

impl Op for SymEig {
    fn name(&self) -> &'static str {
        "sym_eig"
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        expect_dtype(&inputs[0], DType::F32, 0)?;
        match inputs[0].channels {
            Channels::Matrix(r, c) if r == c && r == self.n && r <= 9 => {
                Ok(inputs[0].clone().with_channels(Channels::Vector(self.n + self.n * self.n)))
            }
            other => {
                let hint = match other {
                    Channels::Matrix(..) => "",
                    Channels::Vector(_) => "reshape the channels to (n, n)",
                };
                Err(Misfit::new(format!("channels {other} are not a square matrix of at most 9 rows"), hint))
            }
        }
    }
    fn form(&self) -> Form {
        Form::SymEig { n: self.n }
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        let n = self.n;
        let mut result = Vec::with_capacity(out.lanes());
        for matrix in inputs[0].f().chunks(n * n) {
            let (values, vectors) = jacobi(matrix, n);
            result.extend(values);
            result.extend(vectors);
        }
        Array::floats(out, result)
    }
    fn vjp(&self, _: &[Tensor], output: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let n = self.n;
        let (values, vectors) = split(output, n);
        let (g_values, g_vectors) = split(g, n);
        let rows: Vec<usize> = (0..n * n).map(|i| i / n).collect();
        let columns: Vec<usize> = (0..n * n).map(|i| i % n).collect();
        let gap = values.pick_as(&columns, (n, n)) - values.pick_as(&rows, (n, n));
        let scale = values.abs().max_channels();
        let (zero, one) = (Tensor::scalar(0.0), Tensor::scalar(1.0));
        let distinct = gap.abs().greater_than(&(scale * EQUAL));
        let f = distinct.select(&(1.0 / distinct.select(&gap, &one)), &zero);
        let turned = f * matmul(&vectors.transpose(), &g_vectors);
        let diagonal: Vec<usize> = (0..n * n).map(|i| if i / n == i % n { i / n } else { n }).collect();
        let inner = turned + concat([&g_values, &zero]).pick_as(&diagonal, (n, n));
        let full = matmul(&matmul(&vectors, &inner), &vectors.transpose());
        vec![Some((&full + full.transpose()) * 0.5)]
    }
}

/// Eigenvalues and eigenvectors out of the channels of [`SymEig`].
#[track_caller]
fn split(t: &Tensor, n: usize) -> (Tensor, Tensor) {
    let vectors: Vec<usize> = (n..n + n * n).collect();
    (t.slice(0..n), t.pick_as(&vectors, (n, n)))
}

/// Cyclic Jacobi: every off-diagonal entry in turn is rotated to zero, until all are.
pub fn jacobi(matrix: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut a: Vec<f64> = (0..n * n).map(|i| 0.5 * (matrix[i] + matrix[i % n * n + i / n])).collect();
    let mut v: Vec<f64> = (0..n * n).map(|i| if i / n == i % n { 1.0 } else { 0.0 }).collect();
    for _sweep in 0..60 {
        let mut rotated = false;
        for p in 0..n {
            for q in p + 1..n {
                let (app, aqq, apq) = (a[p * n + p], a[q * n + q], a[p * n + q]);
                // Too small to change either eigenvalue or, in 53 bits, an eigenvector.
                let negligible = |diagonal: f64| diagonal.abs() + 100.0 * apq.abs() == diagonal.abs();
                if negligible(app) && negligible(aqq) {
                    a[p * n + q] = 0.0;
                    a[q * n + p] = 0.0;
                    continue;
                }
                rotated = true;
                let theta = (aqq - app) / (2.0 * apq);
                let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for k in 0..n {
                    let (x, y) = (a[k * n + p], a[k * n + q]);
                    a[k * n + p] = c * x - s * y;
                    a[k * n + q] = s * x + c * y;
                }
                for k in 0..n {
                    let (x, y) = (a[p * n + k], a[q * n + k]);
                    a[p * n + k] = c * x - s * y;
                    a[q * n + k] = s * x + c * y;
                    let (x, y) = (v[k * n + p], v[k * n + q]);
                    v[k * n + p] = c * x - s * y;
                    v[k * n + q] = s * x + c * y;
                }
                a[p * n + q] = 0.0;
                a[q * n + p] = 0.0;
            }
        }
        if !rotated {
            break;
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|i, j| a[i * n + i].total_cmp(&a[j * n + j]));
    let mut vectors = vec![0.0; n * n];
    for (to, from) in order.iter().enumerate() {
        let column: Vec<f64> = (0..n).map(|k| v[k * n + from]).collect();
        let largest = column.iter().fold(0.0f64, |m, x| if x.abs() > m.abs() { *x } else { m });
        for (k, x) in column.iter().enumerate() {
            vectors[k * n + to] = if largest < 0.0 { -x } else { *x };
        }
    }
    (order.iter().map(|i| a[i * n + i]).collect(), vectors)
}

impl Tensor {
    /// Eigenvalues (ascending) and eigenvectors (the columns of an `(n, n)` matrix) of this symmetric matrix.
    #[track_caller]
    pub fn sym_eig(&self) -> (Tensor, Tensor) {
        let n = match self.channels() {
            Channels::Matrix(r, _) => r,
            Channels::Vector(n) => n,
        };
        let both = Tensor::record(SymEig { n }, &[self]);
        if both.error().is_some() {
            return (both.clone(), both);
        }
        split(&both, n)
    }
}

pub fn samples() -> Vec<Sample> {
    let frame = Axis::new("frame", 3);
    let case = |n: usize| {
        // A spread diagonal keeps the eigenvalues apart.
        let spread: Vec<f64> = (0..n * n).map(|i| if i / n == i % n { (i / n) as f64 * 1.5 } else { 0.0 }).collect();
        let input = SampleInput::new(Shape::new(&[&frame], (n, n)), -0.5, 0.5);
        Sample::new(format!("sym_eig {n}"), vec![input], move |x| {
            let (values, vectors) = (&x[0] + Tensor::constant_matrix(n, n, &spread)).sym_eig();
            concat([&values, &vectors])
        })
    };
    [2, 3, 4, 9].map(case).into()
}
