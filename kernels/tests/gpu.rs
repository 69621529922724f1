//! Every op's kernels, forward and backward: valid naga modules, WGSL that parses again, SPIR-V that `spirv-val` accepts.
#![cfg(feature = "gpu")]

use raygrad_compiler::autodiff::grad;
use raygrad_compiler::graph::{Axes, Axis, Shape, Tensor};
use raygrad_compiler::ops::pick::concat;
use raygrad_compiler::ops::registry;
use raygrad_compiler::plan::{BufferKind, Program};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, Target, compile};
use raygrad_kernels::gpu::{Access, ArenaId, Half, Inputs, Kernel, Limits, Matrices, Storage, groups, lower, storages};
use raygrad_tests::MidGraph;
use std::io::Write;
use std::process::{Command, Stdio};

/// Kernels of the sample's output, loss and gradients.
fn kernels(graph: &MidGraph, name: &str) -> Vec<Kernel> {
    let wanted: Vec<&Tensor> = graph.parameters.iter().collect();
    let mut outputs = vec![("output".to_string(), graph.output.clone()), ("loss".into(), graph.loss.clone())];
    let gradients = grad(&graph.loss, &wanted);
    outputs.extend(gradients.into_iter().enumerate().map(|(i, g)| (format!("gradient {i}"), g)));
    let step = Step { outputs, updates: vec![] };
    let program = compile(&step, &Target::gpu()).unwrap_or_else(|e| panic!("{name}: {e}"));
    lowered(&program, &Limits::default(), name)
}

fn lowered(program: &Program, limits: &Limits, name: &str) -> Vec<Kernel> {
    let lowered = lower(program, &mut Inputs::default(), limits);
    let lowered = lowered.unwrap_or_else(|e| panic!("{name}: {e}\n{program}"));
    lowered.launches.into_iter().flat_map(|l| l.kernels).collect()
}

fn each(f: impl Fn(&str, &Kernel)) {
    for sample in registry() {
        for kernel in kernels(&MidGraph::new(&sample), &sample.name) {
            f(&sample.name, &kernel);
        }
    }
}

/// A network's step, wide enough for every kind of matrix product, and narrow enough in the end for what is not stored as
/// halves.
fn network() -> Program {
    let row = Axis::new("row", 40_000);
    let x = Tensor::data("x", Shape::new(&[&row], 63));
    let weight = |name: &str, rows: usize, columns: usize| Tensor::parameter(name, Shape::new(&[], (rows, columns)));
    let all =
        [weight("a", 63, 256), weight("b", 319, 128), weight("c", 128, 20), weight("d", 20, 8), weight("e", 8, 3)];
    let biases = [("bias of a", 256), ("bias of b", 128)].map(|(n, c)| Tensor::parameter(n, Shape::new(&[], c)));
    let hidden = (x.linear(&all[0]) + &biases[0]).relu();
    let wide = (concat([&hidden, &x]).linear(&all[1]) + &biases[1]).relu();
    let y = wide.linear(&all[2]).relu().linear(&all[3]).relu().linear(&all[4]);
    let loss = (&y * &y).sum_channels().sum(&[&row]);
    let all: Vec<&Tensor> = all.iter().chain(&biases).collect();
    let names = all.iter().map(|t| t.input_name().unwrap_or_default().to_string());
    let outputs = names.zip(grad(&loss, &all)).collect();
    compile(&Step { outputs, updates: vec![] }, &Target::gpu()).unwrap_or_else(|e| panic!("{e}"))
}

/// What devices have for half precision: storing it, and matrices as large as NVIDIA's and as small as a software driver's.
fn halves() -> [Half; 3] {
    let matrices = |side, subgroup| Half { matrices: Some(Matrices { side, subgroup }) };
    [Half { matrices: None }, matrices(16, 32), matrices(8, 8)]
}

/// Tiles are made for matrices of 8 and 16, and for subgroups of which a workgroup holds at least four; of matrices of 8 it would
/// hold 16.
#[test]
fn matrices_that_no_tile_is_made_for_are_not_used() {
    for (side, subgroup) in [(8, 4), (8, 8), (8, 16), (16, 32), (16, 64)] {
        assert_eq!(Matrices::new(side, subgroup), Some(Matrices { side, subgroup }));
    }
    for (side, subgroup) in [(4, 32), (32, 32), (16, 128), (8, 2), (8, 32), (8, 64), (16, 48), (16, 0)] {
        assert_eq!(Matrices::new(side, subgroup), None, "{side}, {subgroup}");
    }
}

