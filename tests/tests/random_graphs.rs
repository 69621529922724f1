//! Random graphs on every device against the f64 reference: large ones on the CPU, smaller ones also on the GPU, where a
//! software driver spends its time on compiling kernels.
//!
//! `RAYGRAD_NIGHTLY=1` runs 10 000 of the large ones, `RAYGRAD_GRAPHS=first..end` those of some seeds. A failure prints the smallest
//! recipe found that still fails.

use raygrad_compiler::plan::region::RegionOp;
#[cfg(feature = "gpu")]
use raygrad_compiler::plan::region::{Grain, Region};
use raygrad_compiler::{Program, StepError, Target, compile};
use raygrad_runtime::{Device, Precision};
use raygrad_tests::backend::{devices_for_large_programs, nightly, vulkan, wgpu};
use raygrad_tests::check::{check, check_mixed, same_bits};
use raygrad_tests::graphs::{Recipe, shrink};
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;

/// Large graphs of a run.
fn large() -> u64 {
    if nightly() { 10_000 } else { 1500 }
}

/// Those of them that a software GPU runs, too, at night.
const ON_ALL_DEVICES: u64 = 60;

/// Graphs of a run that are small enough for a software GPU, which takes half a second each.
const SMALL: u64 = 500;

/// Most outputs of a layer that stay in a workgroup.
#[cfg(feature = "gpu")]
const MOST: usize = 128;

/// Those that also run through Vulkan: the kernels are the same as through wgpu.
const THROUGH_VULKAN: u64 = 100;

/// Seeds of the graphs to check.
fn seeds(count: u64) -> Range<u64> {
    match std::env::var("RAYGRAD_GRAPHS") {
        Ok(text) => {
            let (first, end) = text.split_once("..").expect("RAYGRAD_GRAPHS is first..end");
            first.parse().expect("a number")..end.parse().expect("a number")
        }
        Err(_) => 0..count,
    }
}

/// Every other one of them, so that halves run side by side.
fn half(count: u64, half: u64) -> impl Iterator<Item = u64> {
    seeds(count).filter(move |s| s % 2 == half)
}

/// What is wrong with a recipe's graph, panics included.
fn failure(devices: &[Device], recipe: &Recipe) -> Option<String> {
    let all = || {
        let graph = recipe.build();
        match graph.step.check() {
            Err(StepError::Empty) => return Ok(()),
            checked => checked.map_err(|e| e.to_string())?,
        }
        check(devices, &graph.step, &graph.bindings)?;
        let threads = [1, 2].map(|n| Device::cpu(Some(n)).expect("starts threads"));
        same_bits(&threads[0], &threads[1], &graph.step, &graph.bindings)
    };
    match catch_unwind(AssertUnwindSafe(all)) {
        Ok(result) => result.err(),
        Err(_) => Some(PANIC.lock().map_or_else(|e| e.to_string(), |text| text.clone())),
    }
}

/// Message and place of the last panic, which may be a device thread's.
static PANIC: Mutex<String> = Mutex::new(String::new());

fn check_graphs(devices: &[Device], recipe: impl Fn(u64) -> Recipe, seeds: impl Iterator<Item = u64>) {
    let mut failures: Vec<String> = vec![];
    // Panics are failures like others, printed once their graph is small.
    std::panic::set_hook(Box::new(|info| {
        if let Ok(mut text) = PANIC.lock() {
            *text = info.to_string();
        }
    }));
    for seed in seeds {
        let recipe = recipe(seed);
        if failure(devices, &recipe).is_some() {
            let small = shrink(&recipe, |r| failure(devices, r).is_some());
            let text = failure(devices, &small).unwrap_or_default();
            let nodes = raygrad_compiler::graph::topological(small.build().step.roots());
            let nodes: Vec<String> = nodes.iter().map(|t| format!("{t:?}")).collect();
            failures.push(format!("{small:?}\n{}\n{text}", nodes.join("\n")));
            if failures.len() == 5 {
                break;
            }
        }
    }
    let _ = std::panic::take_hook();
    assert!(failures.is_empty(), "{} graphs fail\n{}", failures.len(), failures.join("\n\n"));
}

