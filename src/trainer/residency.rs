//! Where an experiment's populations are, and of which generation each copy is.

use crate::backend::{BackendError, DevicePopulation};

/// Where the populations of all trials of an experiment are.
#[derive(Debug)]
pub(super) enum Residency {
    /// The host alone has them.
    Host {
        /// The generation of the weights.
        generation: usize,
        /// Whether a backend was asked to hold them and did not.
        declined: bool,
    },
    /// A backend holds them. The host keeps an older copy.
    Device {
        /// The generation of the populations on the device.
        generation: usize,
        /// The generation of the weights on the host, at most `generation`.
        host_generation: usize,
        /// One per trial.
        populations: Vec<Box<dyn DevicePopulation>>,
    },
    /// A backend failed to breed them, so nobody has them.
    Lost {
        /// The generation that they should have become.
        generation: usize,
        /// The backend's error, until it is reported.
        error: Option<BackendError>,
    },
}

impl Residency {
    /// Returns the residency of weights on the host that no backend was asked to hold.
    pub fn on_host(generation: usize) -> Residency {
        Residency::Host { generation, declined: false }
    }

    /// Returns the generation that the populations are about to play.
    pub fn generation(&self) -> usize {
        match *self {
            Residency::Host { generation, .. }
            | Residency::Device { generation, .. }
            | Residency::Lost { generation, .. } => generation,
        }
    }

    /// Returns the populations that a backend holds, one per trial; empty if none does.
    pub fn on_device(&self) -> &[Box<dyn DevicePopulation>] {
        match self {
            Residency::Host { .. } | Residency::Lost { .. } => &[],
            Residency::Device { populations, .. } => populations,
        }
    }

    /// Reports whether a backend holds the populations, or has lost them.
    pub fn is_on_device(&self) -> bool {
        !matches!(self, Residency::Host { .. })
    }

    /// Fails if the populations are lost.
    pub fn check(&mut self) -> Result<(), BackendError> {
        match self {
            Residency::Lost { error, .. } => Err(error.take().unwrap_or(BackendError::Gone)),
            Residency::Host { .. } | Residency::Device { .. } => Ok(()),
        }
    }

    /// Reports whether a backend has yet to be asked to hold the populations.
    pub fn is_undecided(&self) -> bool {
        matches!(self, Residency::Host { declined: false, .. })
    }

    /// Reports whether the host's weights are of the generation that is about to play.
    pub fn host_is_current(&self) -> bool {
        match *self {
            Residency::Host { .. } => true,
            Residency::Device { generation, host_generation, .. } => generation == host_generation,
            Residency::Lost { .. } => false,
        }
    }

    /// Records that no backend holds the populations, and that none is asked again.
    pub fn decline(&mut self) {
        *self = Residency::Host { generation: self.generation(), declined: true };
    }

    /// Records that a backend holds the populations, one per trial. The host's copy is current.
    pub fn accept(&mut self, populations: Vec<Box<dyn DevicePopulation>>) {
        let generation = self.generation();
        *self = Residency::Device { generation, host_generation: generation, populations };
    }

    /// Records that the host's weights were copied from the device.
    pub fn fetched(&mut self) {
        if let Residency::Device { generation, host_generation, .. } = self {
            *host_generation = *generation;
        }
    }

    /// Records that the backend failed to breed the populations.
    pub fn lose(&mut self, error: BackendError) {
        *self = Residency::Lost { generation: self.generation() + 1, error: Some(error) };
    }

    /// Records that the last generation is over. The host's weights are current, and the device's copy is dropped.
    pub fn moved_to_host(&mut self) {
        *self = Residency::Host { generation: self.generation() + 1, declined: true };
    }

    /// Records that the populations, wherever they are, became the next generation.
    pub fn bred(&mut self) {
        match self {
            Residency::Host { generation, .. }
            | Residency::Device { generation, .. }
            | Residency::Lost { generation, .. } => *generation += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_on_the_host_and_losses_are_tracked() {
        let mut residency = Residency::on_host(3);
        assert!(residency.is_undecided() && residency.host_is_current());
        residency.accept(vec![]);
        residency.bred();
        residency.bred();
        assert!(residency.is_on_device() && !residency.host_is_current());
        assert_eq!(residency.generation(), 5);
        residency.fetched();
        assert!(residency.host_is_current());
        residency.bred();
        assert!(residency.check().is_ok());
        residency.lose(BackendError::HeldElsewhere);
        assert_eq!((residency.generation(), residency.host_is_current(), residency.is_undecided()), (7, false, false));
        // The backend's own error is reported once.
        assert!(matches!(residency.check(), Err(BackendError::HeldElsewhere)));
        assert!(matches!(residency.check(), Err(BackendError::Gone)));
    }
}