#[test]
fn kernels_in_half_precision_keep_to_the_limits() {
    let program = network();
    for half in halves() {
        for max_workgroup_bytes in [16 << 10, 32 << 10, 48 << 10] {
            let limits = Limits { half: Some(half), max_workgroup_bytes, ..Limits::default() };
            let kernels = lowered(&program, &limits, "network");
            let mut multiply = 0;
            for kernel in &kernels {
                let what = format!("{half:?}, {}", kernel.name);
                let wgsl = kernel.wgsl().unwrap_or_else(|e| panic!("{what}: {e}"));
                assert!(kernel.spirv().is_ok_and(|words| words.len() > 5), "{what}");
                assert!(kernel.workgroup_size <= 256, "{what}");
                multiply += usize::from(wgsl.contains("coopMultiplyAdd"));
                assert!(kernel.workgroup_bytes() <= max_workgroup_bytes, "{what}: {} bytes", kernel.workgroup_bytes());
            }
            // Two layers forwards, two backwards, and two gradients of weights. No tile of matrices fits into 16 KiB.
            let fit = half.matrices.is_some() && max_workgroup_bytes > 16 << 10;
            assert_eq!(multiply, if fit { 6 } else { 0 }, "{half:?}");
        }
    }
}

/// Work is cut into as many workgroups as the device is said to need, for layers and for sums over rows.
#[test]
fn work_is_cut_for_the_processors_of_a_device() {
    let program = network();
    let count = |workgroups: u32, name: &str| {
        let limits = Limits { workgroups, ..Limits::default() };
        let kernels = lowered(&program, &limits, "network").into_iter().filter(|k| k.name.ends_with(name));
        kernels.map(|k| k.workgroups.iter().product::<u32>()).max().unwrap_or(0)
    };
    for name in ["row_layers", "row_copy_reduce"] {
        let (few, many) = (count(4, name), count(4096, name));
        assert!(0 < few && few < many, "{name}: {few}, {many}");
    }
}

/// Tiles of 128 x 256 for a weight gradient with 319 inputs and 256 outputs: three, with the inputs along m, where the other way
/// round there would be four; and in chunks that give each processor one.
#[test]
fn weight_gradients_are_turned_where_tiles_fit_better() {
    let row = Axis::new("row", 128_000);
    let [x, d] = [("x", 319), ("d", 256)].map(|(n, channels)| Tensor::data(n, Shape::new(&[&row], channels)));
    let step = Step { outputs: vec![("product".into(), x.outer(&d, &Axes::none()))], updates: vec![] };
    let program = compile(&step, &Target::gpu()).unwrap_or_else(|e| panic!("{e}"));
    let half = Some(halves()[1]);
    let limits = Limits { half, max_workgroup_bytes: 48 << 10, workgroups: 132, ..Limits::default() };
    let kernels = lowered(&program, &limits, "outer");
    let found: Vec<u32> = kernels.iter().map(|k| k.workgroups.iter().product()).collect();
    assert_eq!(found[0], 3 * 44, "{:?}", kernels.iter().map(|k| &k.name).collect::<Vec<_>>());
}

/// A layer of few terms is computed where a wide one is that it is added to, unless it is needed for itself.
#[test]
fn little_layers_are_computed_beside_wide_ones() {
    let row = Axis::new("row", 1000);
    let layers = |terms: usize, needed: bool| {
        let weight = |name: &str, rows: usize| Tensor::parameter(name, Shape::new(&[], (rows, 64)));
        let data = |name: &str, channels: usize| Tensor::data(name, Shape::new(&[&row], channels));
        let little = data("few", terms).linear(&weight("v", terms));
        let y = (data("many", 40).linear(&weight("w", 40)) + &little).relu();
        let mut outputs = vec![("y".to_string(), y)];
        outputs.extend(needed.then(|| ("little".into(), little)));
        let program = compile(&Step { outputs, updates: vec![] }, &Target::gpu()).unwrap_or_else(|e| panic!("{e}"));
        let kernels = lowered(&program, &Limits::default(), "layers");
        assert!(kernels.len() == 1 || kernels.iter().all(|k| k.name.ends_with("_layer")), "{program}");
        kernels.len()
    };
    let cases = [(1, false), (4, false), (5, false), (1, true)];
    assert_eq!(cases.map(|(terms, needed)| layers(terms, needed)), [1, 1, 2, 2]);
}

/// What lies between launches is stored as halves where a product reads it, and nothing else is.
#[test]
fn halves_are_what_products_read() {
    let program = network();
    for (buffer, storage) in program.buffers.iter().zip(storages(&program, true)) {
        let wide = buffer.shape.channels.count() >= 16 && buffer.shape.dtype == DType::F32;
        let half = matches!(buffer.kind, BufferKind::Temporary { .. }) && wide;
        assert_eq!(storage == Storage::F16, half, "{}: {storage:?}", buffer.label);
    }
    assert!(storages(&program, false).iter().all(|s| *s != Storage::F16));
}

