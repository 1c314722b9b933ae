//! Opening of backends.

use crate::backend::cpu::Cpu;
#[cfg(feature = "gpu")]
use crate::backend::gpu::{
    self,
    device::{AdapterChoice, DeviceError},
    episode::{GpuBackend, ResidencyPolicy},
};
use crate::backend::{Machine, OpenBackend};

/// The processor that plays episodes.
#[cfg(feature = "gpu")]
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Processor {
    /// A usable GPU if there is one, else the CPU. Software renderers are ignored.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU. Software renderers are ignored.
    Gpu,
    /// An adapter, selected by its index in `gpu::device::adapters` or by part of its name. It may be a software
    /// renderer.
    Adapter(String),
}

/// Opens the GPU that the processor asks for, if any. Also returns why an existing GPU is not used, if so. `holding`
/// selects the populations that the GPU keeps between generations; without it, the backend's default applies.
///
/// With [`Processor::Auto`], a missing or unusable GPU is an error only if `holding` is [`ResidencyPolicy::Always`].
///
/// # Errors
/// The requested GPU does not exist or cannot be used.
#[cfg(feature = "gpu")]
pub fn find_gpu(
    processor: &Processor,
    holding: Option<ResidencyPolicy>,
) -> Result<(Option<GpuBackend>, Option<DeviceError>), DeviceError> {
    let choice = match processor {
        Processor::Cpu => return Ok((None, None)),
        Processor::Auto | Processor::Gpu => AdapterChoice::Real,
        Processor::Adapter(name) => AdapterChoice::Named(name.clone()),
    };
    let optional = *processor == Processor::Auto && holding != Some(ResidencyPolicy::Always);
    match gpu::open(choice).and_then(GpuBackend::new) {
        Ok(gpu) => {
            let gpu = match holding {
                Some(holding) => gpu.with_residency(holding),
                None => gpu,
            };
            Ok((Some(gpu), None))
        }
        Err(DeviceError::NoAdapter | DeviceError::NoRealAdapter { .. }) if optional => Ok((None, None)),
        Err(error) if optional => Ok((None, Some(error))),
        Err(error) => Err(error),
    }
}

/// Opens the backend for a processor. Also returns why an existing GPU is not used, if so.
///
/// # Errors
/// The requested GPU does not exist or cannot be used.
#[cfg(feature = "gpu")]
pub fn open(processor: &Processor) -> Result<(OpenBackend, Option<DeviceError>), DeviceError> {
    let (gpu, rejection) = find_gpu(processor, None)?;
    Ok((gpu.map_or_else(cpu, on_gpu), rejection))
}

/// Returns the CPU backend, which is always available.
pub fn cpu() -> OpenBackend {
    (Box::new(Cpu::default()), Machine::of_cpu())
}

/// Returns an opened GPU as a backend, with its description.
#[cfg(feature = "gpu")]
pub fn on_gpu(backend: GpuBackend) -> OpenBackend {
    let machine = Machine::of_gpu(&backend);
    (Box::new(backend), machine)
}
