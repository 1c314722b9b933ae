//! One run of a session: its folder, metrics and checkpoints.

use std::path::PathBuf;

use super::{Results, RunError};
use crate::record::checkpoint::{Checkpoint, CheckpointWriter};
use crate::record::disk::Disk;
use crate::record::folder::{self, FileSums, Folder, METRICS, Note, POLICIES, Run, RunSums, Start, StartFrom, Status};
use crate::record::metrics::{self, Extent};
use crate::record::policies::{self, Init};
use crate::record::{RecordError, config_digest};
use flotilla::config::Config;
use flotilla::host::Instant;
use flotilla::memory;
use flotilla::trainer::{Row, Snapshot, Trainer};

/// A run in its folder.
pub(super) struct Member {
    pub(super) config: Config,
    pub(super) unfinished: Option<Unfinished>,
    pub(super) folder: Folder,
    pub(super) run: Run,
    pub(super) results: Option<Results>,
    /// Training time of earlier sessions, in seconds.
    pub(super) before: f64,
}

/// State of an unfinished run.
pub(super) struct Unfinished {
    /// Index of its experiment in the trainer.
    pub(super) experiment: usize,
    pub(super) metrics: metrics::Writer,
    pub(super) checkpoints: CheckpointWriter,
    /// Extent of the metrics before the rows of the last generation.
    pub(super) ending: Option<Extent>,
}

/// State from which a run starts or resumes.
pub(super) enum InitialState {
    Checkpoint(Snapshot),
    Policies(Init),
    Random,
}

impl Member {
    /// Opens a run. Returns its initial state and the notes about its folder.
    pub(super) fn open(
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
        let before = found.checkpoint.as_ref().map_or(0.0, |(checkpoint, _)| checkpoint.seconds);
        let mut member = Member { before, ..member };
        let from = member.begin(found.checkpoint, found.kept, init)?;
        Ok((member, from, found.notes))
    }

    /// Makes the writers of an unfinished run. Returns its initial state: that of a checkpoint, if there is one.
    fn begin(
        &mut self,
        checkpoint: Option<(Checkpoint, metrics::Writer)>,
        kept: Vec<usize>,
        init: Option<Init>,
    ) -> Result<InitialState, RunError> {
        let (metrics, from) = match checkpoint {
            Some((Checkpoint { snapshot, .. }, metrics)) => (metrics, InitialState::Checkpoint(snapshot)),
            None => {
                let metrics = metrics::Writer::create(&self.folder.disk, &self.folder.file(METRICS), &self.config);
                (metrics.map_err(self.metrics_failed())?, init.map_or(InitialState::Random, InitialState::Policies))
            }
        };
        let generation = if let InitialState::Checkpoint(snapshot) = &from { snapshot.generation } else { 0 };
        let (disk, checkpoints) = (self.folder.disk.clone(), self.folder.file(folder::CHECKPOINTS));
        let checkpoints = CheckpointWriter::new(disk, checkpoints, self.config.clone(), kept, generation);
        self.unfinished = Some(Unfinished { experiment: 0, metrics, checkpoints, ending: None });
        Ok(from)
    }

    /// Goes back to the last checkpoint of an unfinished run, or to its start.
    pub(super) fn reload(&mut self) -> Result<InitialState, RunError> {
        self.wait()?;
        if self.unfinished.take().is_none() {
            return Ok(InitialState::Random);
        }
        let (checkpoint, kept) = self.folder.last_checkpoint(&self.config)?;
        match (&checkpoint, &self.run.init) {
            (None, Some(existing)) => Err(RecordError::init_needed(&self.folder.path, existing).into()),
            _ => self.begin(checkpoint, kept, None),
        }
    }

