//! Recorded runs, side by side: one trainer, and for each run its folder and its checkpoints. One run is a batch of
//! one.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::backend::{BackendError, Machine, OpenBackend};
use crate::config::{self, Config, ConfigError, ValidConfig};
use crate::host::Instant;
use crate::memory::{self, TooLittle};
use crate::record::checkpoint::{self, Checkpoint, Keeper, Schedule};
use crate::record::disk::Disk;
use crate::record::folder::{
    self, FileSums, Folder, METRICS, Note, Origin, POLICIES, Run, RunSums, Start, StartFrom, Status, Story,
};
use crate::record::metrics::{self, Extent};
use crate::record::policies::{self, Init, Policies};
use crate::record::{RecordError, config_digest};
use crate::trainer::{Row, Snapshot, SnapshotError, Trainer};

/// How often runs hand their metrics to the system.
const FLUSH: Duration = Duration::from_secs(1);
/// Most runs that have files flushed to the disk at a time, each by a thread of its own.
const MAX_WRITERS: usize = 32;
/// Why a run could not go on.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Its files could not be written, read or used.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The machine has less memory than it takes.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// Whether all before the generation is saved, is told too.
    #[error("{error}\ngeneration {generation} could not be played{}", after(saved))]
    Backend {
        /// What failed.
        error: BackendError,
        /// The one that was to be played.
        generation: usize,
        /// Why not, if it is not.
        saved: Result<(), Box<RunError>>,
    },
    /// The system gives no memory for this.
    #[error(
        "there is no memory for {what}, {bytes} bytes; choose a smaller population, fewer trials or another machine"
    )]
    Memory {
        /// What it is for.
        what: &'static str,
        /// How much was asked for.
        bytes: u64,
    },
    /// The config of a run is invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Populations cannot be brought to the host to be saved.
    #[error("no checkpoint could be made: {0}")]
    Held(BackendError),
}

impl RunError {
    /// There is no snapshot of so many bytes of policies.
    pub fn of_snapshot(error: SnapshotError, what: &'static str, bytes: u64) -> RunError {
        match error {
            SnapshotError::Memory(_) => RunError::Memory { what, bytes },
            SnapshotError::Backend(error) => RunError::Held(error),
        }
    }
}

fn after(saved: &Result<(), Box<RunError>>) -> String {
    match saved {
        Ok(()) => "; all before it is saved".into(),
        Err(error) => format!(", and what came before it could not be saved: {error}"),
    }
}

/// What others may want of runs while they run.
pub struct Options<'a> {
    /// What was typed to start this, for `run.json`.
    pub command: &'a str,
    /// Set by whoever wants the runs to finish their generation, save and stop.
    pub stop: &'a AtomicBool,
    /// Set by whoever wants a checkpoint of each now.
    pub save: &'a AtomicBool,
    /// Asked for another backend when one fails.
    pub instead: &'a mut dyn FnMut(&BackendError) -> Option<OpenBackend>,
    /// Told once of an error of a backend that held populations, where it was made up for: they are the host's then.
    pub setback: &'a mut dyn FnMut(&BackendError),
    /// Told of every generation played.
    pub watch: &'a mut dyn FnMut(&Progress<'_>),
}

/// A generation just played.
pub struct Progress<'a> {
    /// The generation that each run plays next, two past its last when it is done.
    pub generations: &'a [usize],
    /// Rows that became complete, by run (their arm), generation and trial.
    pub rows: &'a [Row],
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq)]
pub struct Results {
    /// The first and the last generation of every trial.
    pub story: Story,
    /// See [`Folder::digest`].
    pub digest: String,
}

/// How a session ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// Every run to its last generation.
    Done,
    /// Everything is saved.
    Stopped,
}

/// Runs in their folders, whose locks are the last to go.
pub struct Session {
    members: Vec<Member>,
    /// See [`Progress::generations`].
    generations: Vec<usize>,
    trainer: Trainer,
    /// The run of each of the trainer's arms: those that had something left to do.
    arms: Vec<usize>,
    since: Instant,
}

/// A run in its folder.
struct Member {
    config: Config,
    going: Option<Going>,
    folder: Folder,
    run: Run,
    results: Option<Results>,
    /// Time trained in earlier sessions.
    before: f64,
}

