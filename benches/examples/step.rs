use raygrad::config::Layered;
use raygrad::geometry::Grid;
use raygrad::planar::PlanarModel;
use raygrad_compiler::compile;
use raygrad_kernels::cpu::peak_gflops;
use raygrad_runtime::{Device, Session};
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let mut layered = Layered::load(&args[1]).unwrap();
    layered.set(&format!("data.points_per_patch={}", args[2])).unwrap();
    let threads: usize = args[3].parse().unwrap();
    let settings = layered.settings.clone();
    let grid = Grid { height: 360, width: 480, crop: [180, 180] };
    let model = PlanarModel::new(&settings, grid, raygrad::warps::of_settings(&settings));
    let t = Instant::now();
    let step = model.train_step();
    let recorded = t.elapsed();
    let device = Device::cpu(Some(threads)).unwrap();
    let program = compile(&step, &device.target()).unwrap();
    println!("record {recorded:?} {:?} total {:?}", program.timing, t.elapsed());
    if args.len() > 4 {
        println!("{program}");
    }
    let t = Instant::now();
    let mut session = Session::new(device).unwrap();
    let id = session.add(program).unwrap();
    println!("add {:?}", t.elapsed());
    let mut s = 1u64;
    let names: Vec<_> = session.inputs().map(|(n, i)| (n.to_string(), i.clone())).collect();
    for (name, info) in names {
        if info.shape.dtype == raygrad_compiler::scalar::DType::U32 {
            continue;
        }
        let v: Vec<f32> = (0..info.shape.lanes())
            .map(|_| {
                s = s.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                ((s >> 40) as f32 / 16777216.0 - 0.5) * 0.1
            })
            .collect();
        session.set(&name, &v).unwrap();
        if name.starts_with("adam.bias") {
            session.set(&name, &[1.0]).unwrap();
        }
        if name.starts_with("lr.") {
            session.set(&name, &[1e-4]).unwrap();
        }
        if name.starts_with("adam.v") {
            session.set(&name, &vec![1e-3; v.len()]).unwrap();
        }
    }
    session.run(id).unwrap();
    let flops = model.flops();
    for _ in 0..3 {
        let p0 = peak_gflops(threads, 200.0);
        let mut times = vec![];
        for _ in 0..5 {
            let t = Instant::now();
            session.run(id).unwrap();
            times.push(t.elapsed().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        let p1 = peak_gflops(threads, 200.0);
        println!(
            "{:.4} s  {:.1} GFLOP/s counted {:.1} executed, peak {p0:.0} {p1:.0}: {:.1} %",
            times[2],
            flops / times[2] / 1e9,
            session.program(id).flops() as f64 / times[2] / 1e9,
            100.0 * flops / times[2] / 1e9 / (0.5 * (p0 + p1))
        );
    }
    println!("loss {:?}", session.read(id, "total"));
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    println!("{}", status.lines().find(|l| l.starts_with("VmHWM")).unwrap());
}
