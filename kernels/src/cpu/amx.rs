//! Products of tiles of bfloat16 pairs: AMX, the matrix extensions of x86-64.
//!
//! A tile register holds up to 16 lines of 16 lanes. One instruction multiplies `[line][pair]` by `[pair][column]`, 16 pairs
//! at a time, and adds to `[line][column]`, sixteen times what a vector instruction does. Blocks are one tile high and two
//! wide, with four registers in use: loads and products rename their registers, and beside a neighbour on the same core so few
//! seem to be left that larger blocks wait for each other (docs/rejected.md).
//!
//! Tile registers belong to this module alone, since no compiler uses them unasked. Hence their configuration may last from one
//! `asm!` to the next; what they hold does not need to.
use super::gemm::{Gemm, MOST_ROWS};
use super::outer::{self, Outer};
use super::products::{Channels, Multiply, Pairs};
use super::simd::{Kernel, Simd};
use super::simd_x86::run_avx512_bf16;
use super::{Products, ROW_BLOCK};
use std::arch::asm;
use std::arch::x86_64::__cpuid_count;
use std::sync::OnceLock;

/// Lines of a tile, and lanes of a line.
const TILE: usize = 16;
/// Columns of a block: two tiles.
const COLUMNS: usize = 2 * TILE;

/// Whether the CPU has the instructions and the operating system lets this process use them. Asks it, the first time.
pub(super) fn allowed() -> bool {
    static ALLOWED: OnceLock<bool> = OnceLock::new();
    *ALLOWED.get_or_init(|| {
        // Leaf 7, EDX: bit 22 is AMX-BF16, bit 24 AMX-TILE.
        const NEEDED: u32 = 1 << 22 | 1 << 24;
        __cpuid_count(7, 0).edx & NEEDED == NEEDED && ask()
    })
}

/// Asks Linux to save and restore the tiles of this process' threads. Refused if it does not know them.
#[cfg(target_os = "linux")]
fn ask() -> bool {
    /// From the kernel's `asm/prctl.h`.
    const ARCH_REQ_XCOMP_PERM: libc::c_int = 0x1023;
    /// State component 18: the data of tiles.
    const XTILEDATA: libc::c_ulong = 18;
    // SAFETY: a system call that takes two numbers and writes to no memory of ours.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XTILEDATA) == 0 }
}

#[cfg(not(target_os = "linux"))]
fn ask() -> bool {
    false
}

/// Configured tile registers; released when dropped, so that idle threads have no tiles to save.
struct Tiles {
    lines: usize,
}

/// What `ldtilecfg` reads.
#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start: u8,
    reserved: [u8; 14],
    bytes: [u16; 16],
    lines: [u8; 16],
}

impl Tiles {
    /// # Safety
    /// [`allowed`].
    #[inline(always)]
    unsafe fn new() -> Tiles {
        let mut tiles = Tiles { lines: 0 };
        // SAFETY: forwarded contract.
        unsafe { tiles.configure(TILE) };
        tiles
    }

    /// Sets the lines of sums and of the first factor, 1 to [`TILE`]: registers 0 to 2. Others have [`TILE`].
    ///
    /// # Safety
    /// [`allowed`].
    #[inline(always)]
    unsafe fn configure(&mut self, lines: usize) {
        if lines == self.lines {
            return;
        }
        self.lines = lines;
        let mut all = Configuration { palette: 1, start: 0, reserved: [0; 14], bytes: [0; 16], lines: [0; 16] };
        all.bytes[..8].fill(4 * TILE as u16);
        all.lines[..8].fill(TILE as u8);
        all.lines[..3].fill(lines as u8);
        // SAFETY: a valid configuration of 64 bytes; the tiles are this module's.
        unsafe {
            asm!(
                "ldtilecfg [{at}]", at = in(reg) &all, options(nostack, preserves_flags, readonly),
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            );
        }
    }
}

impl Drop for Tiles {
    #[inline(always)]
    fn drop(&mut self) {
        // SAFETY: the tiles are this module's, and hold nothing that is still needed.
        unsafe {
            asm!(
                "tilerelease", options(nostack, preserves_flags, nomem),
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            );
        }
    }
}

