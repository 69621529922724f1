//! The CPU backend: tile programs on a thread pool.
//!
//! A launch is cut into chunks of tiles, a number fixed by the program. Each chunk has accumulators of its own, and chunks
//! are summed pairwise in a fixed order, so results are the same bits for any number of threads.

use crate::RunError;
use crate::session::Executor;
use raygrad_compiler::Program;
use raygrad_compiler::fuse::TargetKind;
use raygrad_compiler::plan::BufferKind;
use raygrad_compiler::plan::region::BufferId;
use raygrad_kernels::cpu::tile::{Chunk, Flat, Memory, TileProgram, lower, pack, run_tiles, split_flat};
use raygrad_kernels::cpu::{AlignedVec, Isa, Products, unblock};
use rayon::prelude::*;
use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

/// Lanes of a flat launch that one task works through.
const FLAT_TASK: usize = 16 * 1024;
/// Lanes of a reduction over chunks that one task sums.
const SUM_TASK: usize = 16 * 1024;

thread_local! {
    /// Scratch of this thread, grown to the largest launch that was loaded.
    static SCRATCH: RefCell<AlignedVec> = RefCell::new(AlignedVec::zeroed(0));
}

/// A launch in two parts that do not depend on each other.
struct Launch {
    flats: Vec<Flat>,
    tiles: Option<TileProgram>,
}

struct Loaded {
    launches: Vec<Launch>,
    /// Memory of every buffer, by [`BufferId`]: an index into `CpuExecutor::memory`.
    places: Vec<usize>,
    lanes: Vec<usize>,
    packed: AlignedVec,
    accumulators: AlignedVec,
}

/// Programs on the CPU.
pub(crate) struct CpuExecutor {
    pool: Arc<rayon::ThreadPool>,
    isa: Isa,
    products: Products,
    memory: Vec<AlignedVec>,
    inputs: HashMap<String, (usize, usize)>,
    programs: Vec<Loaded>,
}

impl CpuExecutor {
    pub fn new(pool: Arc<rayon::ThreadPool>, products: Products) -> CpuExecutor {
        CpuExecutor { pool, isa: Isa::detect(), products, memory: vec![], inputs: HashMap::new(), programs: vec![] }
    }

    fn allocate(&mut self, what: &str, lanes: usize) -> Result<usize, RunError> {
        self.memory.push(zeroed(what, lanes)?);
        Ok(self.memory.len() - 1)
    }

    fn input(&self, name: &str) -> Result<(usize, usize), RunError> {
        self.inputs.get(name).copied().ok_or_else(|| RunError::UnknownInput(name.into()))
    }
}

fn zeroed(what: &str, lanes: usize) -> Result<AlignedVec, RunError> {
    let too_large = || RunError::Memory { what: what.into(), bytes: (lanes as u64).saturating_mul(4) };
    AlignedVec::try_zeroed(lanes).ok_or_else(too_large)
}

fn lower_launch(program: &Program, index: usize, products: Products) -> Launch {
    let (flats, rest) = split_flat(program, &program.launches[index].region);
    Launch { flats, tiles: rest.map(|region| lower(program, &region, products)) }
}

impl Executor for CpuExecutor {
    fn add(&mut self, program: Arc<Program>) -> Result<usize, RunError> {
        if program.target.kind != TargetKind::Cpu {
            return Err(RunError::Target(program.target.kind));
        }
        let before = self.memory.len();
        let loaded = self.load(&program);
        self.programs.push(loaded.inspect_err(|_| {
            self.memory.truncate(before);
            self.inputs.retain(|_, (place, _)| *place < before);
        })?);
        Ok(self.programs.len() - 1)
    }

    fn set(&mut self, input: &str, first: usize, lanes: &[u32]) -> Result<(), RunError> {
        let (place, _) = self.input(input)?;
        self.memory[place][first..first + lanes.len()].copy_from_slice(bytemuck::cast_slice(lanes));
        Ok(())
    }

    fn get(&mut self, input: &str) -> Result<Vec<u32>, RunError> {
        let (place, len) = self.input(input)?;
        Ok(bytemuck::cast_slice(&self.memory[place][..len]).to_vec())
    }

