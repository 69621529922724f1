//! Speed of the CPU kernels on one thread: matrix kernels in per cent of the multiply-add peak that is measured right
//! before and after, functions in nanoseconds per value. Products are those of floats, and of bfloat16 pairs.
//!
//! `cargo run --release -p raygrad-kernels --example gemm_peak [-- <seconds per case> <instruction set>]`
use raygrad_compiler::scalar::Prim;
use raygrad_kernels::cpu::*;
use std::time::Instant;

/// Weight matrices that take turns, so that none stays in the L1 cache.
const SETS: usize = 4;

/// Seconds per call of `f` over about `seconds`, looking at the clock after every `batch` calls.
fn time(seconds: f64, batch: usize, mut f: impl FnMut(usize)) -> f64 {
    let start = Instant::now();
    let mut calls = 0;
    loop {
        for _ in 0..batch {
            f(calls);
            calls += 1;
        }
        let elapsed = start.elapsed().as_secs_f64();
        if elapsed >= seconds {
            return elapsed / calls as f64;
        }
    }
}

/// Calls of `f` that take about 100 microseconds.
fn batch(f: impl FnMut(usize)) -> usize {
    (1e-4 / time(1e-3, SETS, f)).ceil() as usize
}

/// Prints quartiles of many short measurements, each relative to the peak right before and after it.
fn report(name: &str, products: Products, flops: f64, seconds: f64, mut f: impl FnMut(usize)) {
    // Shorter than a scheduler's time slice, so that most windows see no other process.
    const WINDOW: f64 = 1e-3;
    let batch = batch(&mut f);
    let mut before = peak_gflops(products, 1, WINDOW * 1e3);
    let mut percent: Vec<f64> = (0..(seconds / WINDOW) as usize + 4)
        .map(|_| {
            let rate = flops / time(WINDOW, batch, &mut f) * 1e-9;
            let after = peak_gflops(products, 1, WINDOW * 1e3);
            rate / (0.5 * (std::mem::replace(&mut before, after) + after)) * 100.0
        })
        .collect();
    percent.sort_by(f64::total_cmp);
    let [low, median, high] = [1, 2, 3].map(|q| percent[percent.len() * q / 4]);
    println!("{name:36} {median:6.1} % of peak (quartiles {low:.1} .. {high:.1})");
}

/// Nanoseconds per value of a call on `values` values: the best of many short measurements.
fn nanoseconds(values: usize, seconds: f64, mut f: impl FnMut(usize)) -> f64 {
    let batch = batch(&mut f);
    let best = (0..(seconds / 2e-4) as usize + 1).map(|_| time(2e-4, batch, &mut f)).fold(f64::INFINITY, f64::min);
    best * 1e9 / values as f64
}

fn filled(len: usize) -> AlignedVec {
    let mut v = AlignedVec::zeroed(len);
    v.iter_mut().enumerate().for_each(|(i, x)| *x = ((i * 37 % 101) as f32 - 50.0) * 0.01);
    v
}

fn matrix_kernels(isa: Isa, products: Products, [k, n, rows]: [usize; 3], seconds: f64) {
    let ld = row_stride(rows);
    let (x, mut y, bias) = (filled(k * ld), filled(n * ld), filled(n));
    let weights = panel_len(products, k, n);
    let panels = filled(weights * SETS);
    let mut scratch = AlignedVec::zeroed(gemm_scratch(products, k).max(outer_scratch(products, k, n, rows)));
    let scratch = scratch.as_mut_ptr();
    let flops = 2.0 * (k * n * rows) as f64;
    report(&format!("{isa} {products:?} gemm {k}x{n}, {rows} rows"), products, flops, seconds, |i| {
        let args = Gemm {
            x: x.as_ptr(),
            ldx: ld,
            contraction: k,
            products,
            scratch,
            panels: panels[i % SETS * weights..].as_ptr(),
            outputs: n,
            bias: bias.as_ptr(),
            accumulate: false,
            epilogue: Epilogue::Relu,
            y: y.as_mut_ptr(),
            ldy: ld,
            rows,
        };
        // SAFETY: `isa` is available, and the buffers have the shapes given.
        unsafe { gemm(isa, args) }
    });
    let mut g = AlignedVec::zeroed(outer_len(k, n) * SETS);
    report(&format!("{isa} {products:?} outer {k}x{n}, {rows} rows"), products, flops, seconds, |i| {
        let g = g[i % SETS * outer_len(k, n)..].as_mut_ptr();
        let d = y.as_ptr();
        let args =
            Outer { products, scratch, x: x.as_ptr(), ldx: ld, k, first: 0, channels: k, d, ldd: ld, n, rows, g };
        // SAFETY: as above.
        unsafe { outer(isa, args) }
    });
    let mut sums = vec![0.0; k];
    let each = nanoseconds(k * rows, 0.1 * seconds, |_| {
        // SAFETY: as above.
        unsafe { rows_sum(isa, x.as_ptr(), ld, k, rows, sums.as_mut_ptr()) }
    });
    println!("{isa} rows_sum {k} channels, {rows} rows: {each:.3} ns/value");
}

fn functions(isa: Isa, len: usize, seconds: f64) {
    let (a, b) = (filled(len), filled(len));
    let mut out = AlignedVec::zeroed(len);
    print!("{isa} ns/value, runs of {len}:");
    use Prim::*;
    for prim in [Exp, Log, Sin, Cos, Tanh, Atan2, Add, Div, Sqrt, ToU32] {
        let operands = [Operand::Lanes(a.as_ptr()), Operand::Lanes(b.as_ptr()), Operand::Splat(0)].into();
        // SAFETY: all runs have `len` lanes.
        let each = nanoseconds(len, 0.1 * seconds, |_| unsafe { apply(isa, prim, out.as_mut_ptr(), &operands, len) });
        print!(" {prim:?} {each:.3}");
    }
    println!();
}

fn main() {
    let seconds = std::env::args().nth(1).and_then(|s| s.parse().ok()).unwrap_or(0.15);
    let all = [Products::F32, Products::Bf16];
    for products in all {
        println!(
            "peak of one thread: {:.1} GFLOP/s ({}, {products:?})",
            peak_gflops(products, 1, 200.0),
            Isa::detect()
        );
    }
    let only = std::env::args().nth(2);
    for isa in Isa::available().into_iter().filter(|isa| only.as_ref().is_none_or(|name| isa.to_string() == *name)) {
        for sizes in [[256, 256, 192], [256, 256, 96], [34, 256, 192], [64, 64, 192], [256, 3, 192]] {
            all.into_iter().for_each(|products| matrix_kernels(isa, products, sizes, seconds));
        }
        for len in [64, 192, 1024] {
            functions(isa, len, seconds);
        }
    }
}