/// Multiplies zeros, `steps` times four tiles whose sums do not wait for each other; the number of operations.
///
/// # Safety
/// [`allowed`].
pub(super) unsafe fn chains(steps: usize) -> f64 {
    // SAFETY: forwarded contract; works on registers only.
    unsafe {
        let _tiles = Tiles::new();
        asm!(
            "2:",
            "tdpbf16ps tmm0, tmm4, tmm5",
            "tdpbf16ps tmm1, tmm4, tmm5",
            "tdpbf16ps tmm2, tmm4, tmm5",
            "tdpbf16ps tmm3, tmm4, tmm5",
            "dec {steps}",
            "jnz 2b",
            steps = inout(reg) steps.max(1) => _,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            options(nostack, nomem),
        );
    }
    (steps.max(1) * 4 * TILE * TILE * 2 * TILE * 2) as f64
}

/// Lines that start `ld` lanes apart.
#[derive(Clone, Copy)]
struct Lines<T> {
    at: T,
    ld: usize,
}

/// `c = a b`, or `c += a b`: `tiles` times [`TILE`] pairs along the sum, [`COLUMNS`] columns if `WIDE` or half as many.
///
/// # Safety
/// [`Tiles`] are configured for the lines of `a` and `c`; `a` has `tiles * TILE` lanes a line, `b` as many lines of the
/// columns, and `tiles` is not 0.
#[inline(always)]
unsafe fn product<const WIDE: bool>(
    a: Lines<*const f32>,
    b: Lines<*const f32>,
    tiles: usize,
    c: Lines<*mut f32>,
    add: bool,
) {
    macro_rules! product {
        ($([$second:literal])?) => {
            asm!(
                "test {add:e}, {add:e}",
                "jz 2f",
                "tileloadd tmm0, [{c} + {ldc}]",
                $(concat!($second, "tileloadd tmm1, [{c} + {ldc} + 64]"),)?
                "jmp 3f",
                "2:",
                "tilezero tmm0",
                $(concat!($second, "tilezero tmm1"),)?
                "3:",
                "tileloadd tmm2, [{a} + {lda}]",
                "tileloadd tmm3, [{b} + {ldb}]",
                "tdpbf16ps tmm0, tmm2, tmm3",
                $(concat!($second, "tileloadd tmm3, [{b} + {ldb} + 64]"),)?
                $(concat!($second, "tdpbf16ps tmm1, tmm2, tmm3"),)?
                "add {a}, 64",
                "add {b}, {step}",
                "dec {tiles}",
                "jnz 3b",
                "tilestored [{c} + {ldc}], tmm0",
                $(concat!($second, "tilestored [{c} + {ldc} + 64], tmm1"),)?
                a = inout(reg) a.at => _,
                lda = in(reg) 4 * a.ld,
                b = inout(reg) b.at => _,
                ldb = in(reg) 4 * b.ld,
                step = in(reg) 4 * TILE * b.ld,
                tiles = inout(reg) tiles => _,
                c = in(reg) c.at,
                ldc = in(reg) 4 * c.ld,
                add = in(reg) u32::from(add),
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                options(nostack),
            )
        };
    }
    debug_assert!(tiles > 0);
    // SAFETY: reads and writes what the caller vouches for.
    unsafe { if WIDE { product!([""]) } else { product!() } }
}

/// A product of [`Products::Bf16`] in tiles.
struct Tiled<'a, T>(&'a T);

/// # Safety
/// As [`super::gemm()`], and [`allowed`].
pub(super) unsafe fn gemm(args: &Gemm) {
    // SAFETY: forwarded contract; a CPU with tiles has the vectors.
    unsafe { run_avx512_bf16(&Tiled(args)) }
}

/// # Safety
/// As [`super::outer()`], and [`allowed`].
pub(super) unsafe fn outer(args: &Outer) {
    // SAFETY: forwarded contract; a CPU with tiles has the vectors.
    unsafe { run_avx512_bf16(&Tiled(args)) }
}

impl Kernel for Tiled<'_, Outer> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        // SAFETY: forwarded contract.
        unsafe { self.0.panels::<S, Pairs, 8, 2, 1, true>() }
    }
}

