//! Cooperative coevolution with an n-elites binary tournament (paper, Algorithm 1): team schedules, selection,
//! mutation. Instead of selection and mutation, [`strategy`] has evolution strategies.
//!
//! Every random number is a pure function of counters ([`random`]). Results therefore do not depend on threads, batch
//! size, backend, or on interruptions.

mod mutation;
mod random;
mod schedule;
mod selection;
mod strategy;
mod weights;

#[cfg(feature = "gpu")]
pub(crate) use mutation::mutation_threshold;
pub use mutation::{Breeding, InvalidInput, mutate};
pub(crate) use mutation::{Offspring, breed};
pub(crate) use random::noise;
pub use random::{Key, Purpose};
pub use schedule::{
    TEST_EPISODES, TRAINING_EPISODES, aligned_teams, contemporary_teams, draw_headings, episode_positions, jitter_pois,
    jitter_starts, order_policies, past_champions,
};
pub use selection::{Selection, UNCHANGED, draw_parents, keep_parents, keep_teams, ranking, top_indices, tournament};
pub use strategy::{Samples, Strategy};
pub use weights::{MAX_WEIGHT, MIN_WEIGHT, flush_and_validate, initial_policy, is_weight, random_policy};
