//! Sessions: recorded runs that train together, with one trainer for all of them. Each run has its own folder and
//! checkpoints. A single run is a session of one.

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
    self, FileSums, FirstAndLastRows, Folder, METRICS, Note, Origin, POLICIES, Run, RunSums, Start, StartFrom, Status,
};
use crate::record::metrics::{self, Extent};
use crate::record::policies::{self, Init, Policies};
use crate::record::{RecordError, config_digest};
use crate::trainer::{Row, Snapshot, SnapshotError, Trainer};

/// Interval at which runs pass their metrics to the system.
const FLUSH: Duration = Duration::from_secs(1);
/// Maximum number of runs whose files are flushed at the same time, each on its own thread.
const MAX_WRITERS: usize = 32;

/// Reason why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The files of a run could not be written, read or used.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The machine has too little memory.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// The backend failed. The message also reports whether the earlier generations are saved.
    #[error("{error}\ngeneration {generation} could not be played{}", after(saved))]
    Backend {
        /// Error of the backend.
        error: BackendError,
        /// Generation that could not be played.
        generation: usize,
        /// Whether the earlier generations were saved.
        saved: Result<(), Box<RunError>>,
    },
    /// An allocation failed.
    #[error(
        "not enough memory for {what}, {bytes} bytes; choose a smaller population, fewer trials or another machine"
    )]
    Memory {
        /// Purpose of the memory.
        what: &'static str,
        /// Requested bytes.
        bytes: u64,
    },
    /// The config of a run is invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The populations could not be read back from the backend for a checkpoint.
    #[error("no checkpoint could be made: {0}")]
    Fetch(BackendError),
}

impl RunError {
    /// Converts the error of a snapshot of `bytes` bytes of policies.
    pub fn of_snapshot(error: SnapshotError, what: &'static str, bytes: u64) -> RunError {
        match error {
            SnapshotError::Memory(_) => RunError::Memory { what, bytes },
            SnapshotError::Backend(error) => RunError::Fetch(error),
        }
    }
}

fn after(saved: &Result<(), Box<RunError>>) -> String {
    match saved {
        Ok(()) => "; all before it is saved".into(),
        Err(error) => format!(", and what came before it could not be saved: {error}"),
    }
}

/// Inputs and callbacks of a session.
pub struct Options<'a> {
    /// Command that started this session, for `run.json`.
    pub command: &'a str,
    /// Set by the caller to make the runs finish their generation, save and stop.
    pub stop: &'a AtomicBool,
    /// Set by the caller to request a checkpoint of every run.
    pub save: &'a AtomicBool,
    /// Called after a backend fails. Returns another backend to use, if there is one.
    pub instead: &'a mut dyn FnMut(&BackendError) -> Option<OpenBackend>,
    /// Called at most once, with the error of a backend that held the populations, if training recovered from it. The
    /// host holds the populations from then on.
    pub setback: &'a mut dyn FnMut(&BackendError),
    /// Called after every generation.
    pub watch: &'a mut dyn FnMut(&Progress<'_>),
}

/// State after a generation.
pub struct Progress<'a> {
    /// Generation that each run plays next. It is two past the last generation if the run is finished.
    pub generations: &'a [usize],
    /// Rows that became complete, sorted by run (the field `experiment`), generation and trial.
    pub rows: &'a [Row],
}

/// Results of a finished run.
#[derive(Clone, Debug, PartialEq)]
pub struct Results {
    /// Rows of the first and the last generation of every trial.
    pub rows: FirstAndLastRows,
    /// Digest of the run. See [`Folder::digest`].
    pub digest: String,
}

/// How a session ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// Every run is finished.
    Done,
    /// The session was asked to stop, and everything is saved.
    Stopped,
}

/// Runs in their folders. Each run finishes its pending writes before its folder is unlocked.
pub struct Session {
    members: Vec<Member>,
    /// See [`Progress::generations`].
    generations: Vec<usize>,
    trainer: Trainer,
    /// Index of the run for each of the trainer's experiments. Finished runs have no experiment.
    arms: Vec<usize>,
    since: Instant,
}

/// A run in its folder.
struct Member {
    config: Config,
    unfinished: Option<Unfinished>,
    folder: Folder,
    run: Run,
    results: Option<Results>,
    /// Training time of earlier sessions, in seconds.
    before: f64,
}