    fn run(&mut self, program: usize) -> Result<(), RunError> {
        self.run_each(program, || {});
        Ok(())
    }

    fn profile(&mut self, program: usize) -> Result<Option<Vec<f64>>, RunError> {
        let mut seconds = vec![];
        let mut before = Instant::now();
        self.run_each(program, || {
            let now = Instant::now();
            seconds.push((now - std::mem::replace(&mut before, now)).as_secs_f64());
        });
        Ok(Some(seconds))
    }

    fn output(&mut self, program: usize, buffer: BufferId) -> Result<Vec<u32>, RunError> {
        let loaded = &self.programs[program];
        let (place, lanes) = (loaded.places[buffer.0 as usize], loaded.lanes[buffer.0 as usize]);
        Ok(bytemuck::cast_slice(&self.memory[place][..lanes]).to_vec())
    }
}

impl CpuExecutor {
    /// A program with memory for its buffers; inputs that earlier programs have stay where they are.
    fn load(&mut self, program: &Program) -> Result<Loaded, RunError> {
        let slots = program.slots.iter().map(|lanes| self.allocate("temporary values", *lanes));
        let slots: Vec<usize> = slots.collect::<Result<_, _>>()?;
        let mut places = vec![];
        for buffer in &program.buffers {
            let lanes = buffer.shape.lanes();
            places.push(match &buffer.kind {
                BufferKind::Temporary { slot } => slots[*slot],
                BufferKind::Output => self.allocate(&format!("output `{}`", buffer.label), lanes)?,
                BufferKind::Input { name, .. } => match self.inputs.get(name) {
                    Some((place, _)) => *place,
                    None => {
                        let place = self.allocate(&format!("input `{name}`"), lanes)?;
                        self.inputs.insert(name.clone(), (place, lanes));
                        place
                    }
                },
            });
        }
        let launches: Vec<Launch> =
            (0..program.launches.len()).map(|i| lower_launch(program, i, self.products)).collect();
        let tiles = || launches.iter().filter_map(|l| l.tiles.as_ref());
        let packed = tiles().map(|t| t.packed).max().unwrap_or(0);
        let accumulators = tiles().map(|t| t.accumulated * t.chunks).max().unwrap_or(0);
        let lanes = program.buffers.iter().map(|b| b.shape.lanes()).collect();
        for (launch, planned) in launches.iter().zip(&program.launches) {
            self.reserve(launch, planned)?;
        }
        let (packed, accumulators) = (zeroed("packed weights", packed)?, zeroed("sums of chunks", accumulators)?);
        Ok(Loaded { launches, places, lanes, packed, accumulators })
    }

    /// Has every thread reserve what it needs for a tile: one of a launch with scans along an axis holds all of it.
    fn reserve(&self, launch: &Launch, planned: &raygrad_compiler::plan::Launch) -> Result<(), RunError> {
        let tiles = launch.tiles.as_ref().map_or(0, |t| t.scratch);
        let lanes = launch.flats.iter().map(Flat::scratch).fold(tiles, usize::max);
        let grown = self.pool.broadcast(|_| SCRATCH.with_borrow_mut(|scratch| scratch.try_grow(lanes)));
        if grown.into_iter().all(|grown| grown) {
            return Ok(());
        }
        let line = planned.region.inner.as_ref().filter(|_| planned.region.whole);
        let holds = line.map_or(String::new(), |axis| format!(", which holds all of `{axis}`"));
        let what = format!("a tile of {}{holds}", planned.name);
        Err(RunError::Memory { what, bytes: (lanes as u64).saturating_mul(4) })
    }

    /// Runs all launches; `done` is called after each.
    fn run_each(&mut self, program: usize, mut done: impl FnMut() + Send) {
        let loaded = &mut self.programs[program];
        let buffers: Vec<*mut f32> = loaded.places.iter().map(|p| self.memory[*p].as_mut_ptr()).collect();
        let memory = Memory { buffers: &buffers };
        let isa = self.isa;
        let (packed, accumulators) = (&mut loaded.packed, &mut loaded.accumulators);
        let (launches, lanes) = (&loaded.launches, &loaded.lanes);
        self.pool.install(|| {
            for launch in launches {
                for flat in &launch.flats {
                    run_flat(flat, memory, isa);
                }
                if let Some(tiles) = &launch.tiles {
                    run_launch(tiles, memory, isa, packed, accumulators, lanes);
                }
                done();
            }
        });
    }
}

