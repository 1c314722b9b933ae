//! Trains points side by side, each recorded as a run of its own, in batches that fit in memory.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use super::Point;
use super::results::point_folder;
use crate::backend::Player;
use crate::config::Config;
use crate::record::disk::Disk;
use crate::record::folder::{self, Note, Start};
use crate::run::{self, Ended, RunError, Session};

/// Most points in one batch: each keeps two files open, and most systems allow a process 1024 or, where it asks as the
/// program does, more.
const MAX_BATCH: usize = 400;

/// How points are run.
pub struct Manner<'a> {
    /// What is to be done about runs that are there.
    pub start: Start,
    /// The disk within the sweep's folder, or within one above it.
    pub disk: &'a Disk,
    /// Bytes that the points of a batch may take; more points than fit run in several batches, to the same results.
    pub memory: usize,
    /// As for any run, but for its watch.
    pub runs: run::Options<'a>,
    /// Told of every generation played.
    pub watch: &'a mut dyn FnMut(&Headway),
    /// Told what was found in a point's folder.
    pub note: &'a mut dyn FnMut(&Point, &Note),
}

/// How far the points have come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Headway {
    /// Points done, those found done included.
    pub done: usize,
    /// Points in all.
    pub points: usize,
    /// Points in the batch.
    pub batch: usize,
    /// The generation that the first of the batch plays next.
    pub generation: usize,
    /// The last generation of any of the batch.
    pub last: usize,
    /// Steps of a team played so far, by all points that are being or have been run now.
    pub played: u128,
    /// Steps of a team, those to be played included.
    pub total: u128,
}

/// Bytes that a point's run takes: three times its policies (this generation, the next, a checkpoint) and what its
/// teams score.
pub fn bytes(config: &Config) -> usize {
    let learning = &config.learning;
    let episodes = config.staged().iter().map(|(_, config)| config.learning.episodes_per_team).max().unwrap_or(1);
    let scores = learning.trials * (learning.population + 1) * (config.learners() + 1) * (episodes + 2);
    let champions = learning.trials * config.populations() * config.parameters();
    let bytes = 3 * config.policy_bytes() + ((3 * champions + scores) * size_of::<f32>()) as u64;
    bytes.try_into().unwrap_or(usize::MAX)
}

/// Steps of a team that a point takes until it is done.
fn team_steps(config: &Config) -> u128 {
    let of_stage = |config: Config| {
        let learning = &config.learning;
        let teams = learning.trials * (learning.population + 1) * learning.episodes_per_team;
        teams as u128 * config.world.steps as u128 * (learning.generations + 1) as u128
    };
    config.shares().into_iter().map(of_stage).sum()
}

/// Cuts points into batches that fit in memory, in order; a point that does not fit is a batch of its own.
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

/// Runs points, each in its folder under `out`, or goes on with them.
///
/// # Errors
/// A folder cannot be used or written, there is too little memory, or the backend fails; what came before is saved.
pub fn run(points: &[&Point], out: &Path, player: &mut Player, options: &mut Manner<'_>) -> Result<Ended, RunError> {
    let total = points.iter().map(|point| team_steps(&point.config)).sum();
    let mut progress = Headway { done: 0, points: points.len(), batch: 0, generation: 0, last: 0, played: 0, total };
    // Nothing of an earlier batch is lost, either, to a point that cannot be had.
    let folders: Vec<PathBuf> = points.iter().map(|point| point_folder(out, point)).collect();
    let disk = options.disk;
    let configs = points.iter().map(|point| &point.config);
    folder::check(disk, folders.iter().map(|path| &**path).zip(configs), options.start)?;
    for batch in batches(points, options.memory) {
        if options.runs.stop.load(Relaxed) {
            return Ok(Ended::Stopped);
        }
        let runs = batch.iter().map(|point| (point.config.clone(), point_folder(out, point))).collect();
        let (mut session, notes) = Session::open(runs, options.start, disk)?;
        notes.iter().for_each(|(run, note)| (options.note)(batch[*run], note));
        // Steps that an earlier session played are none of this one's.
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
        let run::Options { command, stop, save, ref mut instead, ref mut setback, .. } = options.runs;
        let mut runs = run::Options { command, stop, save, instead, setback, watch: &mut watch };
        if !session.is_done() && session.train(player, &mut runs)? == Ended::Stopped {
            return Ok(Ended::Stopped);
        }
    }
    Ok(Ended::Done)
}

/// A point's last generation.
fn last(point: &Point) -> usize {
    point.config.learning.generations
}

/// Steps of a team that a point has played that plays a generation next.
fn played(point: &Point, next: usize) -> u128 {
    let generations = last(point) + 1;
    team_steps(&point.config) / generations as u128 * next.min(generations) as u128
}
