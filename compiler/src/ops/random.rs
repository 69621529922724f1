//! Counter-based random numbers: a hash of (element, stream, step), the same bits on every backend, at any step.
//!
//! The hash is `pcg3d` of Jarzynski and Olano, Hash Functions for GPU Rendering (JCGT 9(3), 2020): with v = (counter,
//! stream, step), `v = 1664525 v + 1013904223`; twice `x += y z; y += z x; z += x y`, with `v ^= v >> 16` between the
//! two; the result is x. Uniform numbers are `(bits >> 8) 2^-24`, normal ones follow by Box and Muller.

use super::{Pointwise, Sample, SampleInput, map};
use crate::graph::{Axes, Axis, Shape, Tensor};
use crate::reference::Lane;
use crate::scalar::{DType, Prim, ScalarBuilder, Val};

/// 32 random bits for (counter, step); operands are those two.
#[derive(Clone, Debug)]
pub struct Random {
    pub stream: u32,
}

const MULTIPLIER: u32 = 1_664_525;
const INCREMENT: u32 = 1_013_904_223;

/// The hash itself.
pub fn pcg3d(counter: u32, stream: u32, step: u32) -> u32 {
    let [mut x, mut y, mut z] = [counter, stream, step].map(|v| v.wrapping_mul(MULTIPLIER).wrapping_add(INCREMENT));
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    [x, y, z] = [x, y, z].map(|v| v ^ (v >> 16));
    x.wrapping_add(y.wrapping_mul(z))
}

impl Pointwise for Random {
    fn name(&self) -> &'static str {
        "random_bits"
    }
    fn operands(&self) -> &'static [Option<DType>] {
        &[Some(DType::U32), Some(DType::U32)]
    }
    fn result(&self) -> Option<DType> {
        Some(DType::U32)
    }
    fn eval(&self, a: &[Lane]) -> Lane {
        Lane::U(pcg3d(a[0].u(), self.stream, a[1].u()))
    }
    fn vjp(&self, _: &[Tensor], _: &Tensor, _: &Tensor) -> Vec<Option<Tensor>> {
        vec![None, None]
    }
    fn lower(&self, b: &mut ScalarBuilder, a: &[Val]) -> Val {
        let spread = |b: &mut ScalarBuilder, v: Val| {
            let product = b.emit(Prim::UMul, &[v, b.u(MULTIPLIER)]);
            b.emit(Prim::UAdd, &[product, b.u(INCREMENT)])
        };
        let add_product = |b: &mut ScalarBuilder, x: Val, y: Val, z: Val| {
            let product = b.emit(Prim::UMul, &[y, z]);
            b.emit(Prim::UAdd, &[x, product])
        };
        let fold = |b: &mut ScalarBuilder, v: Val| {
            let high = b.emit(Prim::UShr, &[v, b.u(16)]);
            b.emit(Prim::UXor, &[v, high])
        };
        let (x, z) = (spread(b, a[0]), spread(b, a[1]));
        let y = b.u(self.stream.wrapping_mul(MULTIPLIER).wrapping_add(INCREMENT));
        let x = add_product(b, x, y, z);
        let y = add_product(b, y, z, x);
        let z = add_product(b, z, x, y);
        let (x, y, z) = (fold(b, x), fold(b, y), fold(b, z));
        add_product(b, x, y, z)
    }
}

/// 32 random bits a lane of `counter`. `stream` tells uses apart, `step` (`u32`) the steps of a run.
#[track_caller]
pub fn random_bits(counter: &Tensor, stream: u32, step: &Tensor) -> Tensor {
    map(Random { stream }, &[counter, step])
}

/// A number for every (element, channel): the row-major position, modulo 2^32.
#[track_caller]
pub fn counter(axes: &Axes, channels: usize) -> Tensor {
    let mut position: Option<Tensor> = None;
    for axis in axes {
        let index = Tensor::index(axis);
        position = Some(match position {
            Some(p) => p.wrapping_mul(&Tensor::integers(&[axis.size() as u32])).wrapping_add(&index),
            None => index,
        });
    }
    let lanes = Tensor::integers(&(0..channels as u32).collect::<Vec<_>>());
    match position {
        Some(p) => p.wrapping_mul(&Tensor::integers(&[channels as u32])).wrapping_add(&lanes),
        None => lanes,
    }
}

/// Uniform numbers in `0..1`, multiples of 2^-24.
#[track_caller]
pub fn uniform(axes: &Axes, channels: usize, stream: u32, step: &Tensor) -> Tensor {
    let bits = random_bits(&counter(axes, channels), stream, step);
    bits.shift_right(&Tensor::integers(&[8])).to_f32() * 2f64.powi(-24)
}

/// Normal numbers of mean 0 and deviation 1: `sqrt(-2 log u) cos(2 pi v)` with `u` in `(0, 1]` and `v` in `[0, 1)`.
#[track_caller]
pub fn normal(axes: &Axes, channels: usize, stream: u32, step: &Tensor) -> Tensor {
    let u = 1.0 - uniform(axes, channels, stream, step);
    // Flipping a bit of the stream would not do: neighbours of one factor stay neighbours through a generator of products.
    let v = uniform(axes, channels, stream.wrapping_mul(0x9e37_79b9).wrapping_add(0x7f4a_7c15), step);
    (u.log() * -2.0).sqrt() * (v * std::f64::consts::TAU).cos()
}

pub fn samples() -> Vec<Sample> {
    let (frame, row) = (Axis::new("frame", 3), Axis::new("row", 7));
    let axes = Axes::new([frame, row]);
    let step = || vec![SampleInput::new(Shape::new(&[], 1), 0.0, 1000.0)];
    let axes2 = axes.clone();
    vec![
        Sample::new("uniform", step(), move |x| uniform(&axes, 3, 5, &x[0].to_u32())).not_differentiable(),
        Sample::new("normal", step(), move |x| normal(&axes2, 2, 6, &x[0].to_u32())).not_differentiable(),
    ]
}
