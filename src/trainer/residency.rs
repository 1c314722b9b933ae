//! Where an experiment's populations are, and of which generation each copy is.

use crate::backend::DevicePopulation;

/// Where the populations of all trials of an experiment are.
///
/// After [`Residency::lose`] the host's copy may be older than the generation that plays next. The experiment then
/// replays the generations in between, with the same results.
#[derive(Debug)]
pub(super) enum Residency {
    /// The host alone has them.
    Host {
        /// The generation of the weights.
        generation: usize,
        /// Whether a backend was asked to hold them and did not, or lost them.
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
}

impl Residency {
    /// Returns the residency of weights on the host that no backend was asked to hold.
    pub fn on_host(generation: usize) -> Residency {
        Residency::Host { generation, declined: false }
    }

    /// Returns the generation that the populations are about to play.
    pub fn generation(&self) -> usize {
        match *self {
            Residency::Host { generation, .. } | Residency::Device { generation, .. } => generation,
        }
    }

    /// Returns the populations that a backend holds, one per trial; empty if the host has them.
    pub fn on_device(&self) -> &[Box<dyn DevicePopulation>] {
        match self {
            Residency::Host { .. } => &[],
            Residency::Device { populations, .. } => populations,
        }
    }

    /// Reports whether a backend holds the populations.
    pub fn is_on_device(&self) -> bool {
        matches!(self, Residency::Device { .. })
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

    /// Drops the device's copy. Only the host's copy is left, which may be older.
    pub fn lose(&mut self) {
        if let Residency::Device { host_generation, .. } = *self {
            *self = Residency::Host { generation: host_generation, declined: true };
        }
    }

    /// Records that the last generation is over. The host's weights are current, and the device's copy is dropped.
    pub fn moved_to_host(&mut self) {
        *self = Residency::Host { generation: self.generation() + 1, declined: true };
    }

    /// Records that the populations, wherever they are, became the next generation.
    pub fn bred(&mut self) {
        match self {
            Residency::Host { generation, .. } | Residency::Device { generation, .. } => *generation += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_goes_back_to_the_last_copy_on_the_host() {
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
        residency.lose();
        assert_eq!((residency.generation(), residency.is_on_device(), residency.is_undecided()), (5, false, false));
        residency.bred();
        assert_eq!(residency.generation(), 6);
    }
}
