//! Compiles a compute shader with a Vulkan driver, and reads its statistics and assembly. Unlike wgpu, this can open
//! devices that the machine does not have.

use std::collections::BTreeMap;
use std::ffi::{CStr, c_char};

use ash::{Device, Entry, Instance, khr, vk};

/// Number of bindings in group 0 of every shader: a uniform buffer, and then storage buffers.
const BINDINGS: u32 = 9;

/// A compiled shader.
#[derive(Debug)]
pub struct Compiled {
    /// Registers, scratch, spills, instructions and so on, with the driver's names.
    pub statistics: BTreeMap<String, u64>,
    pub assembly: String,
}

/// The first device of the driver that the environment selects.
pub struct Driver {
    instance: Instance,
    device: Device,
    layout: vk::PipelineLayout,
    /// The name and version of the driver.
    pub version: String,
    _entry: Entry,
}

fn text(chars: &[c_char]) -> String {
    // SAFETY: Vulkan's names are zero-terminated.
    unsafe { CStr::from_ptr(chars.as_ptr()) }.to_string_lossy().into_owned()
}

impl Driver {
    /// Opens the device with robust buffer access, like wgpu.
    pub fn open() -> Result<Driver, Box<dyn std::error::Error>> {
        // SAFETY: the calls follow the specification, and the handles are valid until the process ends.
        unsafe {
            let entry = Entry::load()?;
            let app = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_2);
            let instance = entry.create_instance(&vk::InstanceCreateInfo::default().application_info(&app), None)?;
            let physical = *instance.enumerate_physical_devices()?.first().ok_or("the driver has no device")?;
            let mut driver = vk::PhysicalDeviceDriverProperties::default();
            let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut driver);
            instance.get_physical_device_properties2(physical, &mut properties);
            let version = format!("{} {}", text(&driver.driver_name), text(&driver.driver_info));
            let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(0).queue_priorities(&[1.0])];
            let extensions = [khr::pipeline_executable_properties::NAME, ash::ext::robustness2::NAME].map(CStr::as_ptr);
            let mut executables =
                vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
            let mut robustness = vk::PhysicalDeviceRobustness2FeaturesEXT::default().robust_buffer_access2(true);
            let features = vk::PhysicalDeviceFeatures::default().robust_buffer_access(true);
            let info = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&extensions)
                .enabled_features(&features)
                .push_next(&mut executables)
                .push_next(&mut robustness);
            let device = instance.create_device(physical, &info, None)?;
            let bindings: Vec<_> = (0..BINDINGS)
                .map(|binding| {
                    vk::DescriptorSetLayoutBinding::default()
                        .binding(binding)
                        .descriptor_type(match binding {
                            0 => vk::DescriptorType::UNIFORM_BUFFER,
                            _ => vk::DescriptorType::STORAGE_BUFFER,
                        })
                        .descriptor_count(1)
                        .stage_flags(vk::ShaderStageFlags::COMPUTE)
                })
                .collect();
            let set = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
            let sets = [device.create_descriptor_set_layout(&set, None)?];
            let layout = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            let layout = device.create_pipeline_layout(&layout, None)?;
            Ok(Driver { instance, device, layout, version, _entry: entry })
        }
    }

    /// Compiles an entry point of a SPIR-V module.
    pub fn compile(&self, words: &[u32], entry: &CStr) -> Result<Compiled, vk::Result> {
        // SAFETY: as above. The module is valid because naga wrote it, and the lists have the lengths given to the
        // driver.
        unsafe {
            let module = self.device.create_shader_module(&vk::ShaderModuleCreateInfo::default().code(words), None)?;
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(entry);
            let info = vk::ComputePipelineCreateInfo::default()
                .flags(
                    vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR
                        | vk::PipelineCreateFlags::CAPTURE_INTERNAL_REPRESENTATIONS_KHR,
                )
                .stage(stage)
                .layout(self.layout);
            let pipelines = self.device.create_compute_pipelines(vk::PipelineCache::null(), &[info], None);
            let pipeline = pipelines.map_err(|(_, error)| error)?[0];
            let api = khr::pipeline_executable_properties::Device::new(&self.instance, &self.device);
            let executable = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline);
            let statistics = api.get_pipeline_executable_statistics(&executable)?;
            let statistics = statistics.iter().map(|entry| (text(&entry.name), entry.value.u64)).collect();
            let list = api.fp().get_pipeline_executable_internal_representations_khr;
            let mut count = 0;
            list(self.device.handle(), &executable, &mut count, std::ptr::null_mut()).result()?;
            let mut parts = vec![vk::PipelineExecutableInternalRepresentationKHR::default(); count as usize];
            list(self.device.handle(), &executable, &mut count, parts.as_mut_ptr()).result()?;
            let mut texts: Vec<Vec<u8>> = parts.iter().map(|part| vec![0; part.data_size]).collect();
            for (part, text) in parts.iter_mut().zip(&mut texts) {
                part.p_data = text.as_mut_ptr().cast();
            }
            list(self.device.handle(), &executable, &mut count, parts.as_mut_ptr()).result()?;
            let assembly = parts.iter().zip(&texts).find(|(part, _)| text(&part.name) == "Assembly");
            let assembly = assembly.map(|(_, text)| String::from_utf8_lossy(text).trim_end_matches('\0').to_string());
            Ok(Compiled { statistics, assembly: assembly.unwrap_or_default() })
        }
    }
}
