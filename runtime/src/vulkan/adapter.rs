//! Adapters and the device opened on one.

use super::instance::Instance;
use crate::gpu::cache::CacheFile;
use crate::gpu::{Adapter, AdapterKind, choose, device_error};
use crate::{DeviceError, RunError};
use ash::{khr, vk};
use gpu_allocator::AllocationSizes;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use raygrad_kernels::gpu::{Half, Limits, Matrices};
use std::ffi::CStr;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Memory is taken from the driver in blocks of this size, larger buffers by themselves.
const DEVICE_BLOCK: u64 = 32 << 20;
const HOST_BLOCK: u64 = 8 << 20;

/// An open device.
pub struct Gpu {
    pub(super) device: ash::Device,
    pub(super) family: u32,
    /// Null where the driver has none.
    pub(super) cache: vk::PipelineCache,
    cache_file: CacheFile,
    queue: Mutex<vk::Queue>,
    /// `None` only while the device goes.
    allocator: Mutex<Option<Allocator>>,
    adapter: Adapter,
    limits: Limits,
    clock: Option<Clock>,
    instance: Instance,
}

/// How the device counts time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    pub seconds_per_tick: f64,
    /// Valid bits of a count; it starts again from zero after them.
    pub mask: u64,
}

impl Gpu {
    /// All adapters, in the order that `vulkan:N` counts. Without a Vulkan loader there are none.
    pub fn list() -> Vec<Adapter> {
        let Ok(instance) = Instance::new() else { return vec![] };
        physical_devices(&instance).into_iter().map(|p| describe(&instance, p)).collect()
    }

    /// The adapter numbered `index`, or the best one: dedicated before integrated before virtual before software.
    pub fn open(index: Option<usize>) -> Result<Gpu, DeviceError> {
        let instance = Instance::new()?;
        let all = physical_devices(&instance);
        let physical = choose(all, index, |p| kind(&properties(&instance, *p)))?;
        Gpu::on(instance, physical)
    }

    /// A real GPU, if there is one.
    pub fn auto() -> Option<Gpu> {
        let instance = Instance::new().ok()?;
        let mut all = physical_devices(&instance);
        all.retain(|p| kind(&properties(&instance, *p)).is_gpu());
        let physical = choose(all, None, |p| kind(&properties(&instance, *p))).ok()?;
        Gpu::on(instance, physical).ok()
    }

