//! Where an experiment's populations are.

use crate::backend::{BackendError, DevicePopulation};

/// Where the populations of all trials of an experiment are.
#[derive(Debug)]
pub(super) enum Residency {
    /// The host alone has them, and no backend was asked to hold them.
    Undecided,
    /// The host alone has them.
    Host,
    /// A backend holds them, one per trial. The host keeps a copy, which may be older.
    Device { populations: Vec<Box<dyn DevicePopulation>>, host_is_current: bool },
    /// A backend failed to breed them, so nobody has them. Its error is kept until it is reported.
    Lost(Option<BackendError>),
}

impl Residency {
    /// Returns the populations that a backend holds, one per trial; empty if none does.
    pub fn on_device(&self) -> &[Box<dyn DevicePopulation>] {
        if let Residency::Device { populations, .. } = self { populations } else { &[] }
    }

    /// Fails if the populations are lost.
    pub fn check(&mut self) -> Result<(), BackendError> {
        if let Residency::Lost(error) = self { Err(error.take().unwrap_or(BackendError::Gone)) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_of_a_loss_is_reported_once() {
        let mut residency = Residency::Lost(Some(BackendError::HeldElsewhere));
        assert!(matches!(residency.check(), Err(BackendError::HeldElsewhere)));
        assert!(matches!(residency.check(), Err(BackendError::Gone)));
    }
}