/// What a run has while there is something left to do.
struct Going {
    arm: usize,
    metrics: metrics::Writer,
    keeper: Keeper,
    /// Where the metrics were before the last generation's rows.
    ending: Option<Extent>,
}

impl Session {
    /// Starts or resumes runs, each a config and its folder; also gives what there is to tell about their folders.
    ///
    /// # Errors
    /// A folder cannot be used (see [`Folder::open`]), or there is no memory for the populations.
    pub fn open(
        runs: Vec<(Config, PathBuf)>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        let runs = runs.into_iter().map(|(config, path)| (config, path, None)).collect();
        Session::open_all(runs, StartFrom::Random, start, disk)
    }

    /// [`Session::open`], each run from given policies if there are any, read for its config. Where there are none, a run
    /// that is resumed may have been started from some.
    ///
    /// # Errors
    /// See [`Session::open`]; or a run to go on with started from others, or has no checkpoint and needs them.
    pub fn open_from(
        runs: Vec<(Config, PathBuf, Option<Init>)>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        Session::open_all(runs, StartFrom::Unsaid, start, disk)
    }

    fn open_all(
        runs: Vec<(Config, PathBuf, Option<Init>)>,
        otherwise: StartFrom<'_>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        // This generation and the next one; asked for first, since later a refusal would be an abort.
        let bytes = 2 * runs.iter().map(|(config, ..)| config.policy_bytes()).sum::<u64>();
        Vec::<u8>::new()
            .try_reserve_exact(bytes.try_into().unwrap_or(usize::MAX))
            .map_err(|_| RunError::Memory { what: "twice the policies of all trials", bytes })?;
        // Before any of them is touched.
        let configs = runs.iter().map(|(config, ..)| config.validate()).collect::<Result<Vec<ValidConfig>, _>>()?;
        folder::check(disk, runs.iter().map(|(config, path, _)| (&**path, config)), start)?;
        let opened =
            side_by_side(runs, |(config, path, init)| Member::open(config, path, init, otherwise, start, disk))?;
        let (mut members, mut snapshots, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        for (member, snapshot, told) in opened {
            // One warning is enough for all runs.
            let is_new = |note: &Note| *note != Note::NotLocked || !notes.iter().any(|(_, other)| other == note);
            let told: Vec<Note> = told.into_iter().filter(is_new).collect();
            notes.extend(told.into_iter().map(|note| (members.len(), note)));
            members.push(member);
            snapshots.push(snapshot);
        }
        let going = members.iter().zip(configs).filter(|(member, _)| member.going.is_some());
        let mut trainer = Trainer::new(going.map(|(_, config)| config));
        let mut generations = Vec::with_capacity(members.len());
        let mut arms = Vec::new();
        for (run, (member, snapshot)) in members.iter_mut().zip(snapshots).enumerate() {
            let Some(going) = &mut member.going else {
                generations.push(member.config.learning.generations + 2);
                continue;
            };
            going.arm = arms.len();
            arms.push(run);
            let fits = match snapshot {
                Beginning::Checkpoint(snapshot) => trainer.restore(going.arm, snapshot),
                Beginning::Policies(Init { trials, .. }) => {
                    (trials.into_iter().enumerate()).all(|(trial, Policies { policies, weights })| {
                        trainer.start_from(going.arm, trial, policies, &weights)
                    })
                }
                Beginning::Chance => true,
            };
            if !fits {
                unreachable!("checkpoints and policies are read in the sizes of their config");
            }
            generations.push(trainer.generation(going.arm));
        }
        Ok((Session { members, generations, trainer, arms, since: Instant::now() }, notes))
    }

    /// Whether there is nothing left to do.
    pub fn is_done(&self) -> bool {
        self.members.iter().all(|member| member.going.is_none())
    }

    /// See [`Progress::generations`].
    pub fn generations(&self) -> &[usize] {
        &self.generations
    }

    /// What a run came to, once it is done.
    pub fn results(&self, run: usize) -> Option<&Results> {
        self.members[run].results.as_ref()
    }

    /// The disk within a run's folder.
    pub fn disk(&self, run: usize) -> &Disk {
        &self.members[run].folder.disk
    }

    /// What `run.json` says of a run.
    pub fn run(&self, run: usize) -> &Run {
        &self.members[run].run
    }

    /// Trains all to the end, or until stopped.
    ///
    /// # Errors
    /// The backend fails (what came before is saved then), or something cannot be written.
    pub fn train(&mut self, player: &mut OpenBackend, options: &mut Options<'_>) -> Result<Ended, RunError> {
        self.since = Instant::now();
        for member in self.members.iter_mut().filter(|member| member.going.is_some()) {
            member.run.sessions = member.run.sessions.saturating_add(1);
            member.run.command = options.command.into();
            member.run.origin = Some(Origin::of(&member.config));
        }
        self.settle_on(player);
        self.write_runs(Status::Running)?;
        self.save_starts()?;
        let (mut flushed, mut setback, mut told) = (Instant::now(), None, false);
        // Once, and only what a generation has made up for: a device that is gone for good is told of as such.
        let mut tell = |error: Option<BackendError>| {
            if let Some(error) = error.filter(|_| !told) {
                told = true;
                (options.setback)(&error);
            }
        };
        while !self.trainer.is_done() {
            let rows = match self.trainer.advance(&mut *player.0) {
                Ok(rows) => rows,
                Err(error) => match (options.instead)(&error) {
                    Some(other) => {
                        setback = None;
                        *player = other;
                        self.settle_on(player);
                        continue;
                    }
                    None => {
                        let generation = self.going().map(|run| self.generations[run]).min().unwrap_or(0);
                        return Err(RunError::Backend { error, generation, saved: self.stop().map_err(Box::new) });
                    }
                },
            };
            tell(std::mem::replace(&mut setback, self.trainer.take_setback()));
            let rows = self.add(rows)?;
            if flushed.elapsed() >= FLUSH {
                self.members.iter_mut().try_for_each(Member::flush)?;
                flushed = Instant::now();
            }
            self.finish()?;
            (options.watch)(&Progress { generations: &self.generations, rows: &rows });
            self.members.iter_mut().try_for_each(Member::poll)?;
            if self.trainer.is_done() {
                break;
            }
            let (stop, asked) = (options.stop.load(Relaxed), options.save.swap(false, Relaxed));
            let saved = match () {
                () if stop => self.stop(),
                () if asked || self.is_due() => self.save(),
                () => continue,
            };
            match saved {
                // The device failed, which the next generation makes up for or ends at.
                Err(RunError::Held(error)) => {
                    options.save.store(!stop, Relaxed);
                    setback = Some(error);
                }
                saved => {
                    saved?;
                    if stop {
                        return Ok(Ended::Stopped);
                    }
                }
            }
        }
        tell(setback);
        Ok(Ended::Done)
    }

    /// Makes the generation that is played next the last of each run, or leaves it at an earlier one; gives the last of
    /// all. What each then comes to is what a run of so many generations comes to.
    ///
    /// # Errors
    /// A config or a checkpoint cannot be written.
    pub fn end(&mut self) -> Result<usize, RunError> {
        let mut last = 0;
        for member in &mut self.members {
            if let Some(Going { arm, keeper, .. }) = &mut member.going {
                let shorter = checkpoint::of_length(&member.config, self.trainer.end(*arm));
                if shorter != member.config {
                    keeper.shorten(&shorter)?;
                    member.folder.write_config(&shorter)?;
                    member.run.origin = Some(Origin::of(&shorter));
                    member.config = shorter;
                }
            }
            last = last.max(member.config.learning.generations);
        }
        Ok(last)
    }

    /// The runs that have something left to do.
    fn going(&self) -> impl Iterator<Item = usize> {
        self.members.iter().enumerate().filter(|(_, member)| member.going.is_some()).map(|(run, _)| run)
    }

    /// What they run on from now on.
    fn settle_on(&mut self, (backend, machine): &OpenBackend) {
        for run in self.members.iter_mut().filter(|member| member.going.is_some()).map(|member| &mut member.run) {
            let Machine { backend: kind, adapter, driver, threads } = machine.clone();
            let (version, commit) = (crate::VERSION.into(), crate::COMMIT.map(String::from));
            let description = backend.describe();
            *run = Run { version, commit, description, backend: kind, adapter, driver, threads, ..run.clone() };
        }
    }

    /// Adds complete rows to the metrics; gives them by run, generation and trial.
    fn add(&mut self, mut rows: Vec<Row>) -> Result<Vec<Row>, RunError> {
        rows.iter_mut().for_each(|row| row.arm = self.arms[row.arm]);
        rows.sort_by_key(|row| (row.arm, row.generation, row.trial));
        let seconds = self.seconds();
        rows.chunk_by(|a, b| a.arm == b.arm).try_for_each(|rows| self.members[rows[0].arm].add(rows, seconds))?;
        for (arm, &run) in self.arms.iter().enumerate() {
            self.generations[run] = self.trainer.generation(arm);
        }
        Ok(rows)
    }

    /// Writes what came out of the runs that have just played their last champions.
    fn finish(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let over = self.members.iter_mut().zip(&self.generations);
        let over = over.filter(|(member, next)| **next > member.config.learning.generations + 1);
        let (arms, over): (Vec<usize>, Vec<&mut Member>) =
            over.filter_map(|(member, _)| Some((member.going.as_ref()?.arm, member))).unzip();
        if over.is_empty() {
            return Ok(());
        }
        let ends = over.into_iter().zip(self.trainer.ends(&arms)).collect();
        side_by_side(ends, |(member, (policies, end))| member.finish(&policies, end, seconds)).map(drop)
    }

    /// Whether any run wants a checkpoint; then all make one.
    fn is_due(&self) -> bool {
        self.members.iter().zip(&self.generations).any(|(member, &next)| member.is_due(next))
    }

    /// Starts writing a checkpoint of every run that is not done.
    fn save(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let (mut held, mut writing) = (Ok(()), Vec::new());
        for run in self.going().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            match member.save(&mut self.trainer, self.generations[run], seconds) {
                // What others have may still be had.
                Err(error @ RunError::Held(_)) => held = held.and(Err(error)),
                saved => saved?,
            }
            writing.push(run);
            if writing.len() == MAX_WRITERS {
                writing.drain(..).try_for_each(|run| self.members[run].wait())?;
            }
        }
        held
    }

