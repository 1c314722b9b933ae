//! Training of the paper's experiments, each in a folder of its own.

use std::path::{Path, PathBuf};

use super::folder_name;
use crate::paper::{self, Experiment};
use flotilla::backend::OpenBackend;
use flotilla::config::Config;
use flotilla::escape::PathExt;
use flotilla::trainer::Row;
use flotilla_app::ops::{Context, Error, Event};
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{ARMS, Folder, Start, StartFrom};
use flotilla_app::report::{map::counted, runs};
use flotilla_app::run::{self, Session, SessionEnd, Twin};

/// The experiments of a paper and their folders. Experiments with the same training are trained once. The first of them
/// is trained, and the others are copies.
pub(super) struct Experiments {
    pub(super) all: Vec<Experiment>,
    /// The folder of each experiment.
    pub(super) folders: Vec<PathBuf>,
    /// The configs that are trained.
    pub(super) configs: Vec<Config>,
    /// The index of the config that each experiment is trained with.
    pub(super) config_of: Vec<usize>,
}

impl Experiments {
    pub(super) fn new(all: Vec<Experiment>, out: &Path) -> Experiments {
        let (configs, config_of) = paper::trained(&all);
        let folders = all.iter().map(|experiment| out.join(ARMS).join(folder_name(experiment))).collect();
        Experiments { all, folders, configs, config_of }
    }

    /// Returns the experiment that is trained with a config.
    fn trained(&self, config: usize) -> usize {
        self.config_of.iter().position(|&of| of == config).expect("each config is that of an experiment")
    }

    fn copies(&self) -> impl Iterator<Item = usize> {
        (0..self.all.len()).filter(|&experiment| self.trained(self.config_of[experiment]) != experiment)
    }

    /// Opens the runs of all configs, and warns of damaged files. `Start::Force` also clears the folders of copies.
    ///
    /// # Errors
    /// A folder cannot be used.
    pub(super) fn open(&self, start: Start, disk: &Disk, context: Context<'_>) -> Result<Session, Error> {
        let folders = (0..self.configs.len()).map(|config| self.folders[self.trained(config)].clone());
        let (session, notes) = Session::open(self.configs.iter().cloned().zip(folders).collect(), start, disk)?;
        for (config, note) in notes.iter().filter(|(_, note)| note.is_damage) {
            context.warn(format_args!("{}: {note}", self.all[self.trained(*config)].name()));
        }
        if start == Start::Force {
            // Old results are removed now, so that none are left if this run is stopped.
            for experiment in self.copies() {
                let (folder, config) = (&self.folders[experiment], &self.all[experiment].config);
                Folder::open(folder, start, config, StartFrom::Random, disk.clone())?;
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
        let learning = &self.all[0].config.learning;
        let (count, different, trials) = (self.all.len(), self.configs.len(), learning.trials);
        context.message(format_args!(
            "training {count} experiments, {different} of them different, of {} each on {on}, into {}",
            counted(trials, "trial"),
            out.escaped()
        ));
        let names = self.all.iter().map(|experiment| (experiment.name(), Some(experiment.pois()))).collect();
        let next = |generations: &[usize]| generations.iter().min().copied().unwrap_or(0);
        (context.report)(Event::Begin(names, next(session.generations()), learning.generations));
        // The trainer's experiments are the configs. A row counts for each experiment with that config.
        let of_all = |row: &Row| {
            let row = *row;
            let same = self.config_of.iter().enumerate().filter(move |&(_, &config)| config == row.experiment);
            same.map(move |(experiment, _)| Row { experiment, ..row })
        };
        let mut watch = |now: &run::Progress<'_>| {
            let rows: Vec<Row> = now.rows.iter().flat_map(of_all).collect();
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

    /// Records the copies. The runs that they copy must be finished.
    ///
    /// # Errors
    /// A folder cannot be used, read or written.
    pub(super) fn record_copies(&self, disk: &Disk) -> Result<(), Error> {
        let twin = |experiment: usize| Twin {
            of: self.folders[self.trained(self.config_of[experiment])].clone(),
            of_config: self.configs[self.config_of[experiment]].clone(),
            folder: self.folders[experiment].clone(),
            config: self.all[experiment].config.clone(),
        };
        Ok(run::record_twins(self.copies().map(twin).collect(), Start::Resume, disk)?)
    }

    /// Reads the results of all experiments.
    ///
    /// # Errors
    /// Metrics are missing or were changed after the run.
    pub(super) fn read_metrics(&mut self, disk: &Disk) -> Result<(), Error> {
        for (experiment, folder) in self.all.iter_mut().zip(&self.folders) {
            let config = experiment.config.clone();
            runs::metrics(disk.at(folder), &config, Verification::Required, |row| experiment.add(row))?;
        }
        Ok(())
    }
}
