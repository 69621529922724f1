//! Kernels within what WebGPU guarantees, so that browsers and phones can run them, and short enough for drivers to compile.
#![cfg(feature = "gpu")]

use raygrad::config::Layered;
use raygrad::radiance::RadianceModel;
use raygrad::radiance::rays::ImageSize;
use raygrad::warps;
use raygrad_compiler::{Step, Target, compile};
use raygrad_kernels::gpu::{Inputs, Kernel, Limits, TILES, lower};
use raygrad_tests::forms::forms;
use raygrad_tests::planar::Planar;

/// Of a kernel at most, by the standard's defaults. Its default of 8 buffers is that of [`Limits`], which lowering keeps.
const WORKGROUP_BYTES: u32 = 16 << 10;
const INVOCATIONS: u32 = 256;
/// Words of SPIR-V, but for whole networks in one kernel. Software drivers compile 200,000 for minutes.
const LENGTH: usize = 40_000;

/// What a kernel has too much of.
fn excess(kernel: &Kernel, length: Option<usize>) -> Vec<String> {
    let bytes = kernel.workgroup_bytes();
    let mut all = vec![];
    if bytes > WORKGROUP_BYTES {
        all.push(format!("{}: {bytes} bytes of workgroup memory", kernel.name));
    }
    if kernel.workgroup_size > INVOCATIONS {
        all.push(format!("{}: {} invocations", kernel.name, kernel.workgroup_size));
    }
    if let Some(length) = length {
        let words = kernel.spirv().map_or_else(|e| panic!("{e}"), |words| words.len());
        if words > length {
            all.push(format!("{}: {words} words of SPIR-V", kernel.name));
        }
    }
    if kernel.workgroups.iter().any(|n| *n > Limits::default().max_workgroups) {
        all.push(format!("{}: {:?} workgroups", kernel.name, kernel.workgroups));
    }
    all
}

fn check(name: &str, step: &Step) {
    let layered = Target::gpu();
    let program = |target: Target| compile(step, &target).unwrap_or_else(|e| panic!("{name}: {e}"));
    let programs = [program(layered), program(layered.with_resident(step))];
    let layers = (0..TILES).map(|tiles| (tiles, &programs[0], Some(LENGTH)));
    for (tiles, program, length) in layers.chain([(0, &programs[1], None)]) {
        let limits = Limits { tiles, ..Limits::default() };
        let lowered = lower(program, &mut Inputs::default(), &limits);
        let lowered = lowered.unwrap_or_else(|e| panic!("{name}, tiles {tiles}: {e}"));
        let kernels: Vec<&Kernel> = lowered.launches.iter().flat_map(|l| &l.kernels).collect();
        assert!(!kernels.is_empty());
        let found: Vec<String> = kernels.into_iter().flat_map(|k| excess(k, length)).collect();
        assert!(found.is_empty(), "{name}, tiles {tiles}\n{}", found.join("\n"));
    }
}

#[test]
fn every_form() {
    for (name, step) in forms() {
        check(name, &step);
    }
}

#[test]
fn planar_steps() {
    for preset in ["planar-l2g", "planar-barf", "planar-inn", "planar-multi-inn"] {
        check(preset, &Planar::new(preset, &["data.points_per_patch=4096"]).model.train_step());
    }
}

#[test]
fn steps_in_space() {
    for preset in ["l2g-blender", "barf-llff", "inn-llff", "garf-llff", "nerf-blender-repr"] {
        let model = model(preset, &[]);
        for step in [model.train_step(), model.view(64), model.refinement()] {
            check(preset, &step);
        }
    }
}

/// With checks of all gradients and updates that the outcome decides, over networks narrow and wide.
#[test]
fn steps_in_mixed_precision() {
    let narrow = ["field.layers=[16,16]", "warp.layers=[16,16]", "warp.skip=[]", "radiance.skip=[]"];
    for set in [&[][..], &narrow] {
        check("l2g-blender", &model("l2g-blender", &[set, &["run.precision=mixed"]].concat()).train_step());
    }
}

fn model(preset: &str, set: &[&str]) -> RadianceModel {
    let mut layered = Layered::load(preset).unwrap_or_else(|e| panic!("{e}"));
    for setting in ["train.rays=120"].iter().chain(set) {
        layered.set(setting).unwrap_or_else(|e| panic!("{e}"));
    }
    let warp = warps::of_settings(&layered.settings, 20);
    let size = ImageSize { height: 20, width: 20 };
    RadianceModel::new(&layered.settings, size, 20, warp).unwrap_or_else(|e| panic!("{preset}: {e}"))
}
