//! What a GPU does at best, measured once and kept on disk.

use super::AdapterKind;
use super::cache::{CacheFile, kept};
use crate::{Device, Forms, RunError};
use raygrad_compiler::cost::Rates;

/// The device with its rates.
pub(crate) fn measured(device: Device) -> Result<Device, RunError> {
    match device.adapter() {
        Some(adapter) if adapter.kind != AdapterKind::Software => measured_with(device, || CacheFile::open("rates")),
        _ => Ok(device),
    }
}

fn measured_with(device: Device, open: impl Fn() -> (CacheFile, Vec<u8>)) -> Result<Device, RunError> {
    let key = format!("{}\n{:?}", env!("CARGO_PKG_VERSION"), device.adapter());
    let key = blake3::hash(key.as_bytes()).to_hex().to_string();
    let rates = kept(open, &key, read, write, || device.measure_rates())?;
    let forms = Forms { rates, ..device.forms() };
    Ok(device.with_forms(forms))
}

fn write(rates: &Rates) -> String {
    let Rates { gflops, product_gflops, mbytes, launch_ns, workgroups } = rates;
    format!("{gflops} {product_gflops} {mbytes} {launch_ns} {workgroups}")
}

fn read(text: &str) -> Option<Rates> {
    let numbers: Vec<u32> = text.split(' ').map(str::parse).collect::<Result<_, _>>().ok()?;
    let [gflops, product_gflops, mbytes, launch_ns, workgroups] = numbers[..] else { return None };
    let sensible = numbers.iter().all(|n| *n > 0);
    sensible.then_some(Rates { gflops, product_gflops, mbytes, launch_ns, workgroups })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rates are measured once, and what is kept is believed; what no measurement can have written is not.
    #[test]
    fn rates_are_kept() {
        let Some(device) = crate::gpu::expected(Device::vulkan(None).or_else(|_| Device::wgpu(None))) else { return };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rates.bin");
        let open = || CacheFile::at(Some(path.clone()));
        let held = || String::from_utf8(open().1).unwrap();
        let rates = || measured_with(device.clone(), open).unwrap().forms().rates;
        let first = rates();
        let key = held().split(' ').next().unwrap().to_string();
        assert_eq!(held(), format!("{key} {}\n", write(&first)));
        let other = Rates { workgroups: first.workgroups + 1, ..first };
        open().0.save(format!("{key} {}\n", write(&other)).as_bytes());
        assert_eq!(rates(), other);
        open().0.save(format!("{key} 1 2 3 0 5\n").as_bytes());
        assert_ne!(rates().launch_ns, 0);
        assert!(first.product_gflops >= first.gflops && first.launch_ns < 1_000_000_000, "{first:?}");
    }

    #[test]
    fn rates_of_software_are_not_measured() {
        let Some(device) = crate::gpu::expected(Device::vulkan(None).or_else(|_| Device::wgpu(None))) else { return };
        if device.adapter().unwrap().kind == AdapterKind::Software {
            assert_eq!(measured(device).unwrap().forms().rates, Rates::SOFTWARE);
        }
    }
}