#[test]
fn groups_keep_the_order_of_kernels_that_conflict() {
    let kernels = lowered(&network(), &Limits::default(), "network");
    let groups = groups(&kernels);
    let group_of = |kernel: usize| groups.iter().position(|g| g.contains(&kernel)).expect("every kernel has a group");
    let mut together = false;
    for (later, b) in kernels.iter().enumerate() {
        for (earlier, a) in kernels[..later].iter().enumerate() {
            let clash = |x: &Access, y: &Access| {
                let overlap = x.lanes.start.max(y.lanes.start) < x.lanes.end.min(y.lanes.end);
                x.arena == y.arena && overlap && (x.write || y.write)
            };
            let conflict = a.accesses.iter().any(|x| b.accesses.iter().any(|y| clash(x, y)));
            assert!(!conflict || group_of(earlier) < group_of(later), "{} and {}", a.name, b.name);
            together |= group_of(earlier) == group_of(later);
        }
    }
    assert_eq!(groups.iter().map(Vec::len).sum::<usize>(), kernels.len());
    assert!(together, "a weight gradient and the gradient before it need not wait for each other");
}

/// The column that 257 have beyond the largest tiles gets a kernel of its own where rows are many, and none where a kernel takes
/// longer to start than to compute it.
#[test]
fn few_columns_are_computed_apart_where_that_pays() {
    let count = |rows: usize| {
        let row = Axis::new("row", rows);
        let data = |name: &str, channels: usize| Tensor::data(name, Shape::new(&[&row], channels));
        let w = Tensor::parameter("w", Shape::new(&[], (256, 257)));
        let outputs = vec![
            ("y".into(), data("x", 256).linear(&w)),
            ("dw".into(), data("x", 256).outer(&data("d", 257), &Axes::none())),
        ];
        let program = compile(&Step { outputs, updates: vec![] }, &Target::gpu()).unwrap_or_else(|e| panic!("{e}"));
        let kernels = lowered(&program, &Limits::default(), "257 columns");
        kernels.iter().filter(|k| !k.name.ends_with("finish")).count()
    };
    assert_eq!([count(1000), count(100_000)], [2, 4]);
}

/// Launches that use scratch memory need not wait for each other because of it, as the gradients of a layer's weights and of its
/// inputs.
#[test]
fn launches_have_scratch_memory_of_their_own() {
    let program = lower(&network(), &mut Inputs::default(), &Limits::default()).unwrap_or_else(|e| panic!("{e}"));
    let is_scratch = |arena: ArenaId| match arena {
        ArenaId::Own(i) => program.arenas[i].name.starts_with("scratch"),
        ArenaId::Input(_) | ArenaId::Workgroup => false,
    };
    let launches = program.launches.iter().enumerate();
    let launch_of: Vec<usize> = launches.flat_map(|(i, l)| l.kernels.iter().map(move |_| i)).collect();
    let kernels: Vec<Kernel> = program.launches.iter().flat_map(|l| l.kernels.clone()).collect();
    let writes = |k: &usize| kernels[*k].accesses.iter().any(|a| a.write && is_scratch(a.arena));
    let together = groups(&kernels).into_iter().filter(|group| {
        let mut launches: Vec<usize> = group.iter().filter(|k| writes(k)).map(|k| launch_of[*k]).collect();
        launches.dedup();
        launches.len() > 1
    });
    assert!(together.count() > 1, "kernels of every launch wait for those of the one before");
}

#[test]
fn wgsl_parses_again() {
    each(|sample, kernel| {
        let wgsl = kernel.wgsl().unwrap_or_else(|e| panic!("{sample}: {e}"));
        let parsed = naga::front::wgsl::parse_str(&wgsl);
        parsed.unwrap_or_else(|e| panic!("{sample}, {}: {}\n{wgsl}", kernel.name, e.emit_to_string(&wgsl)));
    });
}

#[test]
fn kernels_fit_what_every_device_has() {
    each(|sample, kernel| {
        assert!(kernel.bindings.len() <= 8, "{sample}, {}: {:?}", kernel.name, kernel.bindings);
        assert!(kernel.workgroup_size <= 256, "{sample}, {}", kernel.name);
        assert!(kernel.workgroups.iter().all(|n| (1..=65535).contains(n)), "{sample}, {}", kernel.name);
    });
}

#[test]
fn spirv_is_valid() {
    let installed = Command::new("spirv-val").arg("--version").output().is_ok();
    each(|sample, kernel| {
        let words = kernel.spirv().unwrap_or_else(|e| panic!("{sample}: {e}"));
        assert!(words.len() > 5, "{sample}, {}", kernel.name);
        if !installed {
            return;
        }
        let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
        let mut check = Command::new("spirv-val")
            .args(["--target-env", "vulkan1.1", "-"])
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("spirv-val starts");
        check.stdin.take().expect("a pipe").write_all(&bytes).expect("spirv-val reads");
        let result = check.wait_with_output().expect("spirv-val ends");
        let text = String::from_utf8_lossy(&result.stdout).into_owned() + &String::from_utf8_lossy(&result.stderr);
        assert!(result.status.success(), "{sample}, {}: {text}", kernel.name);
    });
}
