//! Adapters and the device opened on one.

use super::api;
use crate::gpu::cache::CacheFile;
use crate::gpu::{Adapter, AdapterKind, choose, device_error};
use crate::{DeviceError, RunError};
use raygrad_kernels::gpu::{Arena, Half, Limits, Matrices};
use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

/// An open device.
pub struct Gpu {
    pub(super) device: api::Device,
    pub(super) queue: api::Queue,
    adapter: Adapter,
    limits: Limits,
    /// Compiled pipelines, where the API lets them out.
    cache: Option<(CacheFile, api::PipelineCache)>,
    /// The first error nobody was asked about: wgpu reports most of them late.
    failed: Arc<Mutex<Option<String>>>,
}

impl Gpu {
    /// All adapters, in the order that `wgpu:N` counts.
    pub fn list() -> Vec<Adapter> {
        adapters().iter().map(describe).collect()
    }

    /// The adapter numbered `index`, or the best one: dedicated before integrated before virtual before software.
    pub fn open(index: Option<usize>) -> Result<Gpu, DeviceError> {
        Gpu::on(&choose(adapters(), index, |a| kind(a.get_info().device_type))?)
    }

    /// A real GPU, if there is one.
    pub fn auto() -> Option<Gpu> {
        let mut all = adapters();
        all.retain(|a| kind(a.get_info().device_type).is_gpu());
        all.sort_by_key(|a| kind(a.get_info().device_type));
        all.iter().find_map(|a| Gpu::on(a).ok())
    }

    fn on(adapter: &api::Adapter) -> Result<Gpu, DeviceError> {
        let info = describe(adapter);
        let limits = adapter.limits();
        let half = info.half;
        let mut features = api::Features::TIMESTAMP_QUERY | api::Features::PIPELINE_CACHE | api::Features::SHADER_F16;
        let mut experimental = api::ExperimentalFeatures::disabled();
        if half.is_some_and(|h| h.matrices.is_some()) {
            features |= api::Features::SUBGROUP | api::Features::EXPERIMENTAL_COOPERATIVE_MATRIX;
            // SAFETY: of what is experimental, kernels use cooperative matrices alone, where the adapter has them, and a
            // device is asked to use them only after it has passed a test.
            experimental = unsafe { api::ExperimentalFeatures::enabled() };
        }
        let descriptor = api::DeviceDescriptor {
            label: Some("raygrad"),
            required_features: adapter.features() & features,
            required_limits: limits.clone(),
            experimental_features: experimental,
            memory_hints: api::MemoryHints::Performance,
            ..Default::default()
        };
        let (device, queue) = block_on(adapter.request_device(&descriptor))
            .map_err(|e| DeviceError::Adapter { name: info.name.clone(), reason: e.to_string() })?;
        let failed: Arc<Mutex<Option<String>>> = Arc::default();
        let on_error = failed.clone();
        device.on_uncaptured_error(Arc::new(move |e: api::Error| {
            let what = match &e {
                api::Error::OutOfMemory { .. } => "out of memory".to_string(),
                other => other.to_string(),
            };
            note(&on_error, what);
        }));
        let on_loss = failed.clone();
        device.set_device_lost_callback(move |reason, message| {
            if reason != api::DeviceLostReason::Destroyed {
                note(&on_loss, format!("the device was lost: {message}"));
            }
        });
        let limits = Limits {
            max_binding: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
            max_buffers: limits.max_storage_buffers_per_shader_stage,
            max_workgroups: limits.max_compute_workgroups_per_dimension,
            max_workgroup_bytes: limits.max_compute_workgroup_storage_size,
            ..Limits::default()
        };
        let key = api::util::pipeline_cache_key(&adapter.get_info());
        let cache = key.filter(|_| device.features().contains(api::Features::PIPELINE_CACHE)).map(|key| {
            let (file, known) = CacheFile::open(&key);
            let description = api::PipelineCacheDescriptor {
                label: Some("raygrad"),
                data: (!known.is_empty()).then_some(&known),
                fallback: true,
            };
            // SAFETY: the data came out of such a cache (a hash says so), and wgpu refuses those of another driver.
            (file, unsafe { device.create_pipeline_cache(&description) })
        });
        Ok(Gpu { device, queue, adapter: info, limits, cache, failed })
    }

