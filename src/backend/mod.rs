//! The interface between training and the hardware: whole episodes of many teams.
//!
//! | file | holds |
//! |---|---|
//! | `batch` | the input: groups of teams, where their policies are, and the fitnesses |
//! | `scores` | the output: the scores of each group, computed while others play |
//! | `grid` | cells in which large teams find the agents near a place |
//! | `size` | how many bytes episodes and populations take |
//! | `trace` | all quantities of every step, for comparison and replays |
//! | `compare` | the first difference of two traces |
//! | `cpu`, `gpu` | the two backends |
//! | `error` | why episodes could not be played |

use std::any::Any;
use std::fmt::Debug;

use crate::evolve::Breeding;
use crate::parallel::current_num_threads;

mod batch;
pub(crate) mod compare;
pub mod cpu;
mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
pub(crate) mod grid;
mod scores;
mod size;
mod trace;

pub use batch::{Group, Weights};
pub use error::BackendError;
pub use scores::GroupScores;
pub(crate) use size::{BATCH_BYTES, dispatch_bytes, held_bytes, sum_bytes, trace_bytes, weight_bytes};
pub use size::{HELD_FROM, record_bytes};
#[cfg(feature = "gpu")]
use size::{VECTOR, WeightVector, check_sizes, record_words, traced_words, weight_vectors};
pub(crate) use trace::MOMENT_WORDS;
pub use trace::{Moment, Trace};

/// Plays episodes and scores them. Every implementation returns the same bits.
///
/// Records of episodes are private to a backend: only scores leave it.
pub trait Backend: Send {
    /// Plays every team of every group once. Returns the scores of each group.
    ///
    /// # Errors
    /// A group is inconsistent or exceeds a limit of the device, or the device failed.
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError>;

    /// Plays one group and returns all quantities of every step.
    ///
    /// # Errors
    /// See [`Backend::play`].
    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError>;

    /// Copies the populations of one trial, `[populations][slots][parameters]`, to the device, to be bred there.
    /// Returns `None` if they are to stay on the host.
    ///
    /// # Errors
    /// The weights do not match the sizes, a size is 0, the device was asked to hold all populations and these do not
    /// fit, or it failed.
    fn hold(
        &mut self,
        _weights: &[f32],
        _sizes: [usize; 3],
    ) -> Result<Option<Box<dyn DevicePopulation>>, BackendError> {
        Ok(None)
    }

    /// Describes the hardware for people: "cpu (AVX2, 2 threads)".
    fn describe(&self) -> String;
}

/// The populations of one trial in a device's memory, which dropping them frees.
///
/// After an error their generation is undefined. A backend recognises its own populations in [`Weights::OnDevice`] by
/// downcasting through [`Any`]; of others it returns [`BackendError::HeldElsewhere`]. A backend that keeps them in the host's memory can breed with [`Breeding::on_host`], as
/// `FakeDevice` in `cli/tests/population.rs` does.
pub trait DevicePopulation: Any + Debug + Send + Sync {
    /// Replaces the populations by the next generation, with the bits of [`crate::evolve::mutate`].
    ///
    /// # Errors
    /// The plan does not match the populations, or the device failed.
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError>;

    /// Copies all weights to the host, `[populations][slots][parameters]`.
    ///
    /// # Errors
    /// The device failed.
    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError>;
}

/// The hardware of a run, for `run.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Machine {
    /// "cpu" or "gpu".
    pub backend: String,
    /// The GPU's name.
    pub adapter: Option<String>,
    /// The GPU's driver and its version.
    pub driver: Option<String>,
    /// The GPU's index in `flotilla devices`.
    pub adapter_index: Option<usize>,
    /// The GPU's PCI address, if the driver reports it. Equal GPUs differ in this.
    pub adapter_pci: Option<String>,
    /// CPU threads.
    pub threads: usize,
}

impl Machine {
    /// Describes the CPU, with the threads of the current pool.
    pub(crate) fn of_cpu() -> Machine {
        Machine { backend: "cpu".into(), threads: current_num_threads(), ..Machine::default() }
    }

    /// Describes the GPU of a backend.
    #[cfg(feature = "gpu")]
    pub fn of_gpu(backend: &gpu::episode::GpuBackend) -> Machine {
        let adapter = &backend.gpu().adapter;
        Machine {
            backend: "gpu".into(),
            adapter: Some(adapter.name.clone()),
            driver: Some(adapter.driver.clone()),
            adapter_index: Some(adapter.index),
            adapter_pci: Some(adapter.pci.clone()).filter(|pci| !pci.is_empty()),
            threads: current_num_threads(),
        }
    }
}

/// An open backend and its hardware.
pub type OpenBackend = (Box<dyn Backend>, Machine);