    /// Starts writing a checkpoint of every run that starts from given policies now, so that it can go on without them.
    fn save_starts(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        for run in self.going().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            let first = member.going.as_ref().is_some_and(|going| going.keeper.newest().is_none());
            if member.run.init.is_some() && first && self.generations[run] == 0 {
                member.save(&mut self.trainer, 0, seconds)?;
            }
        }
        Ok(())
    }

    /// Saves and waits until all is on the disk.
    fn stop(&mut self) -> Result<(), RunError> {
        let saved = self.save();
        let waited = self.members.iter_mut().try_for_each(Member::wait);
        let written = self.write_runs(Status::Stopped);
        saved.and(waited).and(written)
    }

    /// Writes `run.json` of every run that is not done.
    fn write_runs(&mut self, state: Status) -> Result<(), RunError> {
        let seconds = self.seconds();
        let going = self.members.iter_mut().zip(&self.generations).filter(|(member, _)| member.going.is_some());
        side_by_side(going.collect(), |(member, &next)| member.write_run(state, next, seconds, None)).map(drop)
    }

    /// Time trained in this session.
    fn seconds(&self) -> f64 {
        self.since.elapsed().as_secs_f64()
    }
}

/// What a run goes on from, or starts from.
enum Beginning {
    Checkpoint(Snapshot),
    Policies(Init),
    Chance,
}

