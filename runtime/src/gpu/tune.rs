//! Which tiles, or which of two programs, run a step fastest, by running it.

use super::cache::{CacheFile, kept};
use crate::{Device, Forms, RunError, Session};
use raygrad_compiler::Program;
use raygrad_kernels::gpu::TILES;
use std::time::Instant;

/// Runs of a choice that are timed, after one that is not; the fastest counts.
const ROUNDS: usize = 5;

/// The device with the tiles that run a program fastest.
pub(crate) fn tuned(device: Device, program: &Program) -> Result<Device, RunError> {
    tuned_with(device, program, || CacheFile::open("tuned"))
}

/// The number of the faster of two programs; the second may be one that the device cannot run.
pub(crate) fn faster(device: &Device, programs: &[Program; 2]) -> Result<usize, RunError> {
    let seconds = |i: usize| match seconds(device, &programs[i]) {
        Err(_) if i > 0 => Ok(f64::INFINITY),
        found => found,
    };
    chosen(&key(device, programs), programs.len(), seconds, || CacheFile::open("tuned"))
}

fn tuned_with(device: Device, program: &Program, open: impl Fn() -> (CacheFile, Vec<u8>)) -> Result<Device, RunError> {
    let forms = device.forms();
    let with = |tiles: usize| device.clone().with_forms(Forms { tiles: tiles as u32, ..forms });
    // The key of a device whose tiles are not chosen.
    let key = key(&with(0), std::slice::from_ref(program));
    Ok(with(chosen(&key, TILES as usize, |tiles| seconds(&with(tiles), program), open)?))
}

/// Which of so many choices takes the least seconds, or took when it was asked before.
fn chosen(
    key: &str,
    count: usize,
    seconds: impl Fn(usize) -> Result<f64, RunError>,
    open: impl Fn() -> (CacheFile, Vec<u8>),
) -> Result<usize, RunError> {
    let fastest = || {
        let mut best = (f64::INFINITY, 0);
        for choice in 0..count {
            let seconds = seconds(choice)?;
            if seconds < best.0 {
                best = (seconds, choice);
            }
        }
        Ok(best.1)
    };
    kept(open, key, |text| text.parse().ok().filter(|c| *c < count), usize::to_string, fastest)
}

/// A hash of all that a choice depends on.
fn key(device: &Device, programs: &[Program]) -> String {
    // The backends describe an adapter's driver in different words.
    let mut all = format!("{}\n{:?}\n{:?}\n", env!("CARGO_PKG_VERSION"), device.adapter(), device.forms());
    programs.iter().for_each(|p| all += &p.to_string());
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
        let held = || String::from_utf8(open().1).unwrap();
        let untuned = device.clone().with_forms(Forms { tiles: 0, ..device.forms() });
        let key = |rows: usize| key(&untuned, &[program(rows)]);
        assert_eq!(held(), format!("{} {}\n", key(256), first.tiles));
        // What is kept is believed.
        let other = (first.tiles + 1) % TILES;
        open().0.save(format!("{} {other}\nnonsense\n{} 99\n", key(256), key(128)).as_bytes());
        assert_eq!(tuned_with(device.clone(), &program(256), open).unwrap().forms().tiles, other);
        let second = tuned_with(device.clone(), &program(128), open).unwrap().forms().tiles;
        assert_eq!(held(), format!("{} {other}\n{} {second}\n", key(256), key(128)));
    }

    /// The program that takes less time is chosen, and once.
    #[test]
    fn the_fastest_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tuned.bin");
        let open = || CacheFile::at(Some(path.clone()));
        let asked = std::cell::Cell::new(0);
        let choose = |times: [f64; 3]| {
            let seconds = |i: usize| {
                asked.set(asked.get() + 1);
                Ok(times[i])
            };
            chosen("key", 3, seconds, open).unwrap()
        };
        assert_eq!((choose([3.0, 1.0, 2.0]), asked.get()), (1, 3));
        assert_eq!((choose([1.0, 3.0, 2.0]), asked.get()), (1, 3));
    }
}
