//! Training of all runs of a session.

use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use super::member::{InitialState, Member, Unfinished};
use super::{MAX_WRITERS, Options, Progress, Results, RunError, SessionEnd, on_threads};
use crate::record::checkpoint;
use crate::record::disk::Disk;
use crate::record::folder::{self, Note, Origin, ProcessorInfo, Run, Start, StartFrom, Status};
use crate::record::policies::{Init, Policies};
use flotilla::backend::{BackendError, Machine, OpenBackend};
use flotilla::config::{Config, ValidConfig};
use flotilla::host::Instant;
use flotilla::memory;
use flotilla::trainer::{Row, Trainer};

/// Interval at which runs pass their metrics to the system.
const FLUSH: Duration = Duration::from_secs(1);

/// Runs in their folders. Each run finishes its pending writes before its folder is unlocked.
pub struct Session {
    members: Vec<Member>,
    /// See [`Progress::generations`].
    generations: Vec<usize>,
    trainer: Trainer,
    /// Index of the run for each of the trainer's experiments. Finished runs have no experiment.
    runs_of_experiments: Vec<usize>,
    since: Instant,
}

impl Session {
    /// Opens runs like [`Session::open_from`]. The caller knows that all of them start from random policies.
    pub fn open(
        runs: Vec<(Config, PathBuf)>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        let runs = runs.into_iter().map(|(config, path)| (config, path, None)).collect();
        Session::open_from(runs, StartFrom::Random, start, disk)
    }

    /// Starts or resumes runs, each with a config and a folder. Each run may start from given policies, which were read
    /// for its config. `otherwise` is the start of the other runs. Also returns notes for the user, each with the index
    /// of its run.
    ///
    /// # Errors
    /// A folder cannot be used (see [`folder::Folder::open`]), or there is not enough memory for the populations.
    pub fn open_from(
        runs: Vec<(Config, PathBuf, Option<Init>)>,
        otherwise: StartFrom<'_>,
        start: Start,
        disk: &Disk,
    ) -> Result<(Session, Vec<(usize, Note)>), RunError> {
        // This generation and the next one.
        let bytes = 2 * runs.iter().map(|(config, ..)| config.policy_bytes()).sum::<u64>();
        if !memory::can_allocate(bytes.into()) {
            return Err(RunError::Memory { what: "twice the policies of all trials", bytes });
        }
        // All configs and folders are checked before any folder is changed.
        let configs = runs.iter().map(|(config, ..)| config.validate()).collect::<Result<Vec<ValidConfig>, _>>()?;
        folder::check(disk, runs.iter().map(|(config, path, _)| (&**path, config)), start)?;
        let opened = on_threads(runs, |(config, path, init)| Member::open(config, path, init, otherwise, start, disk))?;
        let (mut members, mut states, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        for (member, state, own_notes) in opened {
            // One warning about missing locks is enough for all runs.
            let is_new = |note: &Note| *note != Note::not_locked() || !notes.iter().any(|(_, other)| other == note);
            let own_notes: Vec<Note> = own_notes.into_iter().filter(is_new).collect();
            notes.extend(own_notes.into_iter().map(|note| (members.len(), note)));
            members.push(member);
            states.push(state);
        }
        let (generations, runs_of_experiments, since) = (vec![], vec![], Instant::now());
        let mut session = Session { members, generations, trainer: Trainer::new([]), runs_of_experiments, since };
        session.restore(configs, states);
        Ok((session, notes))
    }

    /// Makes a new trainer for the unfinished runs, each in its state.
    fn restore(&mut self, configs: Vec<ValidConfig>, states: Vec<InitialState>) {
        let unfinished = self.members.iter().zip(configs).filter(|(member, _)| member.unfinished.is_some());
        let mut trainer = Trainer::new(unfinished.map(|(_, config)| config));
        self.generations.clear();
        self.runs_of_experiments.clear();
        for (run, (member, state)) in self.members.iter_mut().zip(states).enumerate() {
            let Some(unfinished) = &mut member.unfinished else {
                self.generations.push(member.config.learning.generations + 2);
                continue;
            };
            unfinished.experiment = self.runs_of_experiments.len();
            self.runs_of_experiments.push(run);
            let fits = match state {
                InitialState::Checkpoint(snapshot) => trainer.restore(unfinished.experiment, snapshot),
                InitialState::Policies(Init { trials, .. }) => {
                    (trials.into_iter().enumerate()).all(|(trial, Policies { policies, weights, .. })| {
                        trainer.start_from(unfinished.experiment, trial, policies, &weights)
                    })
                }
                InitialState::Random => true,
            };
            if !fits {
                unreachable!("checkpoints and policies are read in the sizes of their config");
            }
            self.generations.push(trainer.generation(unfinished.experiment));
        }
        self.trainer = trainer;
    }

    /// Goes back to the last checkpoints after the backend failed. The populations that it still returns are saved
    /// first.
    fn reopen(&mut self) -> Result<(), RunError> {
        match self.save() {
            Err(RunError::Fetch(_)) => {}
            saved => saved?,
        }
        let configs = self.members.iter().map(|member| member.config.validate()).collect::<Result<_, _>>()?;
        let states = self.members.iter_mut().map(Member::reload).collect::<Result<_, _>>()?;
        self.restore(configs, states);
        Ok(())
    }

    /// Reports whether all runs are finished.
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

    /// Gives a run a name, which is recorded when it trains. A resumed run keeps the name that it has.
    pub fn set_name(&mut self, run: usize, name: &str) {
        self.members[run].run.name.get_or_insert_with(|| name.into());
    }

    /// Trains all runs until they are finished or the caller stops them.
    ///
    /// # Errors
    /// The backend fails (earlier generations are saved first), or a file cannot be written.
    pub fn train(&mut self, backend: &mut OpenBackend, options: &mut Options<'_>) -> Result<SessionEnd, RunError> {
        self.since = Instant::now();
        for member in self.members.iter_mut().filter(|member| member.unfinished.is_some()) {
            member.run.sessions = member.run.sessions.saturating_add(1);
            member.run.command = options.command.into();
            member.run.origin = Origin::of(&member.config);
        }
        self.record_machine(backend);
        self.write_runs(Status::Running)?;
        self.save_starts()?;
        let mut flushed = Instant::now();
        while !self.trainer.is_done() {
            let rows = match self.trainer.advance(&mut *backend.0) {
                Ok(rows) => rows,
                Err(error) => {
                    self.replace_backend(error, backend, options)?;
                    continue;
                }
            };
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
                // A request to stop is met after the next generation.
                Err(RunError::Fetch(error)) => self.replace_backend(error, backend, options)?,
                saved => {
                    saved?;
                    if stop {
                        return Ok(SessionEnd::Stopped);
                    }
                }
            }
        }
        Ok(SessionEnd::Finished)
    }

