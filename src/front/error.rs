//! The error of the functions in this module.

use crate::backend::BackendError;
use crate::config::{ConfigError, MAX_POPULATION};
use crate::evaluate::MAX_EPISODES;
use crate::evolve::MAX_WEIGHT;
use crate::memory::TooLittle;
use crate::stepping::StepError;

/// The error of a function in [`crate::front`]. A failed call changes nothing.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Failure {
    /// All problems of a config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The machine has less memory than the training needs.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// The system cannot allocate the memory.
    #[error("not enough memory for {what}, {bytes} bytes")]
    Memory {
        /// The purpose of the memory.
        what: &'static str,
        /// Number of bytes requested.
        bytes: u128,
    },
    /// Episodes could not be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The number of teams is not allowed.
    #[error("{0} teams; there may be 1 to {MAX_POPULATION}")]
    Teams(usize),
    /// The number of weights does not match the teams.
    #[error(
        "{found} weights for {teams} teams; [leaders][teams][parameters] are [{leaders}][{teams}][{parameters}], or \
         [1][{teams}][{parameters}] if leaders share a policy"
    )]
    Weights {
        /// Number of weights given.
        found: usize,
        /// Number of leaders per team.
        leaders: usize,
        /// Number of teams requested.
        teams: usize,
        /// Number of weights per policy.
        parameters: usize,
    },
    /// The number of trials with given policies does not match the config.
    #[error(
        "{found} trials have policies, but the config has {trials} trials; pass one array for all trials, or one per trial"
    )]
    Trials {
        /// Number of trials given.
        found: usize,
        /// Number of trials of the config.
        trials: usize,
    },
    /// A weight is too large or not a number.
    #[error(
        "weight {parameter} of the policy of leader {leader} in team {team} is {value}, allowed are -{MAX_WEIGHT} to {MAX_WEIGHT}"
    )]
    Weight {
        /// Index of the leader in its team.
        leader: usize,
        /// Index of the team, from 0.
        team: usize,
        /// Index of the weight in the policy.
        parameter: usize,
        /// The value given.
        value: f32,
    },
    /// The starts cannot be drawn.
    #[error(
        "{episodes} episodes from starts moved by up to {jitter}; allowed are 1 to {MAX_EPISODES} episodes and a jitter of 0 or more"
    )]
    Starts {
        /// Number of episodes per team.
        episodes: u32,
        /// The jitter in units.
        jitter: f64,
    },
    /// [`Starts`](crate::evaluate::Starts) has no such episode.
    #[error("episode {episode} of {episodes} (they count from 0)")]
    NoEpisode {
        /// The requested episode, from 0.
        episode: usize,
        /// Number of episodes.
        episodes: usize,
    },
    /// The given fitness has the wrong size, or is not finite.
    #[error("fitness: {0}")]
    Fitness(String),
    /// The paths cannot be scored.
    #[error("positions: {0}")]
    Paths(String),
    /// A saved state does not fit the config.
    #[error("the state is of another config, or damaged")]
    State,
    /// All generations were played.
    #[error("all generations were played")]
    Done,
    /// The teams could not be created.
    #[error(transparent)]
    Step(#[from] StepError),
}
