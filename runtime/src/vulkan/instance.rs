//! The connection to the Vulkan loader, and what validation says.

use crate::DeviceError;
use ash::{ext, khr, vk};
use std::ffi::{CStr, c_char, c_void};
use std::sync::{Mutex, OnceLock, PoisonError};

/// `RAYGRAD_VULKAN_VALIDATION=1` loads this layer; what it says becomes an error.
const VALIDATION: &CStr = c"VK_LAYER_KHRONOS_validation";

/// The first message of the validation layer that nobody was told of.
#[derive(Default)]
pub(super) struct Complaints(Mutex<Option<String>>);

impl Complaints {
    pub fn take(&self) -> Option<String> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

pub(super) struct Instance {
    pub raw: ash::Instance,
    validation: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    /// What the messenger writes to.
    pub complaints: Box<Complaints>,
    pub entry: ash::Entry,
}

impl Instance {
    pub fn new() -> Result<Instance, DeviceError> {
        // SAFETY: the loader is the system's, and all calls below are made with handles of this instance.
        unsafe {
            let entry = loader()?;
            let version = entry.try_enumerate_instance_version().ok().flatten().unwrap_or(vk::API_VERSION_1_0);
            if version < vk::API_VERSION_1_1 {
                return Err(unavailable(&"the loader knows Vulkan 1.0 only, 1.1 is needed"));
            }
            let validate = std::env::var_os("RAYGRAD_VULKAN_VALIDATION").is_some_and(|v| v == "1");
            let mut layers: Vec<*const c_char> = vec![];
            if validate {
                let known = entry.enumerate_instance_layer_properties().map_err(|e| unavailable(&e))?;
                if !known.iter().any(|l| l.layer_name_as_c_str() == Ok(VALIDATION)) {
                    let found = "RAYGRAD_VULKAN_VALIDATION=1, but VK_LAYER_KHRONOS_validation is not installed";
                    return Err(unavailable(&found));
                }
                layers.push(VALIDATION.as_ptr());
            }
            let known = entry.enumerate_instance_extension_properties(None).map_err(|e| unavailable(&e))?;
            let knows = |name: &CStr| known.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
            let mut extensions: Vec<*const c_char> = vec![];
            let mut flags = vk::InstanceCreateFlags::empty();
            // Drivers on top of another API (MoltenVK) are listed only to those who ask for them.
            if knows(khr::portability_enumeration::NAME) {
                extensions.push(khr::portability_enumeration::NAME.as_ptr());
                flags |= vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR;
            }
            if validate {
                extensions.push(ext::debug_utils::NAME.as_ptr());
            }
            let application = vk::ApplicationInfo::default()
                .application_name(c"raygrad")
                .engine_name(c"raygrad")
                .api_version(vk::API_VERSION_1_1);
            let description = vk::InstanceCreateInfo::default()
                .flags(flags)
                .application_info(&application)
                .enabled_layer_names(&layers)
                .enabled_extension_names(&extensions);
            let raw = entry.create_instance(&description, None).map_err(|e| unavailable(&e))?;
            let mut instance = Instance { raw, validation: None, complaints: Box::default(), entry };
            if validate {
                let utils = ext::debug_utils::Instance::new(&instance.entry, &instance.raw);
                let severity =
                    vk::DebugUtilsMessageSeverityFlagsEXT::WARNING | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR;
                let kinds =
                    vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE;
                let description = vk::DebugUtilsMessengerCreateInfoEXT::default()
                    .message_severity(severity)
                    .message_type(kinds)
                    .pfn_user_callback(Some(complain))
                    .user_data(&raw const *instance.complaints as *mut c_void);
                let messenger = utils.create_debug_utils_messenger(&description, None).map_err(|e| unavailable(&e))?;
                instance.validation = Some((utils, messenger));
            }
            Ok(instance)
        }
    }
}

/// The loader's library, once opened, stays open until the process ends: with it drivers stay loaded, whose own data of a
/// thread are cleared when that thread ends, by code that must be there then.
fn loader() -> Result<ash::Entry, DeviceError> {
    static LOADER: OnceLock<Result<ash::Entry, String>> = OnceLock::new();
    // SAFETY: the loader is the system's.
    let loader = LOADER.get_or_init(|| unsafe { ash::Entry::load() }.map_err(|e| e.to_string()));
    loader.clone().map_err(|e| unavailable(&e))
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: devices of the instance are gone, they hold it.
        unsafe {
            if let Some((utils, messenger)) = self.validation.take() {
                utils.destroy_debug_utils_messenger(messenger, None);
            }
            self.raw.destroy_instance(None);
        }
    }
}

fn unavailable(reason: &dyn std::fmt::Display) -> DeviceError {
    DeviceError::NoVulkan(reason.to_string())
}

/// # Safety
/// Called by the driver, with the [`Complaints`] of the instance, which lives longer than the messenger.
unsafe extern "system" fn complain(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT,
    complaints: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: by the contract; a message is a C string.
    unsafe {
        let text = (*data).message_as_c_str().map_or_else(String::new, |m| m.to_string_lossy().into_owned());
        let slot = &(*(complaints as *const Complaints)).0;
        slot.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(text);
    }
    vk::FALSE
}