/// What a test of fusion needs to meet must occur.
#[test]
fn reductions_inside_tiles_occur_often() {
    let holds = |seed: &u64| {
        let step = Recipe::new(*seed).build().step;
        let program = compile(&step, &Target::cpu());
        let insts = |p: &Program| p.launches.iter().flat_map(|l| l.region.body.clone()).collect::<Vec<_>>();
        program.is_ok_and(|p| insts(&p).iter().any(|i| matches!(i.op, RegionOp::RowReduce(_))))
    };
    let found = (0..100).filter(holds).count();
    assert!(found >= 25, "{found} of 100 graphs");
}

#[test]
fn first_half() {
    check_graphs(&[cpu()], Recipe::new, half(large(), 0));
}

#[test]
fn second_half() {
    check_graphs(&[cpu()], Recipe::new, half(large(), 1));
}

/// On every GPU, too, where `RAYGRAD_NIGHTLY=1`.
#[test]
fn large_graphs_on_all_devices() {
    check_graphs(&devices_for_large_programs(), Recipe::new, seeds(ON_ALL_DEVICES));
}

#[test]
fn small_graphs_first_half() {
    check_graphs(&without_vulkan(), Recipe::small, half(SMALL, 0));
}

#[test]
fn small_graphs_second_half() {
    check_graphs(&without_vulkan(), Recipe::small, half(SMALL, 1));
}

/// Products of pairs of bfloat16 on the CPU: what is off by more than their rounding.
#[test]
fn mixed_products() {
    let mixed = cpu().with_precision(Precision::Mixed).unwrap_or_else(|e| panic!("{e}"));
    for seed in seeds(large() / 3) {
        let graph = Recipe::new(seed).build();
        if graph.step.check().is_ok() {
            check_mixed(&mixed, &graph.step, &graph.bindings).unwrap_or_else(|e| panic!("{seed}: {e}"));
        }
    }
}

/// Halves on a GPU.
#[test]
fn small_graphs_in_halves() {
    if let Some(gpu) = vulkan() {
        let mixed = gpu.with_precision(Precision::Mixed).unwrap_or_else(|e| panic!("{e}"));
        for seed in seeds(THROUGH_VULKAN) {
            let graph = Recipe::small(seed).build();
            if graph.step.check().is_ok() {
                check_mixed(&mixed, &graph.step, &graph.bindings).unwrap_or_else(|e| panic!("{seed}: {e}"));
            }
        }
    }
}

fn without_vulkan() -> Vec<Device> {
    std::iter::once(cpu()).chain(wgpu()).collect()
}

fn cpu() -> Device {
    Device::cpu(Some(2)).expect("starts threads")
}

#[test]
fn small_graphs_through_vulkan() {
    let devices: Vec<Device> = vulkan().into_iter().collect();
    check_graphs(&devices, Recipe::small, seeds(THROUGH_VULKAN));
}

/// Networks that stay in a workgroup, of the graphs that have some.
#[cfg(feature = "gpu")]
#[test]
fn networks_in_workgroups() {
    let target = Target { resident: MOST, ..Target::gpu() };
    let has_some = |recipe: fn(u64) -> Recipe, seed: u64| {
        let resident =
            |r: &Region| r.grain == Grain::Tile && r.body.iter().any(|i| matches!(i.op, RegionOp::Linear(_)));
        compile(&recipe(seed).build().step, &target).is_ok_and(|p| p.launches.iter().any(|l| resident(&l.region)))
    };
    let devices: Vec<Device> = raygrad_tests::backend::resident(MOST).into_iter().take(1).collect();
    for (recipe, count) in [
        (Recipe::small as fn(u64) -> Recipe, if nightly() { SMALL } else { 200 }),
        (Recipe::new, if nightly() { 600 } else { 20 }),
    ] {
        let all = seeds(count);
        let least = (all.end - all.start) / 20;
        let found: Vec<u64> = all.filter(|s| has_some(recipe, *s)).collect();
        assert!(found.len() as u64 >= least, "{} of {:?} graphs", found.len(), seeds(count));
        check_graphs(&devices, recipe, found.into_iter());
    }
}
