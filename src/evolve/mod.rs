//! Cooperative coevolution with an n-elites binary tournament (paper, Algorithm 1): team schedules, selection,
//! mutation. Instead of selection and mutation, [`strategy`] has evolution strategies.
//!
//! Every random number is a pure function of counters ([`random`]). Results therefore do not depend on threads, batch
//! size, backend, or on interruptions.

pub mod mutation;
pub mod random;
pub mod schedule;
pub mod selection;
pub mod strategy;
pub mod weights;

pub use mutation::{Breeding, InvalidInput, Offspring, breed, mutate, mutation_threshold};
pub use random::{Key, Purpose, noise};
pub use schedule::{aligned_teams, form_teams, jitter_pois, jitter_starts, past_champions, places, shuffle, teams_of};
pub use selection::{Selection, UNCHANGED, best, draw_parents, keep_parents, tournament};
pub use strategy::{Samples, Strategy};
pub use weights::{MAX_WEIGHT, MIN_WEIGHT, admit, is_weight, random_policy};
