//! One recorded run: a trainer, its folder and its checkpoints together.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use crate::backend::{Backend, BackendError};
use crate::config::Config;
use crate::memory::{self, TooLittle};
use crate::record::RecordError;
use crate::record::checkpoint::{self, Checkpoint, Keeper, Schedule};
use crate::record::disk::Disk;
use crate::record::folder::{self, Folder, METRICS, POLICIES, Run, Start, State, Story};
use crate::record::metrics::{self, Row};
use crate::record::policies;
use crate::trainer::{SnapshotError, Trainer};

/// How often a run hands its metrics to the system.
const FLUSH: Duration = Duration::from_secs(1);

/// Why a run could not go on.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    #[error("{error}\ngeneration {generation} could not be played{}", after(saved))]
    Backend { error: BackendError, generation: usize, saved: Result<(), Box<RunError>> },
    #[error(
        "there is no memory for {what}, {bytes} bytes; choose a smaller population, fewer trials or another machine"
    )]
    Memory { what: &'static str, bytes: usize },
    /// Populations cannot be brought to the host to be saved.
    #[error("no checkpoint could be made: {0}")]
    Held(BackendError),
}

impl RunError {
    /// There is no snapshot of so many bytes of policies.
    pub fn of_snapshot(error: SnapshotError, what: &'static str, bytes: usize) -> RunError {
        match error {
            SnapshotError::Memory(_) => RunError::Memory { what, bytes },
            SnapshotError::Backend(error) => RunError::Held(error),
        }
    }
}

fn after(saved: &Result<(), Box<RunError>>) -> String {
    match saved {
        Ok(()) => {
            "; all before it is saved: go on with --resume, with --on-device-loss cpu to change to the CPU".into()
        }
        Err(error) => format!(", and what came before it could not be saved: {error}"),
    }
}

/// What a run runs on, for `run.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Machine {
    /// "cpu" or "gpu".
    pub backend: String,
    pub adapter: Option<String>,
    pub driver: Option<String>,
    pub threads: usize,
}

/// A backend and what it is.
pub type Player = (Box<dyn Backend>, Machine);

/// What others may want of a run while it runs.
pub struct Options<'a> {
    pub schedule: Schedule,
    /// Set by whoever wants the run to finish its generation, save and stop.
    pub stop: &'a AtomicBool,
    /// Set by whoever wants a checkpoint now.
    pub save: &'a AtomicBool,
    /// Asked for another backend when one fails.
    pub instead: &'a mut dyn FnMut(&BackendError) -> Option<Player>,
    /// Told of every generation played.
    pub watch: &'a mut dyn FnMut(&Progress<'_>),
}

/// A generation just played.
pub struct Progress<'a> {
    /// The generation that plays next.
    pub generation: usize,
    /// Rows that became complete.
    pub rows: &'a [Row],
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq)]
pub struct Results {
    pub story: Story,
    /// See [`Folder::digest`].
    pub digest: String,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    Done(Results),
    /// Saved before this generation.
    Stopped {
        generation: usize,
    },
}

/// A run that was found or made.
pub enum Opened {
    /// It has something left to do.
    Ready(Box<Session>),
    /// It was done already.
    Done(Results),
}

/// A run in its folder, whose lock is the last to go.
pub struct Session {
    config: Config,
    trainer: Trainer,
    metrics: metrics::Writer,
    keeper: Keeper,
    folder: Folder,
    run: Run,
    /// Time trained in earlier sessions, and the start of this.
    before: f64,
    since: Instant,
}

impl Session {
    /// Starts or resumes a run; also gives what the user should be told about its folder.
    ///
    /// # Errors
    /// The folder cannot be used (see [`Folder::open`]), or there is no memory for the populations.
    pub fn open(config: Config, path: &Path, start: Start, disk: Disk) -> Result<(Opened, Vec<String>), RunError> {
        // This generation and the next one; asked for first, since later a refusal would be an abort.
        let bytes = 2 * config.policy_bytes();
        Vec::<u8>::new()
            .try_reserve_exact(bytes)
            .map_err(|_| RunError::Memory { what: "twice the policies of all trials", bytes })?;
        let (folder, found) = Folder::open(path, start, &config, disk.clone())?;
        let run = found.run.unwrap_or_else(|| Run::new(&config));
        if let Some((story, digest)) = found.finished.zip(run.digest.clone()) {
            return Ok((Opened::Done(Results { story, digest }), found.notes));
        }
        let mut trainer = Trainer::new(vec![config.clone()]);
        let (metrics, before) = match found.checkpoint {
            Some((Checkpoint { snapshot, seconds, .. }, metrics)) => {
                if !trainer.restore(snapshot) {
                    unreachable!("a checkpoint is read in the sizes of its config");
                }
                (metrics, seconds)
            }
            None => {
                let path = folder.file(METRICS);
                (metrics::Writer::create(&disk, &path).map_err(|error| RecordError::Write { path, error })?, 0.0)
            }
        };
        let checkpoints = folder.file(folder::CHECKPOINTS);
        let keeper = Keeper::new(disk, checkpoints, vec![config.clone()], found.kept, trainer.generation());
        let since = Instant::now();
        let session = Session { config, folder, trainer, metrics, keeper, run, before, since };
        Ok((Opened::Ready(Box::new(session)), found.notes))
    }