/// Lanes of scratch, which loading the launch has reserved.
fn with_scratch<T>(lanes: usize, f: impl FnOnce(&mut [f32]) -> T) -> T {
    SCRATCH.with_borrow_mut(|scratch| f(&mut scratch[..lanes]))
}

fn run_flat(flat: &Flat, memory: Memory, isa: Isa) {
    let tasks = flat.width.div_ceil(FLAT_TASK);
    let task = |t: usize| {
        let range = t * FLAT_TASK..((t + 1) * FLAT_TASK).min(flat.width);
        // SAFETY: tasks write disjoint lanes; the addresses are those of this program's buffers.
        with_scratch(flat.scratch(), |scratch| unsafe { flat.run(range, memory, isa, scratch) });
    };
    if tasks == 1 { task(0) } else { (0..tasks).into_par_iter().for_each(task) }
}

fn run_launch(
    tiles: &TileProgram,
    memory: Memory,
    isa: Isa,
    packed: &mut AlignedVec,
    accumulators: &mut AlignedVec,
    lanes: &[usize],
) {
    // Packs are independent stretches of one array.
    let mut rest = &mut packed[..tiles.packed];
    let mut packs = vec![];
    for p in &tiles.packs {
        let (own, others) = rest.split_at_mut(p.len * p.elements);
        packs.push((p, own));
        rest = others;
    }
    let pack_one = |(p, own): (&raygrad_kernels::cpu::tile::Pack, &mut [f32])| {
        let mut p = p.clone();
        p.at = 0;
        // SAFETY: weights are not written during a launch that reads them as weights; `isa` was detected.
        unsafe { pack(&p, isa, memory, own) };
    };
    if tiles.packed > FLAT_TASK {
        packs.into_par_iter().for_each(pack_one)
    } else {
        packs.into_iter().for_each(pack_one)
    }
    if tiles.direct {
        for a in &tiles.accumulators {
            let at = a.buffer.0 as usize;
            // SAFETY: the whole of a buffer that this launch alone writes.
            unsafe { std::slice::from_raw_parts_mut(memory.buffers[at], lanes[at]).fill(a.start()) };
        }
    }
    let packed = &packed[..tiles.packed];
    let run = |c: usize, own: &mut [f32]| {
        if tiles.accumulated > 0 {
            for a in &tiles.accumulators {
                own[a.at..a.at + a.len].fill(a.start());
            }
        }
        with_scratch(tiles.scratch, |scratch| {
            let mut chunk = Chunk { memory, isa, packed, scratch, accumulators: own };
            // SAFETY: chunks write disjoint lanes of the buffers and their own accumulators.
            unsafe { run_tiles(tiles, c, &mut chunk) };
        });
    };
    if tiles.accumulated == 0 {
        let alone = |c: usize| run(c, &mut []);
        if tiles.chunks == 1 {
            alone(0)
        } else {
            (0..tiles.chunks).into_par_iter().for_each(alone)
        }
        return;
    }
    let all = &mut accumulators[..tiles.accumulated * tiles.chunks];
    let own = all.chunks_mut(tiles.accumulated).enumerate();
    if tiles.chunks == 1 {
        own.for_each(|(c, own)| run(c, own));
    } else {
        own.collect::<Vec<_>>().into_par_iter().for_each(|(c, own)| run(c, own));
    }
    combine(tiles, all, memory, lanes);
}

