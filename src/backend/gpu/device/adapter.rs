//! Adapters: finding them, describing them, choosing one.

use std::fmt;
use std::sync::OnceLock;

use super::DeviceError;
use crate::backend::gpu::exact::Pass;
use crate::config_enum::config_enum;
use crate::escape;
use crate::host;

/// Names of renderers that run on the CPU, for drivers whose device type hides that.
const SOFTWARE: [&str; 5] = ["llvmpipe", "lavapipe", "swiftshader", "microsoft basic render", "software"];

/// An adapter: a GPU, or a renderer on the CPU.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// The driver's name for the device.
    pub name: String,
    /// The driver and its version. Empty if the backend does not report them.
    pub driver: String,
    /// "vulkan", "metal", "dx12".
    pub backend: String,
    /// The kind of device.
    pub kind: Kind,
    /// The index in [`adapters`].
    pub index: usize,
    /// The PCI address, such as "0000:65:00.0". Empty if the driver does not report it.
    pub pci: String,
}

config_enum! {
    /// The kind of device, the preferred kinds first.
    #[derive(PartialOrd, Ord)]
    Kind {
        /// A GPU with memory of its own.
        Discrete = "discrete GPU",
        /// A GPU that shares the host's memory.
        Integrated = "integrated GPU",
        /// A GPU passed to a virtual machine.
        Virtual = "virtual GPU",
        /// The driver does not report the kind.
        Unknown = "unknown kind",
        /// A renderer that runs on the CPU.
        Software = "software renderer",
    }
}

impl Kind {
    /// Reports whether this is certainly a GPU.
    pub fn is_real(self) -> bool {
        self <= Kind::Virtual
    }
}

impl fmt::Display for AdapterInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {}", self.name, self.kind, self.backend)?;
        if !self.driver.is_empty() {
            write!(f, ", {}", self.driver)?;
        }
        f.write_str(")")
    }
}

impl From<&wgpu::AdapterInfo> for AdapterInfo {
    fn from(info: &wgpu::AdapterInfo) -> Self {
        let name = info.name.to_lowercase();
        let kind = match info.device_type {
            wgpu::DeviceType::Cpu => Kind::Software,
            _ if SOFTWARE.iter().any(|software| name.contains(software)) => Kind::Software,
            wgpu::DeviceType::DiscreteGpu => Kind::Discrete,
            wgpu::DeviceType::IntegratedGpu => Kind::Integrated,
            wgpu::DeviceType::VirtualGpu => Kind::Virtual,
            wgpu::DeviceType::Other => Kind::Unknown,
        };
        let driver = [info.driver.as_str(), info.driver_info.as_str()];
        AdapterInfo {
            name: escape::line(&info.name).into(),
            driver: escape::line(&driver.iter().filter(|part| !part.is_empty()).copied().collect::<Vec<_>>().join(" "))
                .into(),
            backend: info.backend.to_str().to_string(),
            kind,
            index: 0,
            pci: escape::line(&info.device_pci_bus_id).into(),
        }
    }
}

/// Returns all adapters that can compute, the preferred ones first.
///
/// `WGPU_BACKEND` limits the backends (`vulkan`, `metal`, `dx12`). wgpu's other variables have their effect, too, such as
/// `WGPU_DX12_COMPILER`. The Vulkan loader has its own `VK_DRIVER_FILES`. The first call of a process reads them.
pub fn adapters() -> Vec<AdapterInfo> {
    found().into_iter().map(|(_, info)| info).collect()
}

/// Returns the drivers of the system, loaded once per process.
///
/// They are never unloaded. A library that NVIDIA's Vulkan driver for Linux loads registers a function for the end of
/// each thread. If another thread unloads the driver in that moment, the process crashes.
fn instance() -> &'static wgpu::Instance {
    static INSTANCE: OnceLock<wgpu::Instance> = OnceLock::new();
    INSTANCE.get_or_init(|| {
        // The default instance ignores the environment, and enables validation layers in debug builds.
        wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::all().with_env(),
            flags: wgpu::InstanceFlags::empty().with_env(),
            backend_options: wgpu::BackendOptions::from_env_or_default(),
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        })
    })
}