impl Member {
    /// A run, where it goes on, and what there is to tell about its folder.
    fn open(
        config: Config,
        path: PathBuf,
        init: Option<Init>,
        otherwise: StartFrom<'_>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Member, Beginning, Vec<Note>), RunError> {
        let from = init.as_ref().map_or(otherwise, |init| StartFrom::Policies(&init.digest));
        let (folder, found) = Folder::open(&path, start, &config, from, disk.clone())?;
        let run = found.run.unwrap_or_else(|| Run::new(&config));
        let member = Member { config, going: None, folder, run, results: None, before: 0.0 };
        if let Some((story, digest)) = found.finished.zip(member.run.digest.clone()) {
            return Ok((Member { results: Some(Results { story, digest }), ..member }, Beginning::Chance, found.notes));
        }
        let (metrics, before, from) = match found.checkpoint {
            Some((Checkpoint { snapshot, seconds, .. }, metrics)) => {
                (metrics, seconds, Beginning::Checkpoint(snapshot))
            }
            None => {
                let metrics =
                    metrics::Writer::create(&member.folder.disk, &member.folder.file(METRICS), &member.config);
                (metrics.map_err(member.metrics_failed())?, 0.0, init.map_or(Beginning::Chance, Beginning::Policies))
            }
        };
        let generation = if let Beginning::Checkpoint(snapshot) = &from { snapshot.generation } else { 0 };
        let checkpoints = member.folder.file(folder::CHECKPOINTS);
        let keeper =
            Keeper::new(member.folder.disk.clone(), checkpoints, member.config.clone(), found.kept, generation);
        let going = Some(Going { arm: 0, metrics, keeper, ending: None });
        Ok((Member { going, before, ..member }, from, found.notes))
    }

