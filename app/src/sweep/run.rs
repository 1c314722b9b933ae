//! Training of points side by side, in batches that fit in memory. Each point is recorded as a run.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use super::Point;
use super::results::point_folder;
use crate::record::disk::Disk;
use crate::record::folder::{self, Note, Start};
use crate::run::{self, RunError, Session, SessionEnd};
use flotilla::backend::OpenBackend;
use flotilla::config::{Config, StageConfig, ValidConfig};

/// Maximum number of points per batch. Each keeps two files open, and most systems allow a process at least 1024.
const MAX_BATCH: usize = 400;

/// The options of training points.
pub struct SweepOptions<'a> {
    /// The treatment of existing runs.
    pub start: Start,
    /// The disk within the sweep's folder, or within one above it.
    pub disk: &'a Disk,
    /// Bytes for the points of a batch. The number of batches does not change the results.
    pub memory: usize,
    /// The options of the runs, except `watch`.
    pub runs: run::Options<'a>,
    /// Called after every generation.
    pub watch: &'a mut dyn FnMut(&SweepProgress),
    /// Called with every note about a point's folder.
    pub note: &'a mut dyn FnMut(&Point, &Note),
}

/// The progress of the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepProgress {
    /// Number of finished points, including those finished earlier.
    pub done: usize,
    /// Number of points.
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

/// Returns the team-steps of a point.
fn team_steps(config: &ValidConfig) -> u128 {
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

/// Trains points, each in its folder in `out`, or resumes them.
///
/// # Errors
/// A folder cannot be used or written, memory is insufficient, or the backend fails. Earlier progress is saved.
pub fn run(
    points: &[&Point],
    out: &Path,
    backend: &mut OpenBackend,
    options: &mut SweepOptions<'_>,
) -> Result<SessionEnd, RunError> {
    let total = points.iter().map(|point| team_steps(&point.config)).sum();
    let mut progress =
        SweepProgress { done: 0, points: points.len(), batch: 0, generation: 0, last: 0, played: 0, total };
    // All folders are checked first, so that no batch trains before a later one is refused.
    let folders: Vec<PathBuf> = points.iter().map(|point| point_folder(out, point)).collect();
    let disk = options.disk;
    let configs = points.iter().map(|point| &*point.config);
    folder::check(disk, folders.iter().map(|path| &**path).zip(configs), options.start)?;
    for batch in batches(points, options.memory) {
        if options.runs.stop.load(Relaxed) {
            return Ok(SessionEnd::Stopped);
        }
        let runs = batch.iter().map(|point| (Config::clone(&point.config), point_folder(out, point))).collect();
        let (mut session, notes) = Session::open(runs, options.start, disk)?;
        notes.iter().for_each(|(run, note)| (options.note)(batch[*run], note));
        // Steps of earlier sessions do not count.
        let resumed: u128 = batch.iter().zip(session.generations()).map(|(point, &next)| played(point, next)).sum();
        progress.total -= resumed;
        let (done, before, watch) = (progress.done, progress.played, &mut *options.watch);
        let mut tell = |generations: &[usize]| {
            let all = || batch.iter().zip(generations);
            let going = || all().filter(|(point, next)| **next <= last(point) + 1);
            progress.batch = going().count();
            progress.done = done + batch.len() - progress.batch;
            progress.generation = going().map(|(_, &next)| next).min().unwrap_or(progress.last + 1);
            progress.last = batch.iter().map(|point| last(point)).max().unwrap_or(0);
            progress.played = before + all().map(|(point, &next)| played(point, next)).sum::<u128>() - resumed;
            watch(&progress);
        };
        tell(session.generations());
        let mut watch = |now: &run::Progress<'_>| tell(now.generations);
        let run::Options { command, stop, save, ref mut fallback, .. } = options.runs;
        let mut runs = run::Options { command, stop, save, fallback, watch: &mut watch };
        if !session.is_done() && session.train(backend, &mut runs)? == SessionEnd::Stopped {
            return Ok(SessionEnd::Stopped);
        }
    }
    Ok(SessionEnd::Finished)
}

/// Returns the last generation of a point.
fn last(point: &Point) -> usize {
    point.config.learning.generations
}

/// Returns the team-steps that a point has played before a generation.
fn played(point: &Point, next: usize) -> u128 {
    let generations = last(point) + 1;
    team_steps(&point.config) / generations as u128 * next.min(generations) as u128
}