impl Kernel for Tiled<'_, Gemm> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(&self) {
        let rows = self.0.rows;
        // SAFETY: forwarded contract.
        unsafe {
            let mut tiles = Tiles::new();
            let mut row = 0;
            while row < rows {
                if rows - row >= MOST_ROWS {
                    self.rows::<S, { MOST_ROWS / TILE }>(row, &mut tiles);
                } else {
                    self.rows::<S, { ROW_BLOCK / TILE }>(row, &mut tiles);
                }
                row += MOST_ROWS;
            }
        }
    }
}

impl Tiled<'_, Gemm> {
    /// All outputs of `NV` vectors of rows.
    ///
    /// # Safety
    /// As [`gemm`], and the operands have these rows.
    #[inline(always)]
    unsafe fn rows<S: Simd, const NV: usize>(&self, row: usize, tiles: &mut Tiles) {
        let args = self.0;
        let width = NV * TILE;
        let ld = Products::Bf16.weight_stride(args.contraction);
        // SAFETY: every channel has these rows, and the scratch has room for them: whole tiles of pairs, of which there may be
        // more than the operand has. Weights and bias have a line or a value for each output, and so do `y` and `h`.
        unsafe {
            let x = Channels { at: args.x.add(row), ld: args.ldx, count: args.contraction };
            let x = <Pairs as Multiply<S>>::over_channels::<NV>(x, args.scratch);
            std::slice::from_raw_parts_mut(args.scratch.add(x.count * width), (ld - x.count) * width).fill(0.0);
            let mut sums = Sums([0.0; TILE * COLUMNS]);
            for output in (0..args.outputs).step_by(TILE) {
                let count = TILE.min(args.outputs - output);
                tiles.configure(count);
                let weights = Lines { at: args.panels.add(output * ld), ld };
                for first in (0..width).step_by(COLUMNS) {
                    let x = Lines { at: x.at.add(first), ld: width };
                    let to = Lines { at: sums.0.as_mut_ptr(), ld: COLUMNS };
                    product::<true>(weights, x, ld / TILE, to, false);
                    for i in 0..count {
                        let bias = if args.bias.is_null() { 0.0 } else { *args.bias.add(output + i) };
                        let mut acc = [[S::splat(bias); 2]];
                        for j in 0..2 {
                            acc[0][j] = S::add(acc[0][j], S::load(sums.0.as_ptr().add(i * COLUMNS + j * TILE)));
                        }
                        args.finish::<S, 1, 2>(&mut acc, output + i, row + first);
                    }
                }
            }
        }
    }
}

/// Sums of a block.
#[repr(align(64))]
struct Sums([f32; TILE * COLUMNS]);

/// All sums of a panel: the first `columns` of its [`outer::PANEL`] by all of `others`, over `steps` lines, whole tiles.
///
/// # Safety
/// As [`Outer::panels`]: `g` has a line for each of `others`, which have `steps` lanes, and the panel has as many lines.
#[inline(always)]
pub(super) unsafe fn blocks<S: Simd>(panel: *const f32, columns: usize, others: Channels, steps: usize, g: *mut f32) {
    let prefetch = |channel: usize| {
        for i in channel..(channel + TILE).min(others.count) {
            for column in [0, TILE] {
                // SAFETY: a hint.
                unsafe { S::prefetch(g.wrapping_add(i * outer::PANEL + column)) };
            }
        }
    };
    // SAFETY: `count` lines are left of `others` and of `g`.
    unsafe {
        let mut tiles = Tiles::new();
        prefetch(0);
        for channel in (0..others.count).step_by(TILE) {
            let count = TILE.min(others.count - channel);
            prefetch(channel + count);
            tiles.configure(count);
            let a = Lines { at: others.at.add(channel * others.ld), ld: others.ld };
            let b = Lines { at: panel, ld: outer::PANEL };
            let g = Lines { at: g.add(channel * outer::PANEL), ld: outer::PANEL };
            if columns > TILE {
                product::<true>(a, b, steps / TILE, g, true);
            } else {
                product::<false>(a, b, steps / TILE, g, true);
            }
        }
    }
}