    fn flush(&mut self) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        self.going.as_mut().map_or(Ok(()), |going| going.metrics.flush().map_err(failed))
    }

    fn poll(&mut self) -> Result<(), RunError> {
        Ok(self.going.as_mut().map_or(Ok(()), |going| going.keeper.poll())?)
    }

    fn wait(&mut self) -> Result<(), RunError> {
        Ok(self.going.as_mut().map_or(Ok(()), |going| going.keeper.wait())?)
    }

    fn is_due(&self, next: usize) -> bool {
        let config::Saving { generations, seconds } = self.config.checkpoint;
        self.going.as_ref().is_some_and(|going| going.keeper.is_due(&Schedule { generations, seconds }, next))
    }

    /// Adds complete rows of one generation.
    fn add(&mut self, rows: &[Row], seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Going { metrics, ending, .. }) = &mut self.going else { return Ok(()) };
        let mut add = || {
            if rows.iter().any(|row| row.generation == self.config.learning.generations) {
                *ending = Some(metrics.mark()?.0);
            }
            metrics.add(rows, self.before + seconds)
        };
        add().map_err(failed)
    }

    /// Starts writing a checkpoint, once the one before is written: there is memory for one. A large one is written
    /// before training goes on, for there may not be memory for any.
    fn save(&mut self, trainer: &mut Trainer, next: usize, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Going { arm, metrics, keeper, .. }) = &mut self.going else { return Ok(()) };
        keeper.wait()?;
        if keeper.newest() == Some(next) {
            return Ok(());
        }
        let since = Instant::now();
        let (metrics, output) = metrics.mark().map_err(failed)?;
        let (config, init, seconds) = (config_digest(&self.config), self.run.init.clone(), self.before + seconds);
        if !memory::copies_checkpoint([&self.config]) {
            let snapshot = trainer.view(*arm).map_err(RunError::Held)?;
            return Ok(keeper.save_now(&Checkpoint { config, init, seconds, metrics, snapshot }, &output, since)?);
        }
        let bytes = self.config.policy_bytes();
        let of_snapshot = |error| RunError::of_snapshot(error, "a checkpoint beside training", bytes);
        let snapshot = trainer.snapshot(*arm).map_err(of_snapshot)?;
        Ok(keeper.save(Checkpoint { config, init, seconds, metrics, snapshot }, output, since)?)
    }

    /// Writes what came out, so that at any moment there is something whole to go on from.
    fn finish(&mut self, policies: &[&[f32]], end: Snapshot<&[f32]>, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Going { metrics, keeper, ending, .. }) = &mut self.going else { return Ok(()) };
        let since = Instant::now();
        let (mark, output) = metrics.mark().map_err(failed)?;
        let Snapshot { generation, last, fitness, pending, .. } = end;
        let fitness = fitness.into_iter().map(<[f32]>::to_vec).collect();
        let snapshot = Snapshot { generation, last, weights: vec![], fitness, pending };
        let (config, metrics) = (config_digest(&self.config), ending.take().unwrap_or(mark));
        let (init, seconds_in_all) = (self.run.init.clone(), self.before + seconds);
        keeper.save(Checkpoint { config, init, seconds: seconds_in_all, metrics, snapshot }, output, since)?;
        let path = self.folder.file(POLICIES);
        if path.exists() {
            // What this run was extended from goes with them: only now is there something else.
            keeper.wait()?;
        }
        let checksum = policies::write(&self.folder.disk, &path, &self.config, policies)?;
        let (story, RunSums { run: digest, metrics }) = self.folder.digest(&self.config, policies)?;
        keeper.wait()?;
        self.run.files = Some(FileSums { metrics, policies: checksum });
        self.write_run(Status::Done, generation, seconds, Some(digest.clone()))?;
        self.results = Some(Results { story, digest });
        self.going = None;
        Ok(())
    }

    fn write_run(&mut self, state: Status, next: usize, seconds: f64, digest: Option<String>) -> Result<(), RunError> {
        let generations = next.min(self.config.learning.generations + 1);
        let (updated, seconds) = (folder::now(), self.before + seconds);
        let files = self.run.files.take().filter(|_| state == Status::Done);
        self.run = Run { state, updated, seconds, generations, digest, files, ..self.run.clone() };
        Ok(self.folder.write_run(&self.run)?)
    }

    fn metrics_failed(&self) -> impl FnOnce(std::io::Error) -> RunError + use<> {
        let path = self.folder.file(METRICS);
        move |error| RecordError::Write { path, error }.into()
    }
}

