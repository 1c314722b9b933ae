//! Batches of points that fit in memory to train side by side, and their progress.

use super::Point;
use flotilla::config::{StageConfig, ValidConfig};

/// Maximum number of points per batch. Each keeps two files open, and most systems allow a process at least 1024.
const MAX_BATCH: usize = 400;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SweepProgress {
    /// Number of finished points, including those finished earlier.
    pub done: usize,
    pub points: usize,
    /// Number of unfinished points in the batch.
    pub batch: usize,
    /// The lowest next generation in the batch.
    pub generation: usize,
    /// The highest last generation in the batch.
    pub last: usize,
    /// Team-steps played so far in this process.
    pub played: u128,
    /// Team-steps to be played in this process.
    pub total: u128,
}

/// Returns the bytes for training a point: its policies three times (this generation, the next, a checkpoint) and its
/// scores.
pub fn bytes(config: &ValidConfig) -> usize {
    let learning = &config.learning;
    let episodes = config.stages().iter().map(|(_, config)| config.learning.episodes_per_team).max().unwrap_or(1);
    let scores = learning.trials * config.max_teams() * (config.learners() + 1) * (episodes + 2);
    let champions = learning.trials * config.populations() * config.parameters() * (1 + learning.hall_of_fame);
    let bytes = 3 * config.policy_bytes() + ((3 * champions + scores) * size_of::<f32>()) as u64;
    bytes.try_into().unwrap_or(usize::MAX)
}

pub(crate) fn team_steps(config: &ValidConfig) -> u128 {
    let of_stage = |(generations, config): (usize, &StageConfig)| {
        let teams = config.learning.trials * config.max_teams() * config.learning.episodes_per_team;
        teams as u128 * config.world.steps as u128 * generations as u128
    };
    config.stage_lengths().map(of_stage).sum()
}

/// Splits points into batches that fit in memory, in order. A point that does not fit is a batch of its own.
pub fn batches<'a>(points: &'a [&'a Point], memory: usize) -> Vec<&'a [&'a Point]> {
    let mut rest = points;
    let mut batches = Vec::new();
    while !rest.is_empty() {
        let mut used = 0_usize;
        let fits = rest.iter().take(MAX_BATCH).take_while(|point| {
            used = used.saturating_add(bytes(&point.config));
            used <= memory
        });
        let (batch, later) = rest.split_at(fits.count().max(1));
        batches.push(batch);
        rest = later;
    }
    batches
}

/// Returns the last generation of a point.
pub(crate) fn last(point: &Point) -> usize {
    point.config.learning.generations
}

/// Returns the team-steps that a point has played before a generation.
pub(crate) fn played(point: &Point, next: usize) -> u128 {
    let generations = last(point) + 1;
    team_steps(&point.config) / generations as u128 * next.min(generations) as u128
}