    /// The generation that plays next.
    pub fn generation(&self) -> usize {
        self.trainer.generation()
    }

    /// Trains to the end, or until stopped.
    ///
    /// # Errors
    /// The backend fails (what came before is saved then), or something cannot be written.
    pub fn train(&mut self, (mut backend, machine): Player, options: Options<'_>) -> Result<Outcome, RunError> {
        self.since = Instant::now();
        self.run.sessions = self.run.sessions.saturating_add(1);
        self.settle_on(&*backend, machine);
        self.write_run(State::Running, None)?;
        let mut flushed = Instant::now();
        while !self.trainer.is_done() {
            let rows = match self.trainer.advance(&mut *backend) {
                Ok(rows) => rows,
                Err(error) => match (options.instead)(&error) {
                    Some((other, machine)) => {
                        backend = other;
                        self.settle_on(&*backend, machine);
                        continue;
                    }
                    None => {
                        let generation = self.generation();
                        return Err(RunError::Backend { error, generation, saved: self.stop().map_err(Box::new) });
                    }
                },
            };
            let mut in_order = rows;
            in_order.sort_by_key(|row| (row.generation, row.trial));
            self.metrics.add(&in_order, self.seconds()).map_err(self.metrics_failed())?;
            if flushed.elapsed() >= FLUSH {
                self.metrics.flush().map_err(self.metrics_failed())?;
                flushed = Instant::now();
            }
            (options.watch)(&Progress { generation: self.generation(), rows: &in_order });
            self.keeper.poll()?;
            if options.stop.load(Relaxed) && !self.trainer.is_done() {
                match self.stop() {
                    // The device failed, which the next generation makes up for or ends at.
                    Err(RunError::Held(_)) => continue,
                    stopped => stopped?,
                }
                return Ok(Outcome::Stopped { generation: self.generation() });
            }
            let asked = options.save.swap(false, Relaxed);
            if !self.trainer.is_done() && (asked || self.keeper.is_due(&options.schedule, self.generation())) {
                match self.save() {
                    Err(RunError::Held(_)) => options.save.store(true, Relaxed),
                    saved => saved?,
                }
            }
        }
        self.finish().map(Outcome::Done)
    }

    /// What it runs on from now on.
    fn settle_on(&mut self, backend: &dyn Backend, machine: Machine) {
        let Machine { backend: kind, adapter, driver, threads } = machine;
        let version = env!("CARGO_PKG_VERSION").to_string();
        let run = Run { version, backend: kind, adapter, driver, threads, ..self.run.clone() };
        self.run = Run { description: backend.describe(), ..run };
    }

    /// Starts writing a checkpoint, once the one before is written: there is memory for one. A large one is written
    /// before training goes on, for there may not be memory for any.
    fn save(&mut self) -> Result<(), RunError> {
        self.keeper.wait()?;
        let since = Instant::now();
        let (metrics, output) = self.metrics.mark().map_err(self.metrics_failed())?;
        let bytes = self.config.policy_bytes();
        if !memory::copies_checkpoint([&self.config]) {
            let (config, seconds) = (checkpoint::digest(&self.config), self.seconds());
            let snapshot = self.trainer.view().map_err(RunError::Held)?;
            return Ok(self.keeper.save_now(&Checkpoint { config, seconds, metrics, snapshot }, &output, since)?);
        }
        let of_snapshot = |error| RunError::of_snapshot(error, "a checkpoint beside training", bytes);
        let snapshot = self.trainer.snapshot().map_err(of_snapshot)?;
        let (config, seconds) = (checkpoint::digest(&self.config), self.seconds());
        Ok(self.keeper.save(Checkpoint { config, seconds, metrics, snapshot }, output, since)?)
    }

    /// Saves and waits until all is on the disk.
    fn stop(&mut self) -> Result<(), RunError> {
        self.keeper.wait()?;
        let saved = match self.keeper.newest() == Some(self.generation()) {
            true => Ok(()),
            false => self.save().and_then(|()| Ok(self.keeper.wait()?)),
        };
        let written = self.write_run(State::Stopped, None);
        saved.and(written)
    }

    /// Writes what came out.
    fn finish(&mut self) -> Result<Results, RunError> {
        self.keeper.wait()?;
        let (_, output) = self.metrics.mark().map_err(self.metrics_failed())?;
        output.sync().map_err(self.metrics_failed())?;
        let trials = self.trainer.best_policies(0);
        policies::write(&self.folder.disk, &self.folder.file(POLICIES), &self.config, &trials)?;
        let (story, digest) = self.folder.digest(&self.config, &trials)?;
        self.write_run(State::Done, Some(digest.clone()))?;
        Ok(Results { story, digest })
    }

    fn write_run(&mut self, state: State, digest: Option<String>) -> Result<(), RunError> {
        let generations = self.generation().min(self.config.learning.generations + 1);
        let (updated, seconds) = (folder::now(), self.seconds());
        self.run = Run { state, updated, seconds, generations, digest, ..self.run.clone() };
        Ok(self.folder.write_run(&self.run)?)
    }

    fn seconds(&self) -> f64 {
        self.before + self.since.elapsed().as_secs_f64()
    }

    fn metrics_failed(&self) -> impl FnOnce(std::io::Error) -> RunError + use<> {
        let path = self.folder.file(METRICS);
        move |error| RecordError::Write { path, error }.into()
    }
}