/// State of an unfinished run.
struct Unfinished {
    /// Index of its experiment in the trainer.
    experiment: usize,
    metrics: metrics::Writer,
    keeper: Keeper,
    /// Extent of the metrics before the rows of the last generation.
    ending: Option<Extent>,
}

impl Session {
    /// Starts or resumes runs, each with a config and a folder. Also returns notes for the user, each with the index of
    /// its run.
    ///
    /// # Errors
    /// A folder cannot be used (see [`Folder::open`]), or there is not enough memory for the populations.
    pub fn open(
        runs: Vec<(Config, PathBuf)>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        let runs = runs.into_iter().map(|(config, path)| (config, path, None)).collect();
        Session::open_all(runs, StartFrom::Random, start, disk)
    }

    /// Opens runs like [`Session::open`]. Each run may start from given policies, which were read for its config. A
    /// resumed run without given policies may have started from any.
    ///
    /// # Errors
    /// See [`Session::open`]. It is also an error if a resumed run started from other policies, or needs its policies
    /// because it has no checkpoint.
    pub fn open_from(
        runs: Vec<(Config, PathBuf, Option<Init>)>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        Session::open_all(runs, StartFrom::Unspecified, start, disk)
    }

    fn open_all(
        runs: Vec<(Config, PathBuf, Option<Init>)>,
        otherwise: StartFrom<'_>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        // This generation and the next one. A failed allocation is an error here, but would abort the process later.
        let bytes = 2 * runs.iter().map(|(config, ..)| config.policy_bytes()).sum::<u64>();
        Vec::<u8>::new()
            .try_reserve_exact(bytes.try_into().unwrap_or(usize::MAX))
            .map_err(|_| RunError::Memory { what: "twice the policies of all trials", bytes })?;
        // All configs and folders are checked before any folder is changed.
        let configs = runs.iter().map(|(config, ..)| config.validate()).collect::<Result<Vec<ValidConfig>, _>>()?;
        folder::check(disk, runs.iter().map(|(config, path, _)| (&**path, config)), start)?;
        let opened =
            side_by_side(runs, |(config, path, init)| Member::open(config, path, init, otherwise, start, disk))?;
        let (mut members, mut snapshots, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        for (member, snapshot, told) in opened {
            // One warning about missing locks is enough for all runs.
            let is_new = |note: &Note| *note != Note::NotLocked || !notes.iter().any(|(_, other)| other == note);
            let told: Vec<Note> = told.into_iter().filter(is_new).collect();
            notes.extend(told.into_iter().map(|note| (members.len(), note)));
            members.push(member);
            snapshots.push(snapshot);
        }
        let unfinished = members.iter().zip(configs).filter(|(member, _)| member.unfinished.is_some());
        let mut trainer = Trainer::new(unfinished.map(|(_, config)| config));
        let mut generations = Vec::with_capacity(members.len());
        let mut arms = Vec::new();
        for (run, (member, snapshot)) in members.iter_mut().zip(snapshots).enumerate() {
            let Some(unfinished) = &mut member.unfinished else {
                generations.push(member.config.learning.generations + 2);
                continue;
            };
            unfinished.experiment = arms.len();
            arms.push(run);
            let fits = match snapshot {
                InitialState::Checkpoint(snapshot) => trainer.restore(unfinished.experiment, snapshot),
                InitialState::Policies(Init { trials, .. }) => {
                    (trials.into_iter().enumerate()).all(|(trial, Policies { policies, weights })| {
                        trainer.start_from(unfinished.experiment, trial, policies, &weights)
                    })
                }
                InitialState::Random => true,
            };
            if !fits {
                unreachable!("checkpoints and policies are read in the sizes of their config");
            }
            generations.push(trainer.generation(unfinished.experiment));
        }
        Ok((Session { members, generations, trainer, arms, since: Instant::now() }, notes))
    }

    /// Returns whether all runs are finished.
    pub fn is_done(&self) -> bool {
        self.members.iter().all(|member| member.unfinished.is_none())
    }

    /// See [`Progress::generations`].
    pub fn generations(&self) -> &[usize] {
        &self.generations
    }

    /// Returns the results of a run, or `None` if it is not finished.
    pub fn results(&self, run: usize) -> Option<&Results> {
        self.members[run].results.as_ref()
    }

    /// Returns the disk that writes in the folder of a run.
    pub fn disk(&self, run: usize) -> &Disk {
        &self.members[run].folder.disk
    }

    /// Returns the config of a run. It is shorter than the config that the run was opened with after [`Session::end`].
    pub fn config(&self, run: usize) -> &Config {
        &self.members[run].config
    }

    /// Returns the content of `run.json` of a run.
    pub fn run(&self, run: usize) -> &Run {
        &self.members[run].run
    }

    /// Trains all runs until they are finished or the caller stops them.
    ///
    /// # Errors
    /// The backend fails (earlier generations are saved first), or a file cannot be written.
    pub fn train(&mut self, player: &mut OpenBackend, options: &mut Options<'_>) -> Result<Ended, RunError> {
        self.since = Instant::now();
        for member in self.members.iter_mut().filter(|member| member.unfinished.is_some()) {
            member.run.sessions = member.run.sessions.saturating_add(1);
            member.run.command = options.command.into();
            member.run.origin = Some(Origin::of(&member.config));
        }
        self.record_machine(player);
        self.write_runs(Status::Running)?;
        self.save_starts()?;
        let (mut flushed, mut setback, mut told) = (Instant::now(), None, false);
        // An error is reported once, and only after a generation has recovered from it. A lost device ends the session
        // with an error instead.
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
                        self.record_machine(player);
                        continue;
                    }
                    None => {
                        let generation = self.unfinished().map(|run| self.generations[run]).min().unwrap_or(0);
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
                // The device failed. The next generation either recovers from this or ends with the error.
                Err(RunError::Fetch(error)) => {
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

    /// Makes the generation that each run plays next its last, unless an earlier one is. Returns the largest of these
    /// last generations. The results are those of a config with that number of generations.
    ///
    /// # Errors
    /// A config or checkpoint cannot be read or written.
    pub fn end(&mut self) -> Result<usize, RunError> {
        let mut last = 0;
        for member in &mut self.members {
            if let Some(Unfinished { experiment, keeper, .. }) = &mut member.unfinished {
                let shorter = checkpoint::of_length(&member.config, self.trainer.end(*experiment));
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

    /// Returns the indices of the unfinished runs.
    fn unfinished(&self) -> impl Iterator<Item = usize> {
        self.members.iter().enumerate().filter(|(_, member)| member.unfinished.is_some()).map(|(run, _)| run)
    }

    /// Records the backend of all unfinished runs.
    fn record_machine(&mut self, (backend, machine): &OpenBackend) {
        for run in self.members.iter_mut().filter(|member| member.unfinished.is_some()).map(|member| &mut member.run) {
            let Machine { backend: kind, adapter, driver, threads } = machine.clone();
            let (version, commit) = (crate::VERSION.into(), crate::COMMIT.map(String::from));
            let description = backend.describe();
            *run = Run { version, commit, description, backend: kind, adapter, driver, threads, ..run.clone() };
        }
    }

    /// Adds complete rows to the metrics. Returns them sorted by run, generation and trial.
    fn add(&mut self, mut rows: Vec<Row>) -> Result<Vec<Row>, RunError> {
        rows.iter_mut().for_each(|row| row.experiment = self.arms[row.experiment]);
        rows.sort_by_key(|row| (row.experiment, row.generation, row.trial));
        let seconds = self.seconds();
        rows.chunk_by(|a, b| a.experiment == b.experiment)
            .try_for_each(|rows| self.members[rows[0].experiment].add(rows, seconds))?;
        for (arm, &run) in self.arms.iter().enumerate() {
            self.generations[run] = self.trainer.generation(arm);
        }
        Ok(rows)
    }

    /// Writes the results of the runs that have just played their last champions.
    fn finish(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let over = self.members.iter_mut().zip(&self.generations);
        let over = over.filter(|(member, next)| **next > member.config.learning.generations + 1);
        let (arms, over): (Vec<usize>, Vec<&mut Member>) =
            over.filter_map(|(member, _)| Some((member.unfinished.as_ref()?.experiment, member))).unzip();
        if over.is_empty() {
            return Ok(());
        }
        let ends = over.into_iter().zip(self.trainer.ends(&arms)).collect();
        side_by_side(ends, |(member, (policies, end))| member.finish(&policies, end, seconds)).map(drop)
    }

    /// Returns whether any run is due for a checkpoint. All runs then write one.
    fn is_due(&self) -> bool {
        self.members.iter().zip(&self.generations).any(|(member, &next)| member.is_due(next))
    }

    /// Starts to write a checkpoint of every unfinished run.
    fn save(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let (mut held, mut writing) = (Ok(()), Vec::new());
        for run in self.unfinished().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            match member.save(&mut self.trainer, self.generations[run], seconds) {
                // The populations of the other runs may still be available.
                Err(error @ RunError::Fetch(_)) => held = held.and(Err(error)),
                saved => saved?,
            }
            writing.push(run);
            if writing.len() == MAX_WRITERS {
                writing.drain(..).try_for_each(|run| self.members[run].wait())?;
            }
        }
        held
    }

    /// Writes a checkpoint of every run that starts now from given policies, so that it can be resumed without them.
    fn save_starts(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        for run in self.unfinished().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            let first = member.unfinished.as_ref().is_some_and(|unfinished| unfinished.keeper.newest().is_none());
            if member.run.init.is_some() && first && self.generations[run] == 0 {
                member.save(&mut self.trainer, 0, seconds)?;
            }
        }
        Ok(())
    }

    /// Saves all runs and waits until everything is on the disk.
    fn stop(&mut self) -> Result<(), RunError> {
        let saved = self.save();
        let waited = self.members.iter_mut().try_for_each(Member::wait);
        let written = self.write_runs(Status::Stopped);
        saved.and(waited).and(written)
    }

    /// Writes `run.json` of every unfinished run.
    fn write_runs(&mut self, state: Status) -> Result<(), RunError> {
        let seconds = self.seconds();
        let unfinished =
            self.members.iter_mut().zip(&self.generations).filter(|(member, _)| member.unfinished.is_some());
        side_by_side(unfinished.collect(), |(member, &next)| member.write_run(state, next, seconds, None)).map(drop)
    }

    /// Returns the training time of this session in seconds.
    fn seconds(&self) -> f64 {
        self.since.elapsed().as_secs_f64()
    }
}

/// State from which a run starts or resumes.
enum InitialState {
    Checkpoint(Snapshot),
    Policies(Init),
    Random,
}

impl Member {
    /// Opens a run. Returns its initial state and the notes about its folder.
    fn open(
        config: Config,
        path: PathBuf,
        init: Option<Init>,
        otherwise: StartFrom<'_>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Member, InitialState, Vec<Note>), RunError> {
        let from = init.as_ref().map_or(otherwise, |init| StartFrom::Policies(&init.digest));
        let (folder, found) = Folder::open(&path, start, &config, from, disk.clone())?;
        let run = found.run.unwrap_or_else(|| Run::new(&config));
        let member = Member { config, unfinished: None, folder, run, results: None, before: 0.0 };
        if let Some((rows, digest)) = found.finished.zip(member.run.digest.clone()) {
            return Ok((
                Member { results: Some(Results { rows, digest }), ..member },
                InitialState::Random,
                found.notes,
            ));
        }
        let (metrics, before, from) = match found.checkpoint {
            Some((Checkpoint { snapshot, seconds, .. }, metrics)) => {
                (metrics, seconds, InitialState::Checkpoint(snapshot))
            }
            None => {
                let metrics =
                    metrics::Writer::create(&member.folder.disk, &member.folder.file(METRICS), &member.config);
                (
                    metrics.map_err(member.metrics_failed())?,
                    0.0,
                    init.map_or(InitialState::Random, InitialState::Policies),
                )
            }
        };
        let generation = if let InitialState::Checkpoint(snapshot) = &from { snapshot.generation } else { 0 };
        let checkpoints = member.folder.file(folder::CHECKPOINTS);
        let keeper =
            Keeper::new(member.folder.disk.clone(), checkpoints, member.config.clone(), found.kept, generation);
        let unfinished = Some(Unfinished { experiment: 0, metrics, keeper, ending: None });
        Ok((Member { unfinished, before, ..member }, from, found.notes))
    }

    fn flush(&mut self) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.metrics.flush().map_err(failed))
    }

    fn poll(&mut self) -> Result<(), RunError> {
        Ok(self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.keeper.poll())?)
    }

    fn wait(&mut self) -> Result<(), RunError> {
        Ok(self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.keeper.wait())?)
    }