    fn on(instance: Instance, physical: vk::PhysicalDevice) -> Result<Gpu, DeviceError> {
        let adapter = describe(&instance, physical);
        let refused = |reason: String| DeviceError::Adapter { name: adapter.name.clone(), reason };
        let vulkan = |e: vk::Result| refused(describe_result(e));
        let raw = &instance.raw;
        // SAFETY: the physical device belongs to the instance, and every handle made here is used while the device lives.
        unsafe {
            let families = raw.get_physical_device_queue_family_properties(physical);
            let computes = families.iter().position(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE));
            let family = computes.ok_or_else(|| refused("it cannot compute".into()))? as u32;
            let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&[1.0])];
            // A driver on top of another API wants to hear that we know.
            let known = raw.enumerate_device_extension_properties(physical).map_err(vulkan)?;
            let portability = khr::portability_subset::NAME;
            let knows = |name: &CStr| known.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
            let mut extensions: Vec<_> = knows(portability).then_some(portability.as_ptr()).into_iter().collect();
            // Modules of halves declare both kinds of access.
            let mut stored = vk::PhysicalDevice16BitStorageFeatures::default()
                .storage_buffer16_bit_access(true)
                .uniform_and_storage_buffer16_bit_access(true);
            let mut computed = vk::PhysicalDeviceShaderFloat16Int8Features::default().shader_float16(true);
            let mut multiplied = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
            let mut model = vk::PhysicalDeviceVulkanMemoryModelFeatures::default()
                .vulkan_memory_model(true)
                .vulkan_memory_model_device_scope(true);
            let mut description = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
            if let Some(half) = adapter.half {
                extensions.push(khr::shader_float16_int8::NAME.as_ptr());
                description = description.push_next(&mut stored).push_next(&mut computed);
                if half.matrices.is_some() {
                    extensions
                        .extend([khr::cooperative_matrix::NAME, khr::vulkan_memory_model::NAME].map(CStr::as_ptr));
                    description = description.push_next(&mut multiplied).push_next(&mut model);
                }
            }
            let description = description.enabled_extension_names(&extensions);
            let device = raw.create_device(physical, &description, None).map_err(vulkan)?;
            let queue = device.get_device_queue(family, 0);
            let bits = families[family as usize].timestamp_valid_bits;
            let mut most = vk::PhysicalDeviceMaintenance3Properties::default();
            let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut most);
            raw.get_physical_device_properties2(physical, &mut properties);
            let properties = properties.properties;
            let limits = Limits {
                max_binding: most.max_memory_allocation_size.min(properties.limits.max_storage_buffer_range as u64),
                max_buffers: properties.limits.max_per_stage_descriptor_storage_buffers,
                max_workgroups: properties.limits.max_compute_work_group_count[0],
                max_workgroup_bytes: properties.limits.max_compute_shared_memory_size,
                ..Limits::default()
            };
            let clock = (bits > 0).then(|| Clock {
                seconds_per_tick: 1e-9 * f64::from(properties.limits.timestamp_period),
                mask: u64::MAX >> (64 - bits.min(64)),
            });
            let allocator = Allocator::new(&AllocatorCreateDesc {
                instance: raw.clone(),
                device: device.clone(),
                physical_device: physical,
                debug_settings: Default::default(),
                buffer_device_address: false,
                allocation_sizes: AllocationSizes::new(DEVICE_BLOCK, HOST_BLOCK),
            });
            let allocator = match allocator {
                Ok(allocator) => allocator,
                Err(e) => {
                    device.destroy_device(None);
                    return Err(refused(e.to_string()));
                }
            };
            let id: String = properties.pipeline_cache_uuid.iter().map(|b| format!("{b:02x}")).collect();
            let (cache_file, known) = CacheFile::open(&format!("vulkan-{id}"));
            let description = vk::PipelineCacheCreateInfo::default().initial_data(&known);
            let cache = device.create_pipeline_cache(&description, None).unwrap_or_default();
            Ok(Gpu {
                cache,
                cache_file,
                queue: Mutex::new(queue),
                allocator: Mutex::new(Some(allocator)),
                device,
                family,
                adapter,
                limits,
                clock,
                instance,
            })
        }
    }

    /// The same device as if it could do no more than `most`: larger buffers then lie in parts, for instance.
    pub fn within(mut self, most: Limits) -> Gpu {
        self.limits = self.limits.within(most);
        self
    }

    pub fn adapter(&self) -> &Adapter {
        &self.adapter
    }

    pub(crate) fn limits(&self) -> Limits {
        self.limits
    }

    pub(super) fn clock(&self) -> Option<Clock> {
        self.clock
    }

    /// The queue, for one submission.
    pub(super) fn queue(&self) -> MutexGuard<'_, vk::Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Calls `f` with the allocator.
    pub(super) fn allocate<T>(&self, f: impl FnOnce(&mut Allocator) -> Result<T, RunError>) -> Result<T, RunError> {
        match &mut *self.allocator.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(allocator) => f(allocator),
            None => Err(self.problem("the device is closed")),
        }
    }

    pub(super) fn problem(&self, problem: impl Into<String>) -> RunError {
        device_error(&self.adapter.name, problem)
    }

    /// The error of a call.
    pub(super) fn error(&self, e: vk::Result) -> RunError {
        self.problem(describe_result(e))
    }

    /// What the validation layer said since the last check.
    pub(super) fn check(&self) -> Result<(), RunError> {
        match self.instance.complaints.take() {
            Some(text) => Err(self.problem(text)),
            None => Ok(()),
        }
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        // SAFETY: sessions and buffers are gone, they hold the device.
        unsafe {
            // After the loss of the device nothing runs any more either.
            let _ = self.device.device_wait_idle();
            if let Ok(pipelines) = self.device.get_pipeline_cache_data(self.cache) {
                self.cache_file.save(&pipelines);
            }
            self.device.destroy_pipeline_cache(self.cache, None);
            self.allocator.lock().unwrap_or_else(PoisonError::into_inner).take();
            self.device.destroy_device(None);
        }
    }
}

fn describe_result(e: vk::Result) -> String {
    match e {
        vk::Result::ERROR_DEVICE_LOST => "the device was lost".into(),
        vk::Result::ERROR_OUT_OF_DEVICE_MEMORY => "out of device memory".into(),
        vk::Result::ERROR_OUT_OF_HOST_MEMORY => "out of memory".into(),
        other => other.to_string(),
    }
}

