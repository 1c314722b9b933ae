//! Bytes that a trainer allocates, for estimates before a run.

use crate::config::{Config, ValidConfig};

/// Words of 4 bytes per episode of a batch, on any backend.
const EPISODE_WORDS: u64 = 40;

/// Returns the bytes that the trials of a config take on any backend, in the stage that takes most.
pub fn bytes(config: &ValidConfig) -> u64 {
    max_over_stages(config, bytes_of_stage) + previous_stage_bytes(config)
}

/// Returns the bytes of the next generation's schedules, drawn while a backend that holds the populations plays.
pub fn next_schedule_bytes(config: &ValidConfig) -> u64 {
    max_over_stages(config, schedule_bytes) + previous_stage_bytes(config)
}

/// Returns the bytes of the numbers in a [`Snapshot`](super::Snapshot) of a valid config's experiment.
pub fn snapshot_bytes(config: &Config) -> u64 {
    let ([trials, populations, policies, parameters], slots) = (sizes(config), config.learning.slots() as u64);
    4 * trials * populations * (slots * parameters + policies)
}

/// Returns the largest number of bytes that any stage takes.
fn max_over_stages(config: &ValidConfig, bytes: fn(&Config) -> u64) -> u64 {
    config.stages().iter().map(|(_, config)| bytes(config)).max().unwrap_or(0)
}

/// Returns the bytes of all trials in one stage.
fn bytes_of_stage(config: &Config) -> u64 {
    let ([trials, populations, policies, parameters], leaders) = (sizes(config), config.learners() as u64);
    let (slots, episodes) = (config.learning.slots() as u64, config.learning.episodes_per_team as u64);
    let teams = config.max_teams() as u64;
    let weights = 2 * populations * slots * parameters;
    let fitness_and_parents = populations * (policies + slots);
    let observed_and_scores = episodes * teams * (1 + leaders);
    // Scores are added up in 64 bits.
    let totals =
        if config.learning.partners > 1 || config.learning.hall_of_fame > 0 { 2 * populations * policies } else { 0 };
    4 * trials * (weights + fitness_and_parents + observed_and_scores + totals + episodes * EPISODE_WORDS)
        + schedule_bytes(config)
}

/// Returns the bytes of the start positions of the previous stage's champions, kept while the next stage begins.
fn previous_stage_bytes(config: &ValidConfig) -> u64 {
    if config.stages.is_empty() { 0 } else { max_over_stages(config, start_bytes) }
}

/// Returns the bytes of the team schedules of all trials.
fn schedule_bytes(config: &Config) -> u64 {
    let ([trials, populations, ..], leaders) = (sizes(config), config.learners() as u64);
    let teams = config.learning.teams() as u64;
    4 * trials * (populations * teams + leaders * config.max_teams() as u64) + start_bytes(config)
}

/// Returns the bytes of the start positions, and of the POI positions if they move.
fn start_bytes(config: &Config) -> u64 {
    let agents = (config.world.leaders.len() + config.world.followers.len()) as u64;
    let moved = if config.learning.poi_jitter > 0.0 { config.world.pois.len() as u64 } else { 0 };
    4 * config.learning.trials as u64 * config.learning.episodes_per_team as u64 * 2 * (agents + moved)
}

/// Returns `[trials, populations, policies, parameters]`.
fn sizes(config: &Config) -> [u64; 4] {
    let learning = &config.learning;
    [learning.trials, config.populations(), learning.population, config.parameters()].map(|count| count as u64)
}