/// Combines the chunks' accumulators pairwise, in an order that depends on their number alone, and stores the result.
fn combine(tiles: &TileProgram, all: &mut [f32], memory: Memory, lanes: &[usize]) {
    let stride = tiles.accumulated;
    let columns = Columns { base: all.as_mut_ptr(), stride };
    let mut tasks = vec![];
    for a in &tiles.accumulators {
        tasks.extend((0..a.len).step_by(SUM_TASK).map(|start| (a, start..(start + SUM_TASK).min(a.len))));
    }
    let tree = |(a, range): (&raygrad_kernels::cpu::tile::Accumulator, std::ops::Range<usize>)| {
        let mut step = 1;
        while step < tiles.chunks {
            for c in (0..tiles.chunks - step).step_by(2 * step) {
                // SAFETY: tasks own disjoint lane ranges of all chunks; the two chunks differ.
                let (to, from) = unsafe { (columns.lanes(c, a.at, &range), columns.lanes(c + step, a.at, &range)) };
                a.combine(to, from);
            }
            step *= 2;
        }
    };
    if tasks.len() == 1 {
        tasks.into_iter().for_each(tree)
    } else {
        tasks.into_par_iter().for_each(tree)
    }
    for a in &tiles.accumulators {
        let at = a.buffer.0 as usize;
        // SAFETY: the whole of a buffer that this launch alone writes.
        let out = unsafe { std::slice::from_raw_parts_mut(memory.buffers[at], lanes[at]) };
        let sum = &all[a.at..a.at + a.len];
        match a.blocked {
            None => out.copy_from_slice(sum),
            Some((k, n, 1)) => unblock(sum, k, n, out, false),
            Some((k, n, elements)) => {
                let mut matrix = vec![0.0; k * n];
                for e in 0..elements {
                    unblock(&sum[e * a.len / elements..], k, n, &mut matrix, false);
                    matrix.iter().enumerate().for_each(|(c, x)| out[c * elements + e] = *x);
                }
            }
        }
    }
}

/// The chunks' accumulators as columns that tasks share by lane ranges.
struct Columns {
    base: *mut f32,
    stride: usize,
}

// SAFETY: tasks touch disjoint lanes, see `combine`.
unsafe impl Sync for Columns {}

impl Columns {
    /// # Safety
    /// No other reference to these lanes is alive, and they lie inside the chunk.
    #[allow(clippy::mut_from_ref, reason = "disjointness is the caller's promise")]
    unsafe fn lanes(&self, chunk: usize, at: usize, range: &std::ops::Range<usize>) -> &mut [f32] {
        let start = chunk * self.stride + at + range.start;
        // SAFETY: as the caller promises.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(start), range.len()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_compiler::{Axis, Shape, Step, Target, Tensor, compile};

    /// A scan holds its whole axis in a tile: one that is too long for that is refused before it runs.
    #[test]
    fn a_line_that_fits_no_memory_is_refused() {
        let sample = Axis::new("sample", 1 << 43);
        let x = Tensor::index(&sample).to_f32() * Tensor::constant(&[1.0; 8]);
        let step = Step { outputs: vec![("sum".into(), x.cumsum(&sample).sum(&[&sample]))], updates: vec![] };
        let pool = Arc::new(rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap());
        let added = CpuExecutor::new(pool, Products::F32).add(Arc::new(compile(&step, &Target::cpu()).unwrap()));
        match added {
            Err(RunError::Memory { what, bytes }) => {
                assert_eq!(what, "a tile of 00_sample_scan_reduce, which holds all of `sample=8796093022208`");
                assert!(bytes > 1 << 47, "{bytes}");
            }
            other => panic!("{other:?}"),
        }
    }

    /// Totals of many lines go straight to their buffer: no chunk has a copy of it.
    #[test]
    fn totals_of_lines_take_no_memory_of_their_own() {
        let (frame, row) = (Axis::new("frame", 5000), Axis::new("row", 8));
        let x = Tensor::data("x", Shape::new(&[&frame, &row], 1));
        let step = Step { outputs: vec![("sum".into(), x.exp().sum(&[&row]))], updates: vec![] };
        let program = Arc::new(compile(&step, &Target::cpu()).unwrap());
        let pool = Arc::new(rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap());
        let mut executor = CpuExecutor::new(pool, Products::F32);
        let id = executor.add(program.clone()).unwrap();
        let loaded = &executor.programs[id];
        assert!(loaded.launches.iter().any(|l| l.tiles.as_ref().is_some_and(|t| t.direct)), "{program}");
        assert_eq!(loaded.accumulators.len(), 0);
        executor.run(id).unwrap();
        let sums = executor.output(id, program.outputs[0].1).unwrap();
        assert!(sums.len() == 5000 && sums.iter().all(|s| f32::from_bits(*s) == 8.0));
    }
}