    pub(super) fn flush(&mut self) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.metrics.flush().map_err(failed))
    }

    pub(super) fn poll(&mut self) -> Result<(), RunError> {
        Ok(self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.checkpoints.poll())?)
    }

    pub(super) fn wait(&mut self) -> Result<(), RunError> {
        Ok(self.unfinished.as_mut().map_or(Ok(()), |unfinished| unfinished.checkpoints.wait())?)
    }

    pub(super) fn is_due(&self, next: usize) -> bool {
        self.unfinished.as_ref().is_some_and(|unfinished| unfinished.checkpoints.is_due(&self.config.checkpoint, next))
    }

    /// Adds complete rows.
    pub(super) fn add(&mut self, rows: &[Row], seconds: f64) -> Result<(), RunError> {
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
    pub(super) fn save(&mut self, trainer: &mut Trainer, next: usize, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Unfinished { experiment, metrics, checkpoints, .. }) = &mut self.unfinished else { return Ok(()) };
        checkpoints.wait()?;
        match checkpoints.newest() {
            Some(newest) if newest == next => return Ok(()),
            Some(_) => {}
            // The first checkpoint needs the names of the files that were written at the start.
            None => self.folder.sync()?,
        }
        let since = Instant::now();
        let (metrics, output) = metrics.mark().map_err(failed)?;
        let (config, init, seconds) = (config_digest(&self.config), self.run.init.clone(), self.before + seconds);
        if !memory::copies_checkpoint([&self.config]) {
            let snapshot = trainer.view(*experiment).map_err(RunError::Fetch)?;
            return Ok(checkpoints.save_now(
                &Checkpoint { config, init, seconds, metrics, snapshot },
                &output,
                since,
            )?);
        }
        let bytes = self.config.policy_bytes();
        let of_snapshot = |error| RunError::of_snapshot(error, "a checkpoint beside training", bytes);
        let snapshot = trainer.snapshot(*experiment).map_err(of_snapshot)?;
        Ok(checkpoints.save(Checkpoint { config, init, seconds, metrics, snapshot }, output, since)?)
    }

    /// Writes the results in an order that leaves a usable checkpoint at any moment.
    pub(super) fn finish(&mut self, policies: &[&[f32]], end: Snapshot<&[f32]>, seconds: f64) -> Result<(), RunError> {
        let failed = self.metrics_failed();
        let Some(Unfinished { metrics, checkpoints, ending, .. }) = &mut self.unfinished else { return Ok(()) };
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
            checkpoints.save(Checkpoint { config, init, seconds, metrics, snapshot }, output, since)?;
        } else {
            checkpoints.save_now(&last, &output, since)?;
        }
        let path = self.folder.file(POLICIES);
        if self.folder.has(POLICIES)? {
            // The old checkpoints of an extended run need the old policies. The new checkpoint must be complete before
            // the policies are replaced.
            checkpoints.wait()?;
        }
        let checksum = policies::write(&self.folder.disk, &path, &self.config, policies)?;
        let (rows, RunSums { run: digest, metrics }) = self.folder.digest(&self.config, policies)?;
        checkpoints.wait()?;
        self.run.files = Some(FileSums { metrics, policies: checksum });
        self.write_run(Status::Done, next, seconds, Some(digest.clone()))?;
        self.folder.sync()?;
        self.results = Some(Results { rows, digest });
        self.unfinished = None;
        Ok(())
    }

    pub(super) fn write_run(
        &mut self,
        state: Status,
        next: usize,
        seconds: f64,
        digest: Option<String>,
    ) -> Result<(), RunError> {
        let generations = next.min(self.config.learning.generations + 1);
        let (updated, seconds) = (folder::now(), self.before + seconds);
        let files = self.run.files.take().filter(|_| state == Status::Done);
        self.run = Run { state, updated, seconds, generations, digest, files, ..self.run.clone() };
        Ok(self.folder.write_run(&self.run)?)
    }

    pub(super) fn metrics_failed(&self) -> impl FnOnce(std::io::Error) -> RunError + use<> {
        let path = self.folder.file(METRICS);
        move |error| RecordError::Write { path, error }.into()
    }
}
