//! Trains points side by side: all trials of all of them in one batch a generation, each recorded as a run of its own.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use super::Point;
use super::results::point_folder;
use crate::backend::Backend;
use crate::config::Config;
use crate::record::RecordError;
use crate::record::checkpoint::{self, Checkpoint, Keeper, Schedule, Snapshot};
use crate::record::disk::Disk;
use crate::record::folder::{self, Folder, METRICS, POLICIES, Run, Start, State};
use crate::record::metrics::{self, Row};
use crate::record::policies;
use crate::run::{Machine, RunError};
use crate::trainer::Trainer;

/// How often the points hand their metrics to the system.
const FLUSH: Duration = Duration::from_secs(1);
/// Most points in one batch: each keeps two files open, and systems allow a process 1024.
const MAX_BATCH: usize = 400;
/// Most checkpoints being written at a time, each by a thread of its own.
const MAX_WRITERS: usize = 32;

/// How points are run.
pub struct Options<'a> {
    pub start: Start,
    /// Bytes that the points of a batch may take; more points than fit run in several batches, to the same results.
    pub memory: usize,
    pub machine: Machine,
    /// Set by whoever wants the points to finish their generation, save and stop.
    pub stop: &'a AtomicBool,
    /// Set by whoever wants a checkpoint now.
    pub save: &'a AtomicBool,
    /// Told of every generation played.
    pub watch: &'a mut dyn FnMut(&Progress),
    /// Told what was found in a point's folder that the user should know.
    pub note: &'a mut dyn FnMut(&Point, &str),
}

/// How far the points have come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Points done, those found done included, of all.
    pub done: usize,
    pub points: usize,
    /// Points in the batch, the generation it plays next, and the last of any of its points.
    pub batch: usize,
    pub generation: usize,
    pub last: usize,
    /// Steps of a team played so far, by all points that are being or have been run now, and still to play.
    pub played: u128,
    pub total: u128,
}

/// How it ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    Done,
    /// Everything is saved.
    Stopped,
}

/// Bytes that a point's run takes: three times its policies (this generation, the next, a checkpoint) and what its
/// teams score.
pub fn bytes(config: &Config) -> usize {
    let learning = &config.learning;
    let scores =
        learning.trials * (learning.population + 1) * (config.learners() + 1) * (learning.episodes_per_team + 2);
    3 * (config.policy_bytes() + learning.trials * config.learners() * config.parameters() * size_of::<f32>())
        + scores * size_of::<f32>()
}

/// Steps of a team that a point takes until it is done.
fn team_steps(config: &Config) -> u128 {
    let learning = &config.learning;
    let teams = learning.trials * (learning.population + 1) * learning.episodes_per_team;
    teams as u128 * config.world.steps as u128 * (learning.generations + 1) as u128
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
pub fn run(
    points: &[&Point],
    out: &Path,
    backend: &mut dyn Backend,
    options: &mut Options<'_>,
) -> Result<Ended, RunError> {
    let total = points.iter().map(|point| team_steps(&point.config)).sum();
    let mut progress = Progress { done: 0, points: points.len(), batch: 0, generation: 0, last: 0, played: 0, total };
    for batch in batches(points, options.memory) {
        let mut opened = Vec::new();
        for point in batch {
            match Member::open(point, out, options)? {
                Some(member) => opened.push(member),
                None => {
                    progress.done += 1;
                    progress.total -= team_steps(&point.config);
                }
            }
        }
        // Points killed while checkpoints were being written may stand at different generations.
        opened.sort_by_key(|(member, _)| (member.generation, member.point.index));
        while !opened.is_empty() {
            let generation = opened[0].0.generation;
            let later = opened.iter().position(|(member, _)| member.generation != generation).unwrap_or(opened.len());
            let rest = opened.split_off(later);
            if Batch::new(opened, generation)?.train(backend, options, &mut progress)? == Ended::Stopped {
                return Ok(Ended::Stopped);
            }
            opened = rest;
        }
    }
    Ok(Ended::Done)
}

/// A point in its folder.
struct Member<'a> {
    point: &'a Point,
    folder: Folder,
    metrics: metrics::Writer,
    keeper: Keeper,
    run: Run,
    /// Time trained in earlier sessions.
    before: f64,
    /// The generation that plays next.
    generation: usize,
    done: bool,
}