/// A run that is the same training as another, under another config.
pub struct Twin {
    /// The folder of the other, which is done.
    pub of: PathBuf,
    /// The other's config.
    pub of_config: Config,
    /// Its own folder.
    pub folder: PathBuf,
    /// Its own config.
    pub config: Config,
}

/// Records runs that others stand for, as if they had been trained: the others' metrics and policies, under their own
/// config. Those that are there already are left alone.
///
/// # Errors
/// A folder cannot be used (see [`Folder::open`]), read or written.
pub fn record_twins(twins: Vec<Twin>, start: Start, disk: &Disk) -> Result<(), RunError> {
    side_by_side(twins, |twin| twin.record(start, disk)).map(drop)
}

impl Twin {
    fn record(self, start: Start, disk: &Disk) -> Result<(), RunError> {
        let Twin { of, of_config, folder, config } = self;
        let run = Run::read(&of.join(folder::RUN))?;
        let (folder, found) = Folder::open(&folder, start, &config, StartFrom::Random, disk.clone())?;
        let there = found.run.filter(|_| found.finished.is_some());
        if there.is_some_and(|there| there.digest == run.digest) {
            return Ok(());
        }
        let (from, path) = (of.join(METRICS), folder.file(METRICS));
        let copy =
            folder.disk.replace(&path, |output| std::io::copy(&mut std::fs::File::open(&from)?, output).map(drop));
        copy.map_err(|error| RecordError::Write { path, error })?;
        let policies = of.join(POLICIES);
        let policies = policies::read_all(&policies, &of_config)?;
        let checksum = policies::write(&folder.disk, &folder.file(POLICIES), &config, &policies)?;
        let (_, RunSums { run: digest, metrics }) = folder.digest(&config, &policies)?;
        let files = Some(FileSums { metrics, policies: checksum });
        Ok(folder.write_run(&Run { digest: Some(digest), origin: Some(Origin::of(&config)), files, ..run })?)
    }
}

/// Does something slow (files are flushed to the disk) with each, side by side on as many threads as the system allows.
fn side_by_side<T: Send, R: Send>(
    all: Vec<T>,
    each: impl Fn(T) -> Result<R, RunError> + Sync,
) -> Result<Vec<R>, RunError> {
    let helpers = all.len().min(MAX_WRITERS).saturating_sub(1);
    let queue = Mutex::new(all.into_iter().enumerate());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let work = || std::iter::from_fn(next).map(|(place, item)| (place, each(item))).collect::<Vec<_>>();
    let mut done = std::thread::scope(|scope| {
        let start = |_| std::thread::Builder::new().spawn_scoped(scope, work).ok();
        let threads: Vec<_> = (0..helpers).map_while(start).collect();
        let mut done = work();
        for thread in threads {
            done.extend(thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        done
    });
    done.sort_by_key(|(place, _)| *place);
    done.into_iter().map(|(_, result)| result).collect()
}
