//! Training of the paper's experiments, each in a folder of its own.

use std::path::{Path, PathBuf};

use super::arm_name;
use crate::backend::OpenBackend;
use crate::config::Config;
use crate::escape::PathExt;
use crate::ops::{Context, Error, Event};
use crate::record::RecordError;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::folder::{self, ARMS, Folder, Start, StartFrom};
use crate::report::paper::{self, Experiment};
use crate::report::runs;
use crate::run::{self, Session, SessionEnd, Twin};
use crate::trainer::Row;

/// The experiments of a paper and their folders. Experiments with the same config are trained once. The first of them
/// is trained, and the others are copies.
pub(super) struct Arms {
    /// All experiments.
    pub(super) experiments: Vec<Experiment>,
    /// The folder of each experiment.
    pub(super) folders: Vec<PathBuf>,
    /// The different configs.
    pub(super) configs: Vec<Config>,
    /// The index of each experiment's config.
    pub(super) config_of: Vec<usize>,
}

impl Arms {
    pub(super) fn new(experiments: Vec<Experiment>, out: &Path) -> Arms {
        let (configs, config_of) = paper::trained(&experiments);
        let folders = experiments.iter().map(|experiment| out.join(ARMS).join(arm_name(experiment))).collect();
        Arms { experiments, folders, configs, config_of }
    }

    /// Returns the experiment that is trained with a config.
    fn trained(&self, config: usize) -> usize {
        self.config_of.iter().position(|&of| of == config).expect("each config is that of an experiment")
    }

    /// Returns the experiments that are copies.
    fn copies(&self) -> impl Iterator<Item = usize> {
        (0..self.experiments.len()).filter(|&arm| self.trained(self.config_of[arm]) != arm)
    }

    /// Checks whether runs may be started in all folders, without changing them.
    ///
    /// # Errors
    /// See [`folder::check`].
    pub(super) fn check_folders(&self, disk: &Disk, start: Start) -> Result<(), RecordError> {
        let configs = self.experiments.iter().map(|experiment| &experiment.config);
        folder::check(disk, self.folders.iter().map(|path| &**path).zip(configs), start)
    }

    /// Opens the runs of all configs, and warns of damaged files.
    ///
    /// # Errors
    /// A folder cannot be used.
    pub(super) fn open(&self, start: Start, disk: &Disk, context: Context<'_>) -> Result<Session, Error> {
        let folders = (0..self.configs.len()).map(|config| self.folders[self.trained(config)].clone());
        let (session, notes) = Session::open(self.configs.iter().cloned().zip(folders).collect(), start, disk)?;
        for (config, note) in notes.iter().filter(|(_, note)| note.is_damage()) {
            context.warn(format_args!("{}: {note}", self.experiments[self.trained(*config)].name()));
        }
        if start == Start::Force {
            // Old results are removed now, so that none are left if this run is stopped.
            for arm in self.copies() {
                let config = &self.experiments[arm].config;
                Folder::open(&self.folders[arm], start, config, StartFrom::Random, disk.clone())?;
            }
        }
        Ok(session)
    }

    /// Trains all configs side by side. `on` describes the backend for people.
    ///
    /// # Errors
    /// Training fails or is stopped.
    pub(super) fn train(
        &self,
        session: &mut Session,
        backend: &mut OpenBackend,
        on: &str,
        out: &Path,
        context: Context<'_>,
    ) -> Result<(), Error> {
        let learning = &self.experiments[0].config.learning;
        let (count, different, trials) = (self.experiments.len(), self.configs.len(), learning.trials);
        context.message(format_args!(
            "training {count} experiments, {different} of them different, of {trials} trials each on {on}, into {}",
            out.escaped()
        ));
        let names = self.experiments.iter().map(|arm| (arm.name(), Some(arm.pois()))).collect();
        let next = |generations: &[usize]| generations.iter().min().copied().unwrap_or(0);
        (context.report)(Event::Begin(names, next(session.generations()), learning.generations));
        // A row of a config counts for each of its experiments.
        let of_arms = |row: &Row| {
            let row = *row;
            let arms = self.config_of.iter().enumerate().filter(move |&(_, &config)| config == row.experiment);
            arms.map(move |(arm, _)| Row { experiment: arm, ..row })
        };
        let mut watch = |now: &run::Progress<'_>| {
            let rows: Vec<Row> = now.rows.iter().flat_map(of_arms).collect();
            context.rows(next(now.generations), &rows);
        };
        let ended = context.train(&mut watch, |options| session.train(backend, options));
        (context.report)(Event::Pause);
        if ended? == SessionEnd::Stopped {
            let (next, last) = (next(session.generations()), learning.generations);
            return Err(Error::Stopped(format!("before generation {next} of {last}, with everything saved").into()));
        }
        Ok(())
    }

    /// Records the copies, whose configs must have been trained.
    ///
    /// # Errors
    /// A folder cannot be used, read or written.
    pub(super) fn record_copies(&self, disk: &Disk) -> Result<(), Error> {
        let twin = |arm: usize| Twin {
            of: self.folders[self.trained(self.config_of[arm])].clone(),
            of_config: self.configs[self.config_of[arm]].clone(),
            folder: self.folders[arm].clone(),
            config: self.experiments[arm].config.clone(),
        };
        Ok(run::record_twins(self.copies().map(twin).collect(), Start::Resume, disk)?)
    }

    /// Reads the results of all experiments.
    ///
    /// # Errors
    /// Metrics are missing or were changed after the run.
    pub(super) fn read_metrics(&mut self) -> Result<(), Error> {
        for (arm, folder) in self.experiments.iter_mut().zip(&self.folders) {
            let config = arm.config.clone();
            runs::metrics(folder, &config, Verification::Required, |row| arm.add(row))?;
        }
        Ok(())
    }
}