    fn is_due(&self, next: usize) -> bool {
        let config::CheckpointConfig { generations, seconds } = self.config.checkpoint;
        self.unfinished
            .as_ref()
            .is_some_and(|unfinished| unfinished.keeper.is_due(&Schedule { generations, seconds }, next))
    }

    /// Adds complete rows.
    fn add(&mut self, rows: &[Row], seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Unfinished { metrics, ending, .. }) = &mut self.unfinished else { return Ok(()) };
        let mut add = || {
            if rows.iter().any(|row| row.generation == self.config.learning.generations) {
                *ending = Some(metrics.mark()?.0);
            }
            metrics.add(rows, self.before + seconds)
        };
        add().map_err(failed)
    }

    /// Starts to write a checkpoint after the previous one is complete, because there is memory for only one copy. A
    /// large checkpoint is written before training continues, because there may not be memory for any copy.
    fn save(&mut self, trainer: &mut Trainer, next: usize, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Unfinished { experiment, metrics, keeper, .. }) = &mut self.unfinished else { return Ok(()) };
        keeper.wait()?;
        if keeper.newest() == Some(next) {
            return Ok(());
        }
        let since = Instant::now();
        let (metrics, output) = metrics.mark().map_err(failed)?;
        let (config, init, seconds) = (config_digest(&self.config), self.run.init.clone(), self.before + seconds);
        if !memory::copies_checkpoint([&self.config]) {
            let snapshot = trainer.view(*experiment).map_err(RunError::Fetch)?;
            return Ok(keeper.save_now(&Checkpoint { config, init, seconds, metrics, snapshot }, &output, since)?);
        }
        let bytes = self.config.policy_bytes();
        let of_snapshot = |error| RunError::of_snapshot(error, "a checkpoint beside training", bytes);
        let snapshot = trainer.snapshot(*experiment).map_err(of_snapshot)?;
        Ok(keeper.save(Checkpoint { config, init, seconds, metrics, snapshot }, output, since)?)
    }

    /// Writes the results in an order that leaves a usable checkpoint at any moment.
    fn finish(&mut self, policies: &[&[f32]], end: Snapshot<&[f32]>, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Unfinished { metrics, keeper, ending, .. }) = &mut self.unfinished else { return Ok(()) };
        let since = Instant::now();
        let (mark, output) = metrics.mark().map_err(failed)?;
        let (init, in_all) = (self.run.init.clone(), self.before + seconds);
        let metrics = ending.take().unwrap_or(mark);
        let next = end.generation;
        let last = Checkpoint { config: config_digest(&self.config), init, seconds: in_all, metrics, snapshot: end };
        if last.snapshot.weights.is_empty() {
            let bytes = self.config.policy_bytes();
            let memory = |_| RunError::Memory { what: "the scores of the last generation", bytes };
            let snapshot = last.snapshot.copy().map_err(memory)?;
            let Checkpoint { config, init, seconds, metrics, .. } = last;
            keeper.save(Checkpoint { config, init, seconds, metrics, snapshot }, output, since)?;
        } else {
            keeper.save_now(&last, &output, since)?;
        }
        let path = self.folder.file(POLICIES);
        if path.exists() {
            // The old checkpoints of an extended run need the old policies. The new checkpoint must be complete before
            // the policies are replaced.
            keeper.wait()?;
        }
        let checksum = policies::write(&self.folder.disk, &path, &self.config, policies)?;
        let (rows, RunSums { run: digest, metrics }) = self.folder.digest(&self.config, policies)?;
        keeper.wait()?;
        self.run.files = Some(FileSums { metrics, policies: checksum });
        self.write_run(Status::Done, next, seconds, Some(digest.clone()))?;
        self.results = Some(Results { rows, digest });
        self.unfinished = None;
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

/// A run with the same training as another run but with another config.
pub struct Twin {
    /// Folder of the other run, which is finished.
    pub of: PathBuf,
    /// Config of the other run.
    pub of_config: Config,
    /// Folder of this run.
    pub folder: PathBuf,
    /// Config of this run.
    pub config: Config,
}

/// Records runs without training them. Each gets the metrics and policies of its twin, under its own config. Runs that
/// are already recorded are not changed.
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

/// Applies a slow function (such as flushing files) to all items on as many threads as the system allows, up to
/// [`MAX_WRITERS`].
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
