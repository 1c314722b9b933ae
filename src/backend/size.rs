//! How many bytes episodes and populations take.

use super::{BackendError, MOMENT_WORDS};
use crate::config::Fitness;
use crate::credit::RecordRequest;
use crate::world::World;

/// Default minimum bytes of a trial's populations to be held on a GPU. Measured on an NVIDIA H100: generations are faster
/// from 230 KB on, and about the same at 90 KB (`benches/README.md`). Software renderers hold none.
pub const HELD_FROM: u64 = 1 << 17;

/// Target bytes of one buffer of a batch on a GPU: enough to fill the device, small enough to overlap batches.
pub const BATCH_BYTES: u64 = 256 << 20;
/// Weights per vector. A GPU thread loads one vector at a time.
pub(super) const VECTOR: usize = 4;
/// Neighbouring weights of a policy.
pub(super) type WeightVector = [f32; VECTOR];

/// Returns the words of a team's record: sets, counts and, if needed, sightings.
pub(super) fn record_words(world: &World, records: RecordRequest<'_>) -> usize {
    let sights = if records.sights() { world.sight_words() } else { 0 };
    // One word per POI says whether it is gone.
    let gone = if world.gone_within.is_empty() { 0 } else { world.pois.len() };
    world.set_words() + world.leaders() * world.followers() + sights + gone
}

/// Returns the bytes of the record of a team that is scored by a fitness, with its trace if scores need paths.
pub fn record_bytes(world: &World, fitness: Fitness) -> u64 {
    let traced = if world.paths.is_some() { (world.steps() + 1) * traced_words(world) } else { 0 };
    ((record_words(world, RecordRequest(&[fitness])) + traced) * size_of::<u32>()) as u64
}

/// Returns the maximum bytes of the sums that a GPU counts of a team's record.
pub fn sum_bytes(world: &World) -> u64 {
    ((1 + world.leaders()) * size_of::<u32>()) as u64
}

/// Returns the maximum bytes of a team's [`Trace`](super::Trace).
pub fn trace_bytes(world: &World) -> u64 {
    let moments = (world.steps() + 1) * (traced_words(world) + 2 * world.agents());
    ((record_words(world, RecordRequest(&[Fitness::Dt])) + moments) * size_of::<u32>()) as u64
}

/// Returns the words of one step of a team's trace: moments, then inputs.
pub(super) fn traced_words(world: &World) -> usize {
    world.agents() * MOMENT_WORDS + world.leaders() * world.inputs()
}

/// Returns the vectors of a team's weights.
pub(super) fn weight_vectors(world: &World) -> usize {
    world.leaders() * world.parameters().div_ceil(VECTOR)
}

/// Returns the bytes of a team's weights as an episode on a GPU loads them.
pub fn weight_bytes(world: &World) -> u64 {
    (weight_vectors(world) * size_of::<WeightVector>()) as u64
}

/// Returns the bytes of a team's states that a GPU keeps between dispatches, 0 if one dispatch plays the whole episode, and
/// of its share of the tasks of all dispatches.
pub fn dispatch_bytes(world: &World, fitness: Fitness) -> [u64; 2] {
    #[cfg(feature = "gpu")]
    let bytes = super::gpu::episode::dispatch_bytes(world, RecordRequest(&[fitness]));
    #[cfg(not(feature = "gpu"))]
    let bytes = {
        let _ = (world, fitness);
        [0; 2]
    };
    bytes
}

/// Returns the bytes of a trial's populations, `[populations, slots, parameters]`, on a GPU that holds them: one buffer
/// per population, one more, and every slot's parent. 0 if they are too small to be held by default.
pub fn held_bytes([populations, slots, parameters]: [usize; 3]) -> u64 {
    let [populations, population, parents] =
        [populations, 4 * slots * parameters, 4 * populations * slots].map(|count| count as u64);
    if populations * population < HELD_FROM { 0 } else { (populations + 1) * population + parents }
}

/// Checks that so many weights fill populations of these sizes, `[populations, slots, parameters]`.
///
/// # Errors
/// There are too few or too many weights, or a size is 0.
#[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only GPUs hold populations"))]
pub(super) fn check_sizes(weights: usize, sizes: [usize; 3]) -> Result<(), BackendError> {
    let expected = sizes.into_iter().try_fold(1, usize::checked_mul);
    if weights > 0 && expected == Some(weights) {
        return Ok(());
    }
    let [populations, slots, parameters] = sizes;
    Err(BackendError::InvalidInput(format!(
        "the populations cannot be held: {weights} weights for {populations} populations of {slots} slots with \
         {parameters} parameters; no size may be 0, and their product is the number of weights"
    )))
}
