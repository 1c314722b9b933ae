//! Asks a Vulkan driver to compile a compute shader and reads its statistics. Unlike wgpu, this opens devices that are absent.

use std::collections::BTreeMap;
use std::ffi::{CStr, c_char};

use ash::{Device, Entry, Instance, khr, vk};

/// Bindings of every shader's group 0: a uniform, and storage buffers.
const BINDINGS: u32 = 8;

/// A shader as the driver compiled it.
#[derive(Debug)]
pub struct Compiled {
    /// Registers, scratch, spills, instructions, …, by the driver's own names.
    pub statistics: BTreeMap<String, u64>,
    pub assembly: String,
}

/// The first device of the driver that the environment names.
pub struct Driver {
    instance: Instance,
    device: Device,
    layout: vk::PipelineLayout,
    /// The driver and its version.
    pub version: String,
    _entry: Entry,
}

fn text(chars: &[c_char]) -> String {
    // SAFETY: Vulkan's names end with a zero.
    unsafe { CStr::from_ptr(chars.as_ptr()) }.to_string_lossy().into_owned()
}

impl Driver {
    /// Opens it, as wgpu would: with robust access to buffers.
    pub fn open() -> Result<Driver, Box<dyn std::error::Error>> {
        // SAFETY: calls follow the specification, handles outlive their use, and all is given back when the process ends.
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
        // SAFETY: as above; naga wrote the module, and the lists are as long as the driver was told.
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
            let made = self.device.create_compute_pipelines(vk::PipelineCache::null(), &[info], None);
            let pipeline = made.map_err(|(_, error)| error)?[0];
            let api = khr::pipeline_executable_properties::Device::new(&self.instance, &self.device);
            let executable = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline);
            let statistics = api.get_pipeline_executable_statistics(&executable)?;
            let statistics = statistics.iter().map(|one| (text(&one.name), one.value.u64)).collect();
            let list = api.fp().get_pipeline_executable_internal_representations_khr;
            let mut count = 0;
            list(self.device.handle(), &executable, &mut count, std::ptr::null_mut()).result()?;
            let mut found = vec![vk::PipelineExecutableInternalRepresentationKHR::default(); count as usize];
            list(self.device.handle(), &executable, &mut count, found.as_mut_ptr()).result()?;
            let mut texts: Vec<Vec<u8>> = found.iter().map(|one| vec![0; one.data_size]).collect();
            for (one, text) in found.iter_mut().zip(&mut texts) {
                one.p_data = text.as_mut_ptr().cast();
            }
            list(self.device.handle(), &executable, &mut count, found.as_mut_ptr()).result()?;
            let assembly = found.iter().zip(&texts).find(|(one, _)| text(&one.name) == "Assembly");
            let assembly = assembly.map(|(_, text)| String::from_utf8_lossy(text).trim_end_matches('\0').to_string());
            Ok(Compiled { statistics, assembly: assembly.unwrap_or_default() })
        }
    }
}
