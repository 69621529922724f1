//! One layer with bias and rectifier, forwards and backwards, launch by launch, on a GPU: what changes to the kernels of
//! matrix products move, without a whole model around them.
//!
//! usage: layer ROWS INPUTS OUTPUTS [--device wgpu|vulkan] [--precision f32|mixed]

use anyhow::{Context, ensure};
use clap::{Parser, ValueEnum};
use raygrad_benches::median;
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};
use raygrad_runtime::{Device, Precision, Session};

#[derive(Parser)]
struct Args {
    rows: usize,
    inputs: usize,
    outputs: usize,
    #[arg(long, default_value = "vulkan")]
    device: Backend,
    #[arg(long, default_value = "f32")]
    precision: Stored,
}

#[derive(Clone, Copy, ValueEnum)]
enum Backend {
    Wgpu,
    Vulkan,
}

#[derive(Clone, Copy, ValueEnum)]
enum Stored {
    F32,
    Mixed,
}

/// Profiled runs, after one that is not.
const ROUNDS: usize = 7;

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    ensure!(args.rows.min(args.inputs).min(args.outputs) > 0, "rows, inputs and outputs are numbers from 1 on");
    let device = match args.device {
        Backend::Wgpu => Device::wgpu(None),
        Backend::Vulkan => Device::vulkan(None),
    };
    let device = device?.with_precision(match args.precision {
        Stored::F32 => Precision::F32,
        Stored::Mixed => Precision::Mixed,
    })?;
    // A narrow layer before it, so that its input lies in memory as the device stores it.
    let row = Axis::new("row", args.rows);
    let input = |name: &str, shape: Shape| Tensor::input(name, Role::State, shape);
    let (x, first) = (input("x", Shape::new(&[&row], 4)), input("first", Shape::new(&[], (4, args.inputs))));
    let (w, b) = (input("w", Shape::new(&[], (args.inputs, args.outputs))), input("b", Shape::new(&[], args.outputs)));
    let y = (x.linear(&first).relu().linear(&w) + &b).relu();
    let loss = (&y * &y).sum_channels().sum(&[&row]);
    let gradients = grad(&loss, &[&first, &w, &b]);
    let outputs = ["first", "w", "b"].iter().map(|n| n.to_string()).zip(gradients).collect();
    let program = compile(&Step { outputs, updates: vec![] }, &device.target())?;
    let mut session = Session::new(device.clone())?;
    let id = session.add(program)?;
    let lanes: Vec<(String, usize)> = session.inputs().map(|(n, i)| (n.to_string(), i.shape.lanes())).collect();
    for (name, lanes) in lanes {
        let values: Vec<f32> = (0..lanes).map(|i| ((i * 7919 + 13) % 1009) as f32 * 2e-4 - 0.1).collect();
        session.set(&name, &values)?;
    }
    session.run(id)?;
    let mut runs = vec![];
    for _ in 0..ROUNDS {
        runs.push(session.profile(id)?.context("the device has no clock")?);
    }
    println!("{}, {:?}", device.name(), device.half());
    let launches = session.program(id).launches.iter().enumerate();
    for (i, launch) in launches {
        let seconds = median(&runs.iter().map(|r| r[i]).collect::<Vec<_>>());
        println!(
            "{:28} {:8.1} us {:8.1} TFLOP/s",
            launch.name,
            1e6 * seconds,
            launch.region.flops() as f64 / seconds * 1e-12
        );
    }
    Ok(())
}
