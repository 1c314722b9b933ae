//! Why episodes could not be played.

#[cfg(feature = "gpu")]
use super::gpu::device::DeviceError;
use crate::config::ConfigError;
use crate::evolve;

/// Why episodes could not be played.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// A GPU could not be opened, or failed.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] DeviceError),
    /// The request exceeds a limit of the device.
    #[error("{0}")]
    TooLarge(String),
    /// The input is inconsistent or out of range.
    #[error("{0}")]
    InvalidInput(String),
    /// A backend got populations that another one holds.
    #[error("the populations are held by another device; bring them to the host first")]
    HeldElsewhere,
    /// The populations of the present generation are lost.
    #[error("the populations were lost with the device that held them")]
    Gone,
}

impl BackendError {
    /// Reports whether a device was lost or ran out of memory, so that another backend may play the same.
    pub fn is_device_failure(&self) -> bool {
        match self {
            #[cfg(feature = "gpu")]
            BackendError::Gpu(error) => matches!(error, DeviceError::Lost { .. } | DeviceError::OutOfMemory { .. }),
            BackendError::Gone => true,
            _ => false,
        }
    }
}

impl From<ConfigError> for BackendError {
    fn from(error: ConfigError) -> BackendError {
        BackendError::InvalidInput(error.to_string())
    }
}

impl From<evolve::InvalidInput> for BackendError {
    fn from(error: evolve::InvalidInput) -> BackendError {
        BackendError::InvalidInput(error.to_string())
    }
}
