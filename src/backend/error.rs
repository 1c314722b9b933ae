//! Why episodes could not be played.

#[cfg(feature = "gpu")]
use super::gpu::device::DeviceError;
use crate::evolve;

/// Why episodes could not be played.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// A GPU could not be opened, or failed.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] DeviceError),
    /// What was asked does not fit the device.
    #[error("{0}")]
    TooLarge(String),
    /// The input is inconsistent or out of range.
    #[error("{0}")]
    InvalidInput(String),
    /// Populations of one backend were handed to another.
    #[error("the populations are held by another device; bring them to the host first")]
    HeldElsewhere,
    /// Nobody has the populations of the present generation any more.
    #[error("the populations were lost with the device that held them")]
    Gone,
}

impl From<evolve::InvalidInput> for BackendError {
    fn from(error: evolve::InvalidInput) -> BackendError {
        BackendError::InvalidInput(error.to_string())
    }
}