impl<'a> Member<'a> {
    /// The point and where it goes on; none where it is done already.
    fn open(
        point: &'a Point,
        out: &Path,
        options: &mut Options<'_>,
    ) -> Result<Option<(Member<'a>, Option<Snapshot>)>, RunError> {
        let disk = Disk::default();
        let (folder, found) = Folder::open(&point_folder(out, point), options.start, &point.config, disk.clone())?;
        for note in &found.notes {
            (options.note)(point, note);
        }
        if found.finished.is_some() {
            return Ok(None);
        }
        let (metrics, before, snapshot) = match found.checkpoint {
            Some((Checkpoint { snapshot, seconds, .. }, metrics)) => (metrics, seconds, Some(snapshot)),
            None => {
                let path = folder.file(METRICS);
                let metrics =
                    metrics::Writer::create(&disk, &path).map_err(|error| RecordError::Write { path, error })?;
                (metrics, 0.0, None)
            }
        };
        let generation = snapshot.as_ref().map_or(0, |snapshot| snapshot.generation);
        let checkpoints = folder.file(folder::CHECKPOINTS);
        let keeper = Keeper::new(disk, checkpoints, vec![point.config.clone()], found.kept, generation);
        let run = found.run.unwrap_or_else(|| Run::new(&point.config));
        Ok(Some((Member { point, folder, metrics, keeper, run, before, generation, done: false }, snapshot)))
    }

    fn last(&self) -> usize {
        self.point.config.learning.generations
    }

    fn write_run(&mut self, state: State, seconds: f64, digest: Option<String>) -> Result<(), RecordError> {
        self.run.state = state;
        self.run.updated = folder::now();
        self.run.seconds = self.before + seconds;
        self.run.generations = self.generation.min(self.last() + 1);
        self.run.digest = digest;
        self.folder.write_run(&self.run)
    }

    fn metrics_failed(&self) -> impl FnOnce(std::io::Error) -> RecordError + use<> {
        let path = self.folder.file(METRICS);
        move |error| RecordError::Write { path, error }
    }

    /// Starts writing a checkpoint of a snapshot of this point alone.
    fn save(&mut self, snapshot: Snapshot, seconds: f64) -> Result<(), RecordError> {
        let since = Instant::now();
        let (metrics, output) = self.metrics.mark().map_err(self.metrics_failed())?;
        let (config, seconds) = (checkpoint::digest(&self.point.config), self.before + seconds);
        self.keeper.save(Checkpoint { config, seconds, metrics, snapshot }, output, since)
    }

    /// Writes what came out.
    fn finish(&mut self, trials: &[&[f32]], seconds: f64) -> Result<(), RecordError> {
        self.keeper.wait()?;
        let (_, output) = self.metrics.mark().map_err(self.metrics_failed())?;
        output.sync().map_err(self.metrics_failed())?;
        policies::write(&self.folder.disk, &self.folder.file(POLICIES), &self.point.config, trials)?;
        let (_, digest) = self.folder.digest(&self.point.config, trials)?;
        self.write_run(State::Done, seconds, Some(digest))?;
        self.done = true;
        Ok(())
    }
}

/// Points at the same generation, training together.
struct Batch<'a> {
    members: Vec<Member<'a>>,
    trainer: Trainer,
    since: Instant,
}

