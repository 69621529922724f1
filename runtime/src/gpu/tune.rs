//! Which tiles run a program fastest, by running it.

use super::cache::CacheFile;
use crate::{Device, Forms, RunError, Session};
use raygrad_compiler::Program;
use raygrad_kernels::gpu::TILES;
use std::time::Instant;

/// Results that are kept; the oldest go first.
const KEPT: usize = 512;
/// Runs of a choice that are timed, after one that is not; the fastest counts.
const ROUNDS: usize = 5;

pub(crate) fn tuned(device: Device, program: &Program) -> Result<Device, RunError> {
    tuned_with(device, program, || CacheFile::open("tuned"))
}

fn tuned_with(device: Device, program: &Program, open: impl Fn() -> (CacheFile, Vec<u8>)) -> Result<Device, RunError> {
    let key = key(&device, program);
    let forms = device.forms();
    if let Some(tiles) = choices(&open().1).into_iter().find(|c| c.0 == key).map(|c| c.1) {
        return Ok(device.with_forms(Forms { tiles, ..forms }));
    }
    let mut best = (f64::INFINITY, 0);
    for tiles in 0..TILES {
        let seconds = seconds(&device.clone().with_forms(Forms { tiles, ..forms }), program)?;
        if seconds < best.0 {
            best = (seconds, tiles);
        }
    }
    // Others may have added theirs in the meantime.
    let (file, held) = open();
    let mut all = choices(&held);
    all.retain(|c| c.0 != key);
    all.push((key, best.1));
    let first = all.len().saturating_sub(KEPT);
    let lines: String = all[first..].iter().map(|(key, tiles)| format!("{key} {tiles}\n")).collect();
    file.save(lines.as_bytes());
    Ok(device.with_forms(Forms { tiles: best.1, ..forms }))
}

/// Lines of a key and a choice.
fn choices(held: &[u8]) -> Vec<(String, u32)> {
    let one = |line: &str| {
        let (key, tiles) = line.split_once(' ')?;
        Some((key.to_string(), tiles.parse().ok().filter(|t| *t < TILES)?))
    };
    String::from_utf8_lossy(held).lines().filter_map(one).collect()
}

/// A hash of all that the choice depends on.
fn key(device: &Device, program: &Program) -> String {
    // The backends describe an adapter's driver in different words.
    let (version, half) = (env!("CARGO_PKG_VERSION"), device.half());
    let all = format!("{version}\n{:?}\n{half:?}\n{program}", device.adapter());
    blake3::hash(all.as_bytes()).to_hex().to_string()
}

/// Seconds of a whole run, by the host's clock: by the device's, launches would wait for each other. Inputs are zeros, on
/// which a run takes as long as on others.
fn seconds(device: &Device, program: &Program) -> Result<f64, RunError> {
    let mut session = Session::new(device.clone())?;
    let id = session.add(program.clone())?;
    let smallest = session.inputs().min_by_key(|(_, info)| info.shape.lanes()).map(|(name, _)| name.to_string());
    let mut best = f64::INFINITY;
    for round in 0..=ROUNDS {
        let begun = Instant::now();
        session.run(id)?;
        // Reading waits.
        if let Some(input) = &smallest {
            session.get_lanes(input)?;
        }
        if round > 0 {
            best = best.min(begun.elapsed().as_secs_f64());
        }
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};

    /// A choice is made once for a program and kept; another program has one of its own, and damaged lines count as none.
    #[test]
    fn choices_are_kept_by_program() {
        let Some(device) = crate::gpu::expected(Device::vulkan(None).or_else(|_| Device::wgpu(None))) else { return };
        let program = |rows: usize| {
            let x = Tensor::data("x", Shape::new(&[&Axis::new("row", rows)], 40));
            let y = x.linear(&Tensor::parameter("w", Shape::new(&[], (40, 70))));
            compile(&Step { outputs: vec![("y".into(), y)], updates: vec![] }, &device.target()).unwrap()
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tuned.bin");
        let open = || CacheFile::at(Some(path.clone()));
        let first = tuned_with(device.clone(), &program(256), open).unwrap().forms();
        let held = choices(&open().1);
        assert_eq!(held, [(key(&device, &program(256)), first.tiles)]);
        // What is kept is believed.
        let other = (first.tiles + 1) % TILES;
        open().0.save(format!("{} {other}\nnonsense\n{} 99\n", held[0].0, key(&device, &program(128))).as_bytes());
        assert_eq!(tuned_with(device.clone(), &program(256), open).unwrap().forms().tiles, other);
        tuned_with(device.clone(), &program(128), open).unwrap();
        assert_eq!(choices(&open().1).len(), 2);
    }
}