    /// Continues on another backend after one failed.
    ///
    /// # Errors
    /// There is no other backend, or a file cannot be read or written. What can be saved is saved.
    fn replace_backend(
        &mut self,
        error: BackendError,
        backend: &mut OpenBackend,
        options: &mut Options<'_>,
    ) -> Result<(), RunError> {
        let Some(other) = (options.fallback)(&error) else {
            let generation = self.unfinished().map(|run| self.generations[run]).min().unwrap_or(0);
            return Err(RunError::Backend { error, generation, saved: self.stop().map_err(Box::new) });
        };
        self.reopen()?;
        *backend = other;
        self.record_machine(backend);
        Ok(())
    }

    /// Makes the generation that each run plays next its last, unless an earlier one is. Returns the largest of these
    /// last generations. The results are those of a config with that number of generations.
    pub fn end(&mut self) -> Result<usize, RunError> {
        let mut last = 0;
        for member in &mut self.members {
            if let Some(Unfinished { experiment, checkpoints, .. }) = &mut member.unfinished {
                let shorter = checkpoint::of_length(&member.config, self.trainer.end(*experiment));
                if shorter != member.config {
                    checkpoints.shorten(&shorter)?;
                    member.folder.write_config(&shorter)?;
                    member.run.origin = Origin::of(&shorter);
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
        let processor = ProcessorInfo::of(machine, &backend.describe());
        for run in self.members.iter_mut().filter(|member| member.unfinished.is_some()).map(|member| &mut member.run) {
            let (processor, Machine { adapter_index, adapter_pci, .. }) = (processor.clone(), machine.clone());
            let (version, commit) = (flotilla::version::VERSION.into(), flotilla::version::COMMIT.map(String::from));
            *run = Run { version, commit, processor, adapter_index, adapter_pci, ..run.clone() };
        }
    }

    /// Adds complete rows to the metrics. Returns them sorted by run, generation and trial.
    fn add(&mut self, mut rows: Vec<Row>) -> Result<Vec<Row>, RunError> {
        rows.iter_mut().for_each(|row| row.experiment = self.runs_of_experiments[row.experiment]);
        rows.sort_by_key(|row| (row.experiment, row.generation, row.trial));
        let seconds = self.seconds();
        rows.chunk_by(|a, b| a.experiment == b.experiment)
            .try_for_each(|rows| self.members[rows[0].experiment].add(rows, seconds))?;
        for (experiment, &run) in self.runs_of_experiments.iter().enumerate() {
            self.generations[run] = self.trainer.generation(experiment);
        }
        Ok(rows)
    }

    /// Writes the results of the runs that have just played their last champions.
    fn finish(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let finished = self.members.iter_mut().zip(&self.generations);
        let finished = finished.filter(|(member, next)| **next > member.config.learning.generations + 1);
        let (experiments, finished): (Vec<usize>, Vec<&mut Member>) =
            finished.filter_map(|(member, _)| Some((member.unfinished.as_ref()?.experiment, member))).unzip();
        if finished.is_empty() {
            return Ok(());
        }
        let ends = finished.into_iter().zip(self.trainer.ends(&experiments)).collect();
        on_threads(ends, |(member, (policies, end))| member.finish(&policies, end, seconds)).map(drop)
    }

    /// Reports whether any run is due for a checkpoint. All runs then write one.
    fn is_due(&self) -> bool {
        self.members.iter().zip(&self.generations).any(|(member, &next)| member.is_due(next))
    }

    /// Starts to write a checkpoint of every unfinished run.
    fn save(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        let (mut fetched, mut writing) = (Ok(()), Vec::new());
        for run in self.unfinished().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            match member.save(&mut self.trainer, self.generations[run], seconds) {
                // The populations of the other runs may still be available.
                Err(error @ RunError::Fetch(_)) => fetched = fetched.and(Err(error)),
                saved => saved?,
            }
            writing.push(run);
            if writing.len() == MAX_WRITERS {
                writing.drain(..).try_for_each(|run| self.members[run].wait())?;
            }
        }
        fetched
    }

    /// Writes a checkpoint of every run that starts now from given policies, so that it can be resumed without them.
    fn save_starts(&mut self) -> Result<(), RunError> {
        let seconds = self.seconds();
        for run in self.unfinished().collect::<Vec<_>>() {
            let member = &mut self.members[run];
            let first = member.unfinished.as_ref().is_some_and(|unfinished| unfinished.checkpoints.newest().is_none());
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
        on_threads(unfinished.collect(), |(member, &next)| member.write_run(state, next, seconds, None)).map(drop)
    }

    /// Returns the training time of this session in seconds.
    fn seconds(&self) -> f64 {
        self.since.elapsed().as_secs_f64()
    }
}