impl<'a> Batch<'a> {
    fn new(opened: Vec<(Member<'a>, Option<Snapshot>)>, generation: usize) -> Result<Batch<'a>, RunError> {
        let bytes = opened.iter().map(|(member, _)| bytes(&member.point.config)).sum();
        Vec::<u8>::new()
            .try_reserve_exact(bytes)
            .map_err(|_| RunError::Memory { what: "the policies of all trials of a batch of points", bytes })?;
        let (members, snapshots): (Vec<_>, Vec<_>) = opened.into_iter().unzip();
        let configs: Vec<Config> = members.iter().map(|member: &Member<'_>| member.point.config.clone()).collect();
        let mut trainer = Trainer::new(configs);
        let snapshots: Option<Vec<Snapshot>> = snapshots.into_iter().collect();
        if let Some(snapshots) = snapshots {
            let mut joined = Snapshot { generation, weights: vec![], fitness: vec![], pending: vec![] };
            for (arm, mut snapshot) in snapshots.into_iter().enumerate() {
                snapshot.pending.iter_mut().flatten().flatten().for_each(|row| row.arm = arm);
                joined.weights.append(&mut snapshot.weights);
                joined.fitness.append(&mut snapshot.fitness);
                joined.pending.append(&mut snapshot.pending);
            }
            if !trainer.restore(joined) {
                unreachable!("checkpoints are read in the sizes of their configs");
            }
        }
        Ok(Batch { members, trainer, since: Instant::now() })
    }

    fn train(
        mut self,
        backend: &mut dyn Backend,
        options: &mut Options<'_>,
        progress: &mut Progress,
    ) -> Result<Ended, RunError> {
        let (done, before) = (progress.done, progress.played);
        progress.batch = self.members.len();
        progress.last = self.members.iter().map(Member::last).max().unwrap_or(0);
        for member in &mut self.members {
            // Steps that an earlier session played are none of this one's.
            progress.total -= played(member);
            let Machine { backend: kind, adapter, driver, threads } = options.machine.clone();
            let version = env!("CARGO_PKG_VERSION").to_string();
            member.run = Run { version, backend: kind, adapter, driver, threads, ..member.run.clone() };
            member.run.description = backend.describe();
            member.run.sessions = member.run.sessions.saturating_add(1);
            member.write_run(State::Running, 0.0, None)?;
        }
        let resumed: u128 = self.members.iter().map(played).sum();
        let mut flushed = Instant::now();
        loop {
            self.finish()?;
            progress.generation = self.trainer.generation();
            progress.done = done + self.members.iter().filter(|member| member.done).count();
            progress.played = before + self.members.iter().map(played).sum::<u128>() - resumed;
            (options.watch)(progress);
            if self.trainer.is_done() {
                return Ok(Ended::Done);
            }
            if options.stop.load(Relaxed) {
                self.stop()?;
                return Ok(Ended::Stopped);
            }
            if options.save.swap(false, Relaxed) || self.is_due() {
                match self.save() {
                    // The device failed, which the next generation makes up for or ends at.
                    Err(RunError::Held(_)) => options.save.store(true, Relaxed),
                    saved => saved?,
                }
            }
            let rows = match self.trainer.advance(backend) {
                Ok(rows) => rows,
                Err(error) => {
                    let generation = self.trainer.generation();
                    return Err(RunError::Backend { error, generation, saved: self.stop().map_err(Box::new) });
                }
            };
            self.add(rows)?;
            if flushed.elapsed() >= FLUSH {
                for member in self.members.iter_mut().filter(|member| !member.done) {
                    member.metrics.flush().map_err(member.metrics_failed())?;
                }
                flushed = Instant::now();
            }
        }
    }

    /// Adds complete rows, which come by arm, to their points.
    fn add(&mut self, mut rows: Vec<Row>) -> Result<(), RunError> {
        let (generation, seconds) = (self.trainer.generation(), self.since.elapsed().as_secs_f64());
        rows.sort_by_key(|row| (row.arm, row.generation, row.trial));
        for rows in rows.chunk_by(|a, b| a.arm == b.arm) {
            let member = &mut self.members[rows[0].arm];
            member.metrics.add(rows, member.before + seconds).map_err(member.metrics_failed())?;
        }
        for member in self.members.iter_mut().filter(|member| !member.done) {
            member.generation = generation;
            member.keeper.poll()?;
        }
        Ok(())
    }

    /// Writes what came out of the points that have just played their last champion.
    fn finish(&mut self) -> Result<(), RunError> {
        let seconds = self.since.elapsed().as_secs_f64();
        for (arm, member) in self.members.iter_mut().enumerate() {
            if !member.done && member.generation > member.last() + 1 {
                member.finish(&self.trainer.best_policies(arm), seconds)?;
            }
        }
        Ok(())
    }

    /// Whether any point wants a checkpoint; then all make one, so that they go on together.
    fn is_due(&self) -> bool {
        let generation = self.trainer.generation();
        self.members.iter().filter(|member| !member.done).any(|member| {
            let checkpoint = &member.point.config.checkpoint;
            let schedule = Schedule { generations: checkpoint.generations, seconds: checkpoint.seconds };
            member.keeper.is_due(&schedule, generation)
        })
    }

    /// Starts writing a checkpoint of every point that is not done.
    fn save(&mut self) -> Result<(), RunError> {
        let seconds = self.since.elapsed().as_secs_f64();
        let bytes = self.members.iter().map(|member| member.point.config.policy_bytes()).sum();
        let of_snapshot = |error| RunError::of_snapshot(error, "checkpoints beside training", bytes);
        let snapshot = self.trainer.snapshot().map_err(of_snapshot)?;
        let Snapshot { generation, weights, fitness, pending } = snapshot;
        let parts = weights.into_iter().zip(fitness).zip(pending);
        let waiting = self.members.iter_mut().zip(parts).filter(|(member, _)| !member.done);
        let mut writing: Vec<&mut Member<'_>> = Vec::new();
        for (member, ((weights, fitness), pending)) in waiting {
            if member.keeper.newest() == Some(generation) {
                continue;
            }
            let (weights, fitness, pending) = (vec![weights], vec![fitness], vec![pending]);
            member.save(Snapshot { generation, weights, fitness, pending }, seconds)?;
            writing.push(member);
            if writing.len() == MAX_WRITERS {
                writing.drain(..).try_for_each(|member| member.keeper.wait())?;
            }
        }
        Ok(())
    }

    /// Saves and waits until all is on the disk.
    fn stop(&mut self) -> Result<(), RunError> {
        let seconds = self.since.elapsed().as_secs_f64();
        let going = |member: &&mut Member<'_>| !member.done;
        self.members.iter_mut().filter(going).try_for_each(|member| member.keeper.wait())?;
        self.save()?;
        for member in self.members.iter_mut().filter(going) {
            member.keeper.wait()?;
            member.write_run(State::Stopped, seconds, None)?;
        }
        Ok(())
    }
}

/// Steps of a team that a point has played.
fn played(member: &Member<'_>) -> u128 {
    let generations = member.last() + 1;
    team_steps(&member.point.config) / generations as u128 * member.generation.min(generations) as u128
}
