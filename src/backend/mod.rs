//! The interface between training and the hardware: whole episodes of many teams.
//!
//! | file | holds |
//! |---|---|
//! | `batch` | what is to be played: groups of teams, where their policies are, how to score them; and the scores |
//! | `scores` | the scores of a batch, computed while it plays |
//! | `trace` | every stage of every step, for comparison and replays |
//! | `error` | why episodes could not be played |

use std::any::Any;
use std::fmt::Debug;

use crate::config::Fitness;
use crate::credit::RecordRequest;
use crate::evolve::Breeding;
use crate::parallel::current_num_threads;
use crate::world::World;

mod batch;
pub mod compare;
pub mod cpu;
mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
mod scores;
mod trace;

pub use batch::{Group, GroupScores, Weights};
pub use error::BackendError;
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

    /// Plays one group and returns every stage of every step.
    ///
    /// # Errors
    /// See [`Backend::play`].
    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError>;

    /// Copies the populations of one trial, `[populations][slots][parameters]`, to the device, to be bred there.
    /// Returns `None` if they had better stay on the host.
    ///
    /// # Errors
    /// The device was asked to hold all populations and these do not fit, or it failed.
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
/// After an error their generation is undefined.
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
    pub(crate) fn of_gpu(backend: &gpu::episode::GpuBackend) -> Machine {
        let adapter = &backend.gpu().adapter;
        Machine {
            backend: "gpu".into(),
            adapter: Some(adapter.name.clone()),
            driver: Some(adapter.driver.clone()),
            threads: current_num_threads(),
        }
    }
}

/// An open backend and its hardware.
pub type OpenBackend = (Box<dyn Backend>, Machine);

/// Default minimum bytes of a trial's populations to be held on a GPU: about what the bus transfers in the time of the
/// few dispatches that holding costs. An estimate, not a measurement. Software renderers hold none.
pub const HELD_FROM: u64 = 1 << 20;

/// Default minimum bytes of a batch's records to be packed on a GPU: about what the bus transfers in the time of one
/// more dispatch. An estimate, not a measurement. Software renderers pack none.
pub(crate) const PACKED_FROM: u64 = 1 << 20;

/// Target bytes of one buffer of a batch on a GPU: enough to fill the device, small enough to overlap batches.
pub const BATCH_BYTES: u64 = 256 << 20;
/// Weights that a GPU thread loads at once.
const FOUR: usize = 4;

/// Returns the words of a team's record: sets, counts and, if needed, sightings.
fn record_words(world: &World, records: RecordRequest<'_>) -> usize {
    let sights = if records.sights() { world.sight_words() } else { 0 };
    world.set_words() + world.leaders() * world.followers() + sights
}

/// Returns the bytes of the record of a team that is scored by a fitness.
pub fn record_bytes(world: &World, fitness: Fitness) -> u64 {
    (record_words(world, RecordRequest(&[fitness])) * size_of::<u32>()) as u64
}

/// Returns the weights of a team as an episode on a GPU loads them, in fours.
fn fours(world: &World) -> usize {
    world.leaders() * world.parameters().div_ceil(FOUR)
}

/// Returns the bytes of a team's weights as an episode on a GPU loads them.
pub(crate) fn weight_bytes(world: &World) -> u64 {
    (fours(world) * size_of::<[f32; FOUR]>()) as u64
}

/// Returns the bytes of a team's states that a GPU keeps between dispatches, 0 if one dispatch plays the whole episode.
pub(crate) fn state_bytes(world: &World, fitness: Fitness) -> u64 {
    #[cfg(feature = "gpu")]
    let bytes = gpu::episode::state_bytes(world, RecordRequest(&[fitness]));
    #[cfg(not(feature = "gpu"))]
    let bytes = {
        let _ = (world, fitness);
        0
    };
    bytes
}

/// Returns the bytes of a trial's populations, `[populations, slots, parameters]`, on a GPU that holds them: one buffer
/// per population, one more, and every slot's parent. 0 if they are too small to be held by default.
pub(crate) fn held_bytes([populations, slots, parameters]: [usize; 3]) -> u64 {
    let [populations, population, parents] =
        [populations, 4 * slots * parameters, 4 * populations * slots].map(|count| count as u64);
    if populations * population < HELD_FROM { 0 } else { (populations + 1) * population + parents }
}
