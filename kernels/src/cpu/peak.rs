//! The multiply-add peak of this machine, to which kernel speeds are compared.
use super::products::{Multiply, Pairs, Singles};
use super::simd::{Kernel, Simd, launch};
use super::{Isa, Products};
use std::hint::black_box;
use std::time::{Duration, Instant};

/// Multiply-adds of each chain between two looks at the clock.
const STEPS: usize = 20_000;

/// GFLOP/s (a multiply-add counts twice) of `threads` threads that do nothing but multiply-adds for `ms` milliseconds,
/// of `products`, with the best instruction set. More threads than cores do no more together.
pub fn peak_gflops(products: Products, threads: usize, ms: f64) -> f64 {
    let threads = threads.min(std::thread::available_parallelism().map_or(threads, usize::from));
    let isa = Isa::detect();
    let limit = Duration::from_secs_f64(ms * 1e-3);
    std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads).map(|_| scope.spawn(move || rate(isa, products, limit))).collect();
        let own = rate(isa, products, limit);
        own + others.into_iter().map(|t| t.join().expect("a measuring thread panicked")).sum::<f64>()
    })
}

/// GFLOP/s of the calling thread.
fn rate(isa: Isa, products: Products, limit: Duration) -> f64 {
    let start = Instant::now();
    let mut flops = 0.0;
    loop {
        // SAFETY: `isa` was detected, and the kernel touches no memory.
        flops += unsafe { steps(isa, products) };
        let elapsed = start.elapsed();
        if elapsed >= limit {
            return flops / elapsed.as_secs_f64() * 1e-9;
        }
    }
}

/// Runs one stretch of multiply-adds, and returns the number of operations.
///
/// # Safety
/// `isa.supported()`.
unsafe fn steps(isa: Isa, products: Products) -> f64 {
    // SAFETY: forwarded contract.
    unsafe {
        #[cfg(target_arch = "x86_64")]
        if (isa, products) == (Isa::AmxBf16, Products::Bf16) {
            return super::amx::chains(STEPS);
        }
        launch(isa, &Chains(products))
    }
}

/// Runs [`STEPS`] multiply-adds in every chain and returns the number of operations. There are more independent chains
/// than latency times throughput of current cores, while chains and factors stay within the registers.
struct Chains(Products);

impl Kernel for Chains {
    type Out = f64;
    const PAIRS: bool = true;

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) -> f64 {
        // SAFETY: forwarded contract.
        unsafe {
            match self.0 {
                Products::F32 => chains_of::<S, Singles>(),
                Products::Bf16 => chains_of::<S, Pairs>(),
            }
        }
    }
}

/// # Safety
/// The CPU has the instruction set of `S`.
#[inline(always)]
unsafe fn chains_of<S: Simd, P: Multiply<S>>() -> f64 {
    // SAFETY: forwarded contract.
    unsafe {
        match S::REGISTERS {
            32.. => chains::<S, P, 20>(),
            16.. => chains::<S, P, 12>(),
            _ => chains::<S, P, 6>(),
        }
    }
}

/// # Safety
/// The CPU has the instruction set of `S`.
#[inline(always)]
unsafe fn chains<S: Simd, P: Multiply<S>, const N: usize>() -> f64 {
    // SAFETY: register operations of an instruction set that the caller vouches for.
    unsafe {
        // Sums stay at 0, as floats and of pairs. A chain runs through its sum, as in the products of layers: through a factor
        // a Zen 4 does a third as many products of pairs.
        let (a, b) = (S::splat(black_box(0.0)), S::splat(black_box(1.0)));
        let mut acc = [S::splat(black_box(0.0)); N];
        for _ in 0..STEPS {
            for v in &mut acc {
                *v = P::multiply_add(a, b, *v);
            }
        }
        let mut sum = acc[0];
        for v in acc {
            sum = S::add(sum, v);
        }
        let mut out = [0.0f32; 16];
        S::store(out.as_mut_ptr(), sum);
        black_box(out);
    }
    (STEPS * N * S::LANES * 2 * P::PRODUCTS.values()) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peak_is_positive() {
        for products in [Products::F32, Products::Bf16] {
            assert!(peak_gflops(products, 2, 2.0) > 0.1);
        }
    }
}