/// What a device has for half precision.
fn half(instance: &Instance, physical: vk::PhysicalDevice) -> Option<Half> {
    // SAFETY: a physical device of this instance.
    let known = unsafe { instance.raw.enumerate_device_extension_properties(physical) }.unwrap_or_default();
    let knows = |name: &CStr| known.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
    if !knows(khr::shader_float16_int8::NAME) {
        return None;
    }
    let mut stored = vk::PhysicalDevice16BitStorageFeatures::default();
    let mut computed = vk::PhysicalDeviceShaderFloat16Int8Features::default();
    let mut multiplied = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
    let mut model = vk::PhysicalDeviceVulkanMemoryModelFeatures::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut stored).push_next(&mut computed);
    let may_multiply = knows(khr::cooperative_matrix::NAME) && knows(khr::vulkan_memory_model::NAME);
    if may_multiply {
        features = features.push_next(&mut multiplied).push_next(&mut model);
    }
    let mut groups = vk::PhysicalDeviceSubgroupProperties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut groups);
    // SAFETY: a physical device of this instance; the extensions of the structures are known to it.
    unsafe {
        instance.raw.get_physical_device_features2(physical, &mut features);
        instance.raw.get_physical_device_properties2(physical, &mut properties);
    }
    let needed =
        [stored.storage_buffer16_bit_access, stored.uniform_and_storage_buffer16_bit_access, computed.shader_float16];
    if needed.contains(&vk::FALSE) {
        return None;
    }
    let has_matrices = may_multiply
        && multiplied.cooperative_matrix == vk::TRUE
        && model.vulkan_memory_model == vk::TRUE
        && model.vulkan_memory_model_device_scope == vk::TRUE;
    let side = if has_matrices { matrix_side(instance, physical) } else { None };
    Some(Half { matrices: side.and_then(|side| Matrices::new(side, groups.subgroup_size)) })
}

/// Side of square matrices of halves that a subgroup multiplies, summed in single precision.
fn matrix_side(instance: &Instance, physical: vk::PhysicalDevice) -> Option<u32> {
    let extension = khr::cooperative_matrix::Instance::new(&instance.entry, &instance.raw);
    // SAFETY: a physical device of this instance that knows the extension.
    let all = unsafe { extension.get_physical_device_cooperative_matrix_properties(physical) }.unwrap_or_default();
    let (f16, f32) = (vk::ComponentTypeKHR::FLOAT16, vk::ComponentTypeKHR::FLOAT32);
    let fits = |p: &&vk::CooperativeMatrixPropertiesKHR| {
        (p.a_type, p.b_type, p.c_type, p.result_type) == (f16, f16, f32, f32)
            && p.scope == vk::ScopeKHR::SUBGROUP
            && p.m_size == p.n_size
            && p.m_size == p.k_size
            && [8, 16].contains(&p.m_size)
    };
    all.iter().filter(fits).map(|p| p.m_size).max()
}

/// Those that know Vulkan 1.1, which brought SPIR-V 1.3.
fn physical_devices(instance: &Instance) -> Vec<vk::PhysicalDevice> {
    // SAFETY: handles of this instance.
    let mut all = unsafe { instance.raw.enumerate_physical_devices() }.unwrap_or_default();
    all.retain(|p| properties(instance, *p).api_version >= vk::API_VERSION_1_1);
    all
}

fn properties(instance: &Instance, physical: vk::PhysicalDevice) -> vk::PhysicalDeviceProperties {
    // SAFETY: a physical device of this instance.
    unsafe { instance.raw.get_physical_device_properties(physical) }
}

fn kind(properties: &vk::PhysicalDeviceProperties) -> AdapterKind {
    match properties.device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => AdapterKind::Dedicated,
        vk::PhysicalDeviceType::INTEGRATED_GPU => AdapterKind::Integrated,
        vk::PhysicalDeviceType::VIRTUAL_GPU => AdapterKind::Virtual,
        vk::PhysicalDeviceType::CPU => AdapterKind::Software,
        _ => AdapterKind::Unknown,
    }
}

fn describe(instance: &Instance, physical: vk::PhysicalDevice) -> Adapter {
    let properties = properties(instance, physical);
    let name = properties.device_name_as_c_str().map_or("unnamed".into(), CStr::to_string_lossy);
    let (version, driver) = (properties.api_version, properties.driver_version);
    // NVIDIA counts the parts of its versions in other bits.
    let (major, minor, patch) = match properties.vendor_id {
        0x10de => (driver >> 22, driver >> 14 & 0xff, driver >> 6 & 0xff),
        _ => (vk::api_version_major(driver), vk::api_version_minor(driver), vk::api_version_patch(driver)),
    };
    Adapter {
        name: name.into_owned(),
        api: "vulkan",
        kind: kind(&properties),
        driver: format!(
            "Vulkan {}.{}.{}, driver {major}.{minor}.{patch}",
            vk::api_version_major(version),
            vk::api_version_minor(version),
            vk::api_version_patch(version)
        ),
        half: half(instance, physical),
    }
}
