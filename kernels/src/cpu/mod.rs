//! CPU kernels: the inner loops that a compiled tile program calls.
//!
//! A tile value is **channel-major**, `[channel][row]`, in 32-bit lanes (`f32`, or `u32` bits). Neighbouring channels
//! are `ld` lanes apart. Rows are the samples of a batch, so every kernel vectorises over rows; only the sum over rows of
//! [`mod@outer`] transposes an operand. The number of rows is padded to [`ROW_BLOCK`]; padded rows hold
//! anything, NaN too: kernels that work row by row may read and write them, sums over rows leave them out.
//!
//! Every kernel is written once, generic over `simd::Simd`, and `simd::launch` instantiates it for each
//! instruction set. Which one runs is an explicit argument ([`Isa`]), so that tests cover all of them on one machine.
#![allow(clippy::needless_range_loop, reason = "indices name the rows and columns of register blocks")]
pub mod aligned;
#[cfg(target_arch = "x86_64")]
mod amx;
pub mod gemm;
pub mod isa;
pub(crate) mod math;
pub mod outer;
pub mod panels;
pub mod peak;
pub mod products;
pub mod reduce;
mod simd;
mod simd_portable;
#[cfg(target_arch = "x86_64")]
mod simd_x86;
pub mod tile;
pub mod vector;

#[cfg(test)]
mod matrix_tests;
#[cfg(test)]
mod vector_tests;

pub use aligned::AlignedVec;
pub use gemm::{Epilogue, Gemm, gemm, gemm_scratch};
pub use isa::Isa;
pub use outer::{Outer, outer, outer_len, outer_scratch, unblock};
pub use panels::{pack_panels, panel_len};
pub use peak::peak_gflops;
pub use products::Products;
pub use reduce::{larger, raise, rows_max, rows_sum};
pub use vector::{Operand, Operands, apply};

/// Row counts of matrix kernels are multiples of this.
pub const ROW_BLOCK: usize = 32;

/// A row stride between channels for tiles of `rows` rows: whole cache lines, and an odd number of them as soon as
/// there is more than one, so that a column of channels does not fall into few cache sets.
pub fn row_stride(rows: usize) -> usize {
    let lines = rows.next_multiple_of(ROW_BLOCK).div_ceil(16);
    16 * (lines | 1)
}
