//! The interface between training and the hardware: whole episodes of many teams.
//!
//! | file | holds |
//! |---|---|
//! | `batch` | what is to be played: groups of teams, where their policies are, what is needed of them |
//! | `record` | what one team did, as far as credit needs it |
//! | `trace` | every stage of every step, for comparison and replays |
//! | `error` | why episodes could not be played |

use std::any::Any;
use std::fmt::Debug;

use crate::evolve::Breeding;
use crate::parallel::current_num_threads;
use crate::world::World;

mod batch;
pub mod compare;
pub mod cpu;
mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
mod record;
mod trace;

pub use batch::{Group, Need, Weights};
pub use error::BackendError;
pub use record::{Episode, Seen, Strided, owner_bits};
pub use trace::{Moment, Trace};

/// Plays episodes. Every implementation gives the same bits.
pub trait Backend: Send {
    /// Plays every team of every group once.
    ///
    /// # Errors
    /// A group does not fit together or does not fit the device, or the device failed.
    fn rollout(&mut self, groups: &[Group<'_>], visit: &Visit<'_>) -> Result<(), BackendError>;

    /// Plays one group and keeps every stage of every step.
    ///
    /// # Errors
    /// As for [`Backend::rollout`].
    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError>;

    /// Takes the populations of one trial, `[populations][slots][parameters]`, a leader's each or one for all, into
    /// memory of its own, to breed them there; none where they had better stay on the host.
    ///
    /// # Errors
    /// They were asked to be held here and do not fit, or the device failed.
    fn hold(&mut self, _weights: &[f32], _sizes: [usize; 3]) -> Result<Option<Box<dyn Held>>, BackendError> {
        Ok(None)
    }

    /// What it runs on, for people: "cpu (AVX2, 2 threads)".
    fn describe(&self) -> String;
}

/// Called once for each team, from any thread, in any order.
pub type Visit<'a> = dyn Fn(Episode<'_>) + Sync + 'a;

/// The populations of one trial in a backend's own memory; dropped, they leave it.
///
/// After an error they may be of any generation.
pub trait Held: Any + Debug + Send + Sync {
    /// Makes the next generation, to the bits of [`crate::evolve::mutate`].
    ///
    /// # Errors
    /// The plan does not fit the populations, or the device failed.
    fn breed(&mut self, breeding: &Breeding<'_>) -> Result<(), BackendError>;

    /// Copies all weights to the host, `[populations][slots][parameters]`.
    ///
    /// # Errors
    /// The device failed.
    fn fetch(&self, weights: &mut [f32]) -> Result<(), BackendError>;
}

/// What a run runs on, for `run.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Machine {
    /// "cpu" or "gpu".
    pub backend: String,
    /// What the GPU calls itself.
    pub adapter: Option<String>,
    /// The GPU's driver and its version.
    pub driver: Option<String>,
    /// Threads of the CPU that work.
    pub threads: usize,
}

impl Machine {
    /// The CPU, on the threads that there are.
    pub fn of_cpu() -> Machine {
        Machine { backend: "cpu".into(), threads: current_num_threads(), ..Machine::default() }
    }

    /// What a GPU backend runs on.
    #[cfg(feature = "gpu")]
    pub fn of_gpu(backend: &gpu::episode::GpuEpisodes) -> Machine {
        let adapter = &backend.gpu().adapter;
        Machine {
            backend: "gpu".into(),
            adapter: Some(adapter.name.clone()),
            driver: Some(adapter.driver.clone()),
            threads: current_num_threads(),
        }
    }
}

/// A backend and what it is.
pub type Player = (Box<dyn Backend>, Machine);

/// Populations of a trial that take so many bytes are held where nothing else is asked for, but never by a software
/// renderer: about what goes over the bus in the time of the few dispatches that holding costs. An estimate, not a
/// measurement.
pub const HELD_FROM: u64 = 1 << 20;

/// Records of a batch that take so many bytes are packed where nothing else is asked for, but never by a software
/// renderer: about what goes over the bus in the time that one more dispatch costs. An estimate, not a measurement.
pub const PACKED_FROM: u64 = 1 << 20;

/// Bytes of one buffer that a batch on a GPU aims for: enough to fill it, small enough to overlap batches.
pub const BATCH_BYTES: u64 = 256 << 20;
/// Weights that a GPU's thread reads at once.
const FOUR: usize = 4;

/// Words of a team's record: sets, counts and, where they are needed, sights.
fn record_words(world: &World, need: Need) -> usize {
    let sights = if need.sights() { world.sight_words() } else { 0 };
    world.set_words() + world.leaders() * world.followers() + sights
}

/// Bytes of a team's record.
pub fn record_bytes(world: &World, need: Need) -> u64 {
    (record_words(world, need) * size_of::<u32>()) as u64
}

/// Weights of a team as an episode on a GPU reads them, four at a time.
fn fours(world: &World) -> usize {
    world.leaders() * world.parameters().div_ceil(FOUR)
}

/// Bytes of a team's weights as an episode on a GPU reads them.
pub fn weight_bytes(world: &World) -> u64 {
    (fours(world) * size_of::<[f32; FOUR]>()) as u64
}

/// Bytes that a GPU holds of a trial's populations, `[populations, slots, parameters]`, where it does: a buffer a
/// population and one more, and every slot's parent.
pub fn held_bytes([populations, slots, parameters]: [usize; 3]) -> u64 {
    let [populations, population, parents] =
        [populations, 4 * slots * parameters, 4 * populations * slots].map(|count| count as u64);
    if populations * population < HELD_FROM { 0 } else { (populations + 1) * population + parents }
}