    /// The same device as if it could do no more than `most`: larger buffers then lie in parts, for instance.
    pub fn within(mut self, most: Limits) -> Gpu {
        self.limits = self.limits.within(most);
        self
    }

    pub fn adapter(&self) -> &Adapter {
        &self.adapter
    }

    /// Whether passes can read the device's clock.
    pub(super) fn has_clock(&self) -> bool {
        self.device.features().contains(api::Features::TIMESTAMP_QUERY)
    }

    pub(super) fn cache(&self) -> Option<&api::PipelineCache> {
        self.cache.as_ref().map(|(_, cache)| cache)
    }

    pub(crate) fn limits(&self) -> Limits {
        self.limits
    }

    pub(super) fn problem(&self, problem: String) -> RunError {
        device_error(&self.adapter.name, problem)
    }

    /// The first error since the last check.
    pub(super) fn check(&self) -> Result<(), RunError> {
        match self.failed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(problem) => Err(self.problem(problem)),
            None => Ok(()),
        }
    }

    /// Waits for a submission, or for all.
    pub(super) fn wait(&self, submission_index: Option<api::SubmissionIndex>) -> Result<(), RunError> {
        let poll = api::PollType::Wait { submission_index, timeout: None };
        self.device.poll(poll).map_err(|e| self.problem(e.to_string()))?;
        self.check()
    }

    /// A zeroed device buffer for an arena.
    pub(super) fn buffer(&self, arena: &Arena) -> Result<api::Buffer, RunError> {
        let buffer = self.device.create_buffer(&api::BufferDescriptor {
            label: Some(&arena.name),
            size: arena.bytes(),
            usage: api::BufferUsages::STORAGE | api::BufferUsages::COPY_SRC | api::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.check().map_err(|e| match e {
            RunError::Device { problem, .. } => {
                self.problem(format!("`{}`, {} bytes: {problem}", arena.name, arena.bytes()))
            }
            other => other,
        })?;
        Ok(buffer)
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        if let Some((file, cache)) = &self.cache
            && let Some(pipelines) = cache.get_data()
        {
            file.save(&pipelines);
        }
    }
}

/// What an adapter has for half precision.
fn half(adapter: &api::Adapter) -> Option<Half> {
    let (features, info) = (adapter.features(), adapter.get_info());
    if !features.contains(api::Features::SHADER_F16) {
        return None;
    }
    let needed = api::Features::SUBGROUP | api::Features::EXPERIMENTAL_COOPERATIVE_MATRIX;
    let (f16, f32) = (api::CooperativeScalarType::F16, api::CooperativeScalarType::F32);
    let side = adapter
        .cooperative_matrix_properties()
        .iter()
        .filter(|p| (p.ab_type, p.cr_type) == (f16, f32) && p.m_size == p.n_size && p.m_size == p.k_size)
        .map(|p| p.m_size)
        .max();
    let fixed = info.subgroup_min_size == info.subgroup_max_size;
    let side = side.filter(|_| features.contains(needed) && fixed);
    Some(Half { matrices: side.and_then(|side| Matrices::new(side, info.subgroup_min_size)) })
}

fn note(slot: &Mutex<Option<String>>, what: String) {
    slot.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(what);
}

fn adapters() -> Vec<api::Adapter> {
    let mut descriptor = api::InstanceDescriptor::new_without_display_handle();
    descriptor.flags = api::InstanceFlags::empty();
    let instance = api::Instance::new(descriptor);
    block_on(instance.enumerate_adapters(api::Backends::PRIMARY))
}

fn kind(t: api::DeviceType) -> AdapterKind {
    match t {
        api::DeviceType::DiscreteGpu => AdapterKind::Dedicated,
        api::DeviceType::IntegratedGpu => AdapterKind::Integrated,
        api::DeviceType::VirtualGpu => AdapterKind::Virtual,
        api::DeviceType::Other => AdapterKind::Unknown,
        api::DeviceType::Cpu => AdapterKind::Software,
    }
}

fn describe(adapter: &api::Adapter) -> Adapter {
    let info = adapter.get_info();
    Adapter {
        name: info.name,
        api: info.backend.to_str(),
        kind: kind(info.device_type),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
        half: half(adapter),
    }
}

/// Runs a future of wgpu's: on native backends they are ready at once.
fn block_on<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}
