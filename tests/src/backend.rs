//! Running a step on a device and comparing it with the f64 reference.

use crate::worst;
use raygrad_compiler::reference::{Array, Bindings, Data, evaluate};
use raygrad_compiler::scalar::DType;
use raygrad_compiler::{Step, compile};
use raygrad_runtime::{Device, DeviceError, ProgramId, Session};

/// Every device that tests run on.
pub fn devices() -> Vec<Device> {
    let cpu = Device::cpu(Some(2)).unwrap_or_else(|e| panic!("{e}"));
    std::iter::once(cpu).chain(gpus()).collect()
}

/// The devices for tests that compile a hundred kernels or more: on a software driver that takes minutes, so GPUs, and one
/// where networks stay in a workgroup, join only where `RAYGRAD_NIGHTLY=1`.
pub fn devices_for_large_programs() -> Vec<Device> {
    #[cfg(feature = "gpu")]
    let resident = resident(128).into_iter().take(1);
    #[cfg(not(feature = "gpu"))]
    let resident = None;
    devices().into_iter().chain(resident).take(if nightly() { usize::MAX } else { 1 }).collect()
}

/// Whether tests that take minutes run too.
pub fn nightly() -> bool {
    std::env::var_os("RAYGRAD_NIGHTLY").is_some_and(|v| v == "1")
}

/// The best adapter of each backend, which may be software.
pub fn gpus() -> Vec<Device> {
    [wgpu(), vulkan()].into_iter().flatten().collect()
}

/// The best adapter through wgpu; `None` only where `RAYGRAD_NO_GPU=1` says that there is none. It runs the forms of kernels that
/// GPUs run, software or not.
pub fn wgpu() -> Option<Device> {
    unless_none_is_expected(Device::wgpu(None)).map(of_gpus)
}

/// The same through Vulkan.
pub fn vulkan() -> Option<Device> {
    unless_none_is_expected(Device::vulkan(None)).map(of_gpus)
}

#[cfg(feature = "gpu")]
fn of_gpus(device: Device) -> Device {
    device.with_forms(raygrad_runtime::Forms::default())
}
#[cfg(not(feature = "gpu"))]
fn of_gpus(device: Device) -> Device {
    device
}

/// The best adapter through Vulkan with the tiles of drivers in software.
#[cfg(feature = "gpu")]
pub fn software() -> Option<Device> {
    let forms = raygrad_runtime::Forms { tiles: raygrad_kernels::gpu::SOFTWARE_TILES, ..Default::default() };
    Some(vulkan()?.with_forms(forms))
}

/// The best adapter of each backend, where networks of at most so many outputs a layer stay in a workgroup.
#[cfg(feature = "gpu")]
pub fn resident(most: usize) -> Vec<Device> {
    let forms = raygrad_runtime::Forms { resident: most, ..Default::default() };
    gpus().into_iter().map(|d| d.with_forms(forms)).collect()
}

fn unless_none_is_expected(opened: Result<Device, DeviceError>) -> Option<Device> {
    match opened {
        Ok(device) => Some(device),
        Err(DeviceError::NotBuilt(_)) => None,
        Err(e) if std::env::var_os("RAYGRAD_NO_GPU").is_some_and(|v| v == "1") => {
            println!("skipped, RAYGRAD_NO_GPU is set: {e}");
            None
        }
        Err(e) => panic!("{e}; install a Vulkan driver (mesa-vulkan-drivers), or set RAYGRAD_NO_GPU=1 to skip"),
    }
}

/// A session with one program, its inputs bound.
pub fn load(device: &Device, step: &Step, bindings: &Bindings) -> (Session, ProgramId) {
    let program = compile(step, &device.target()).unwrap_or_else(|e| panic!("{e}"));
    let mut session = Session::new(device.clone()).unwrap_or_else(|e| panic!("{e}"));
    let id = session.add(program).unwrap_or_else(|e| panic!("{e}"));
    let names: Vec<String> = session.inputs().map(|(n, _)| n.to_string()).collect();
    for name in names {
        match bindings.get(&name).map(|a| &a.data) {
            Some(Data::F(v)) => session.set(&name, &v.iter().map(|x| *x as f32).collect::<Vec<_>>()),
            Some(Data::U(v)) => session.set_u32(&name, v),
            None => Ok(()),
        }
        .unwrap_or_else(|e| panic!("{e}"));
    }
    (session, id)
}

/// Values of all outputs after one run, in host order.
pub fn run(device: &Device, step: &Step, bindings: &Bindings) -> Vec<Vec<f64>> {
    let (mut session, id) = load(device, step, bindings);
    session.run(id).unwrap_or_else(|e| panic!("{e}"));
    let read = |(name, t): &(String, raygrad_compiler::Tensor)| {
        let lanes = session.read_lanes(id, name).unwrap_or_else(|e| panic!("{e}"));
        let value = |bits: u32| if t.dtype() == DType::F32 { f32::from_bits(bits) as f64 } else { bits as f64 };
        lanes.into_iter().map(value).collect()
    };
    step.outputs.iter().map(read).collect()
}

/// Values of all outputs in the reference.
pub fn reference(step: &Step, bindings: &Bindings) -> Vec<Vec<f64>> {
    let roots: Vec<_> = step.outputs.iter().map(|(_, t)| t.clone()).collect();
    let flat = |a: Array| match a.data {
        Data::F(v) => v,
        Data::U(v) => v.into_iter().map(f64::from).collect(),
    };
    evaluate(&roots, bindings).unwrap_or_else(|e| panic!("{e}")).into_iter().map(flat).collect()
}

/// Rounds every float to f32, so that a device and the reference start from the same numbers.
pub fn round(bindings: &Bindings) -> Bindings {
    let rounded = |a: &Array| match &a.data {
        Data::F(v) => Array::floats(&a.shape, v.iter().map(|x| *x as f32 as f64).collect()),
        Data::U(_) => a.clone(),
    };
    bindings.iter().map(|(k, a)| (k.clone(), rounded(a))).collect()
}

/// Compares every output on `device` with the reference; the error names the worst one.
pub fn compare(device: &Device, step: &Step, bindings: &Bindings, tolerance: f64) -> Result<(), String> {
    let bindings = round(bindings);
    let (found, expected) = (run(device, step, &bindings), reference(step, &bindings));
    for (((name, t), found), expected) in step.outputs.iter().zip(&found).zip(&expected) {
        let error = worst(found, expected, 1e-3);
        if error > tolerance {
            let program = compile(step, &device.target()).map_err(|e| e.to_string())?;
            let head = |v: &[f64]| format!("{:?}", &v[..v.len().min(8)]);
            return Err(format!(
                "`{name}` ({}) is off by {error:.2e} of its largest value\n found    {}\n expected {}\n{program}",
                t.shape(),
                head(found),
                head(expected)
            ));
        }
    }
    Ok(())
}