fn found() -> Vec<(wgpu::Adapter, AdapterInfo)> {
    let mut adapters: Vec<_> = host::wait(instance().enumerate_adapters(wgpu::Backends::all()))
        .into_iter()
        .filter(|a| a.get_downlevel_capabilities().flags.contains(wgpu::DownlevelFlags::COMPUTE_SHADERS))
        .map(|adapter| (adapter.get_info(), adapter))
        .collect();
    // A device that two backends offer is one adapter. The backend that needs no guards wins.
    adapters.sort_by_key(|(info, _)| (AdapterInfo::from(info).kind, info.backend != wgpu::Backend::Vulkan));
    let same = |a: &wgpu::AdapterInfo, b: &wgpu::AdapterInfo| {
        a.backend != b.backend && (a.vendor, a.device, &a.name) == (b.vendor, b.device, &b.name)
    };
    let infos: Vec<_> = adapters.iter().map(|(info, _)| info.clone()).collect();
    let first = |index: usize| !infos[..index].iter().any(|earlier| same(earlier, &infos[index]));
    let kept = adapters.into_iter().enumerate().filter(|(index, _)| first(*index));
    let numbered = kept.map(|(_, kept)| kept).enumerate();
    numbered.map(|(index, (info, adapter))| (adapter, AdapterInfo { index, ..AdapterInfo::from(&info) })).collect()
}

/// Describes the compiler that a backend ("vulkan", "metal", "dx12") passes shaders to.
pub fn compiler(backend: &str) -> String {
    match backend {
        "metal" => "Metal's compiler with fast math, which wgpu does not let us turn off".into(),
        "dx12" => match wgpu::Dx12Compiler::from_env().unwrap_or_default() {
            wgpu::Dx12Compiler::Fxc => "FXC, by WGPU_DX12_COMPILER".into(),
            wgpu::Dx12Compiler::DynamicDxc { dxc_path } => format!("DXC ({dxc_path})"),
            wgpu::Dx12Compiler::StaticDxc => "DXC, built in".into(),
            wgpu::Dx12Compiler::Auto => "DXC if dxcompiler.dll is on the path, else FXC".into(),
        },
        _ => "the driver's compiler".into(),
    }
}

/// Selects the adapter to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AdapterChoice {
    /// An adapter that is certainly a GPU.
    Real,
    /// By its index in [`adapters`] if this is a number, else by a part of its name, in any case. The first match wins.
    Named(String),
}

/// A request to open a device. Only tests and `verify` need more than an [`AdapterChoice`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// The adapter.
    pub adapter: AdapterChoice,
    /// Only this pass, instead of the first exact one. [`Pass::Plain`] is not tested.
    pub pass: Option<Pass>,
    /// Use WebGPU's default limits instead of the adapter's own.
    pub default_limits: bool,
    /// Keep bounds checks, loop bounds and zeroed workgroup memory in shaders.
    pub checked: bool,
}

impl From<AdapterChoice> for Request {
    fn from(adapter: AdapterChoice) -> Self {
        Request { adapter, pass: None, default_limits: false, checked: false }
    }
}

/// Returns the adapter of a choice.
pub(in crate::backend::gpu) fn choose(choice: &AdapterChoice) -> Result<(wgpu::Adapter, AdapterInfo), DeviceError> {
    let mut found = found();
    let infos: Vec<_> = found.iter().map(|(_, info)| info.clone()).collect();
    Ok(found.swap_remove(position(choice, &infos)?))
}

/// Returns the index in [`adapters`] of a choice.
///
/// # Errors
/// There is no adapter, none that is a GPU, or none with that name or number.
pub fn position(choice: &AdapterChoice, infos: &[AdapterInfo]) -> Result<usize, DeviceError> {
    match choice {
        AdapterChoice::Named(name) => {
            let part = name.trim().to_lowercase();
            let found = match is_index(&part) {
                true => part.parse().ok().filter(|&index: &usize| index < infos.len()),
                // Every name contains the empty string.
                false if part.is_empty() => None,
                false => infos.iter().position(|info| info.name.to_lowercase().contains(&part)),
            };
            found.ok_or_else(|| DeviceError::UnknownAdapter { name: name.clone(), found: infos.to_vec() })
        }
        // The first adapter is the preferred one.
        AdapterChoice::Real if infos.first().is_some_and(|info| !info.kind.is_real()) => {
            Err(DeviceError::NoRealAdapter { found: infos.to_vec() })
        }
        AdapterChoice::Real if infos.is_empty() => Err(DeviceError::NoAdapter),
        AdapterChoice::Real => Ok(0),
    }
}

/// Reports whether this can only be an adapter's index: a number, even one out of range.
pub(super) fn is_index(name: &str) -> bool {
    let digits = name.trim().trim_start_matches(['+', '-']);
    !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())
}
