//! The matrix kernels and reductions against `f64` loops, for odd shapes on every instruction set.
use super::*;

/// Every instruction set with everything that it can multiply.
fn forms() -> impl Iterator<Item = (Isa, Products)> {
    Isa::available().into_iter().flat_map(|isa| [(isa, Products::F32), (isa, Products::Bf16)])
}

/// What a product takes an operand for.
fn rounded(products: Products, x: f32) -> f64 {
    match products {
        Products::F32 => x as f64,
        Products::Bf16 => half::bf16::from_f32(x).to_f64(),
    }
}

const SIZES: [usize; 8] = [1, 2, 3, 5, 34, 63, 256, 257];
const ROWS: [usize; 4] = [32, 64, 96, 192];

/// Pseudo-random values in -1..1 (an LCG; the low bits are the bad ones).
fn noise(len: usize, seed: u64) -> AlignedVec {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut out = AlignedVec::zeroed(len);
    for x in out.iter_mut() {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        *x = (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    }
    out
}

/// Sizes to pair with `size`: all of them for small ones, few for large ones.
fn partners(size: usize) -> impl Iterator<Item = usize> {
    SIZES.into_iter().filter(move |&other| size * other <= 257 * 63 || (size, other) == (256, 257))
}

/// What surrounds an output, to detect stray writes.
const CANARY: f32 = 12345.0;

struct GemmCase {
    contraction: usize,
    outputs: usize,
    rows: usize,
    ldx: usize,
    ldy: usize,
    x: AlignedVec,
    w: AlignedVec,
    bias: AlignedVec,
    h: AlignedVec,
}

impl GemmCase {
    fn new(contraction: usize, outputs: usize, rows: usize) -> GemmCase {
        let (ldx, ldy) = (row_stride(rows), row_stride(rows) + 16);
        let mut x = noise((contraction + 1) * ldx, 1);
        // Nobody may look at what follows the last channel.
        x[contraction * ldx..].fill(f32::NAN);
        let w = noise(contraction * outputs, 2);
        let (bias, h) = (noise(outputs, 3), noise(outputs * ldy, 4));
        GemmCase { contraction, outputs, rows, ldx, ldy, x, w, bias, h }
    }

    /// Runs the kernel with the weights as `[contraction][outputs]` or transposed; `in_place` masks `y` by itself.
    fn run(
        &self,
        (isa, products): (Isa, Products),
        transposed: bool,
        bias: bool,
        accumulate: bool,
        epilogue: &str,
    ) -> AlignedVec {
        let (c, o) = (self.contraction, self.outputs);
        let mut panels = AlignedVec::zeroed(panel_len(products, c, o));
        let mut scratch = AlignedVec::zeroed(gemm_scratch(products, c) + 1);
        *scratch.last_mut().unwrap() = CANARY;
        let (k, n) = if transposed { (o, c) } else { (c, o) };
        pack_panels(isa, products, &self.w, k, n, transposed, &mut panels);
        let mut y = self.h.clone();
        for row in y.chunks_exact_mut(self.ldy) {
            row[self.rows..].fill(CANARY);
        }
        let epilogue = match epilogue {
            "none" => Epilogue::None,
            "relu" => Epilogue::Relu,
            "mask" => Epilogue::Mask { h: self.h.as_ptr(), ldh: self.ldy },
            _ => Epilogue::Mask { h: y.as_ptr(), ldh: self.ldy },
        };
        let args = Gemm {
            x: self.x.as_ptr(),
            ldx: self.ldx,
            contraction: c,
            products,
            scratch: scratch.as_mut_ptr(),
            panels: panels.as_ptr(),
            outputs: o,
            bias: if bias { self.bias.as_ptr() } else { std::ptr::null() },
            accumulate,
            epilogue,
            y: y.as_mut_ptr(),
            ldy: self.ldy,
            rows: self.rows,
        };
        // SAFETY: `isa` is available, and the buffers have the shapes given.
        unsafe { gemm(isa, args) };
        assert_eq!(scratch.last(), Some(&CANARY), "stray write");
        y
    }

    fn check(&self, y: &[f32], products: Products, transposed: bool, bias: bool, accumulate: bool, epilogue: &str) {
        let (c, o) = (self.contraction, self.outputs);
        let mut sums = vec![0.0f64; self.rows];
        for j in 0..o {
            sums.fill(if bias { self.bias[j] as f64 } else { 0.0 });
            for i in 0..c {
                let w = rounded(products, self.w[if transposed { j * c + i } else { i * o + j }]);
                for (sum, &x) in sums.iter_mut().zip(&self.x[i * self.ldx..]) {
                    *sum += w * rounded(products, x);
                }
            }
            for (r, sum) in sums.iter().enumerate() {
                let h = self.h[j * self.ldy + r];
                let sum = sum + if accumulate { h as f64 } else { 0.0 };
                let expected = match epilogue {
                    "none" => sum,
                    "relu" => sum.max(0.0),
                    _ => sum * (h > 0.0) as u32 as f64,
                };
                let got = y[j * self.ldy + r] as f64;
                let tolerance = 1e-7 * (c as f64 + 2.0) + 1e-6;
                assert!((got - expected).abs() <= tolerance, "{c}x{o}: y[{j}][{r}] = {got}, not {expected}");
            }
            assert!(y[j * self.ldy + self.rows..(j + 1) * self.ldy].iter().all(|&v| v == CANARY), "stray write");
        }
    }
}

#[test]
fn gemm_matches_f64() {
    for form in forms() {
        for (i, contraction) in SIZES.into_iter().enumerate() {
            for (j, outputs) in partners(contraction).enumerate() {
                let case = GemmCase::new(contraction, outputs, ROWS[(i + j) % 4]);
                let epilogue = ["none", "relu", "mask", "in place"][(i + 2 * j) % 4];
                let (transposed, bias, accumulate) = (j % 2 == 1, i % 2 == 0, (i + j) % 3 == 0);
                let y = case.run(form, transposed, bias, accumulate, epilogue);
                case.check(&y, form.1, transposed, bias, accumulate, epilogue);
            }
        }
    }
}

#[test]
fn gemm_options_combine() {
    // 1..=17 outputs cover every remainder of the micro-kernel.
    for form in forms() {
        for outputs in 1..=17 {
            let case = GemmCase::new(13, outputs, 64);
            for bits in 0..8 {
                for epilogue in ["none", "relu", "mask", "in place"] {
                    let (transposed, bias, accumulate) = (bits & 1 > 0, bits & 2 > 0, bits & 4 > 0);
                    let y = case.run(form, transposed, bias, accumulate, epilogue);
                    case.check(&y, form.1, transposed, bias, accumulate, epilogue);
                }
            }
        }
    }
}

#[test]
fn fused_gemm_is_bitwise_equal_across_instruction_sets() {
    let case = GemmCase::new(63, 34, 96);
    let results: Vec<AlignedVec> = Isa::available()
        .into_iter()
        .filter(|&isa| isa != Isa::Portable)
        .map(|isa| case.run((isa, Products::F32), false, true, false, "relu"))
        .collect();
    for y in &results {
        assert_eq!(y[..], results[0][..]);
    }
}

/// Runs `outer` twice on the same accumulator, the second time with `x` in two parts, and adds the result to ones.
fn outer_twice((isa, products): (Isa, Products), k: usize, n: usize, rows: usize) -> Vec<f32> {
    let ld = row_stride(rows);
    let (mut x, mut d) = (noise(k * ld, 5), noise(n * ld, 6));
    // Rows that do not count hold anything.
    for channel in x.chunks_exact_mut(ld).chain(d.chunks_exact_mut(ld)) {
        channel[rows..].fill(f32::NAN);
    }
    let mut g = AlignedVec::zeroed(outer_len(k, n) + 1);
    let mut scratch = AlignedVec::zeroed(outer_scratch(products, k, n, rows) + 1);
    *scratch.last_mut().unwrap() = CANARY;
    g[outer_len(k, n)] = CANARY;
    let split = if outer::x_along_vectors(k, n) { k / 2 / outer::PANEL * outer::PANEL } else { k / 2 };
    for (first, end) in [(0, k), (0, split), (split, k)] {
        let args = Outer {
            x: x[first * ld..].as_ptr(),
            ldx: ld,
            k: end - first,
            first,
            channels: k,
            d: d.as_ptr(),
            ldd: ld,
            n,
            rows,
            products,
            scratch: scratch.as_mut_ptr(),
            g: g.as_mut_ptr(),
        };
        // SAFETY: `isa` is available, and the buffers have the shapes given.
        unsafe { outer(isa, args) };
    }
    assert_eq!((g[outer_len(k, n)], scratch.last()), (CANARY, Some(&CANARY)), "stray write");
    let mut out = vec![1.0; k * n];
    unblock(&g, k, n, &mut out, true);
    out
}

#[test]
fn outer_matches_f64_and_agrees_where_multiply_adds_are_fused() {
    for (i, k) in SIZES.into_iter().enumerate() {
        for (j, n) in partners(k).enumerate() {
            let rows = [8, 32, 96, 192, 408][(i + j) % 5];
            let ld = row_stride(rows);
            let (x, d) = (noise(k * ld, 5), noise(n * ld, 6));
            let mut fused: Option<Vec<f32>> = None;
            for (isa, products) in forms() {
                let out = outer_twice((isa, products), k, n, rows);
                for a in 0..k {
                    for b in 0..n {
                        let pairs = x[a * ld..].iter().zip(&d[b * ld..]).take(rows);
                        let product = |(&x, &d)| rounded(products, x) * rounded(products, d);
                        let expected = 1.0 + 2.0 * pairs.map(product).sum::<f64>();
                        let got = out[a * n + b] as f64;
                        assert!((got - expected).abs() < 5e-5, "{isa} {k}x{n}: g[{a}][{b}] = {got}, not {expected}");
                    }
                }
                if isa != Isa::Portable && products == Products::F32 {
                    assert_eq!(*fused.get_or_insert(out.clone()), out, "{isa} {k}x{n} differs");
                }
            }
        }
    }
}

/// Vectors that hold the last channels are whole: beyond them they repeat the last one, and nothing that was never written.
#[test]
fn the_rest_of_a_vector_repeats_the_last_channel() {
    for form in forms().filter(|f| *f != (Isa::AmxBf16, Products::Bf16)) {
        for n in [1, 7, 9, 17, 24, 31] {
            let (k, rows) = (n.min(3), 96);
            let ld = row_stride(rows);
            let (mut x, mut d) = (noise(k * ld, 5), noise(n * ld, 6));
            let mut g = AlignedVec::zeroed(outer_len(k, n));
            let mut scratch = AlignedVec::zeroed(outer_scratch(form.1, k, n, rows));
            assert!(!outer::x_along_vectors(k, n));
            let args = Outer {
                x: x.as_mut_ptr(),
                ldx: ld,
                k,
                first: 0,
                channels: k,
                d: d.as_mut_ptr(),
                ldd: ld,
                n,
                rows,
                products: form.1,
                scratch: scratch.as_mut_ptr(),
                g: g.as_mut_ptr(),
            };
            // SAFETY: the form is available, and the buffers have the shapes given.
            unsafe { outer(form.0, args) };
            for line in g.chunks_exact(outer::PANEL) {
                // What no vector reaches is as it was.
                let end = line.iter().rposition(|v| *v != 0.0).map_or(0, |last| last + 1);
                assert!(end >= n && line[n..end].iter().all(|v| *v == line[n - 1]), "{form:?}, {n}: {line:?}");
            }
        }
    }
}

#[test]
fn kernels_repeat_bitwise() {
    for form in forms() {
        let case = GemmCase::new(63, 34, 96);
        assert_eq!(case.run(form, true, true, true, "none")[..], case.run(form, true, true, true, "none")[..]);
        assert_eq!(outer_twice(form, 34, 63, 96), outer_twice(form, 34, 63, 96));
    }
}

impl PartialEq for AlignedVec {
    fn eq(&self, other: &AlignedVec) -> bool {
        self[..] == other[..]
    }
}

#[test]
fn unblock_replaces_or_adds() {
    for (k, n) in [(5, 6), (70, 3), (3, 70)] {
        let mut g = vec![f32::NAN; outer_len(k, n)];
        for i in 0..k {
            for j in 0..n {
                let (vector, other, others) = if outer::x_along_vectors(k, n) { (i, j, n) } else { (j, i, k) };
                g[(vector / 32 * others + other) * 32 + vector % 32] = (i * n + j) as f32;
            }
        }
        let mut out = vec![9.0; k * n];
        unblock(&g, k, n, &mut out, false);
        assert!(out.iter().enumerate().all(|(i, &v)| v == i as f32));
        unblock(&g, k, n, &mut out, true);
        assert!(out.iter().enumerate().all(|(i, &v)| v == 2.0 * i as f32));
    }
}

#[test]
fn reductions_take_the_true_rows_and_agree_across_instruction_sets() {
    let channels = 7;
    for rows in [0, 1, 2, 7, 15, 16, 17, 31, 33, 100, 192, 1000] {
        let ld = row_stride(rows);
        let mut x = noise(channels * ld, 7);
        for channel in x.chunks_exact_mut(ld) {
            channel[rows..].fill(1e9);
        }
        let mut first: Option<Vec<f32>> = None;
        for isa in Isa::available() {
            let (mut sum, mut max) = (vec![0.5f32; channels], vec![-0.5f32; channels]);
            // SAFETY: `isa` is available, and the buffers have the shapes given.
            unsafe {
                rows_sum(isa, x.as_ptr(), ld, channels, rows, sum.as_mut_ptr());
                rows_max(isa, x.as_ptr(), ld, channels, rows, max.as_mut_ptr());
            }
            for c in 0..channels {
                let values = &x[c * ld..][..rows];
                let expected = 0.5 + values.iter().map(|&v| v as f64).sum::<f64>();
                assert!((sum[c] as f64 - expected).abs() < 2e-5, "{isa} rows {rows}: {} {expected}", sum[c]);
                assert_eq!(max[c], values.iter().fold(-0.5, |a: f32, &b| a.max(b)));
            }
            assert_eq!(*first.get_or_insert(sum.clone()), sum, "{isa} differs");
        }
    }
}
