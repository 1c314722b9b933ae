//! Where a run in a folder resumes, and whether it is finished.

use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::Path;

use sha2::Digest;

use super::{
    CHECKPOINTS, CONFIG, Checkpoint, Folder, INIT_MARK, METRICS, Note, Origin, POLICIES, RUN, Resumed, Run, RunSums,
};
use super::{StartFrom, Status};
use crate::record::metrics;
use crate::record::{
    RecordError, checkpoint, config_digest, hex, policies, tensors, values_by_key, without_checkpoint,
};
use flotilla::config::Config;
use flotilla::escape::PathExt;
use flotilla::trainer::Row;

/// Rows of a run's first and last generation, `[trials]` each.
#[derive(Clone, Debug, PartialEq)]
pub struct FirstAndLastRows {
    /// Rows of generation 0.
    pub first: Vec<Row>,
    /// Rows of the last generation.
    pub last: Vec<Row>,
}

/// A checkpoint, and the metrics truncated to match it.
type ResumePoint = (Checkpoint, metrics::Writer);

impl Folder {
    /// Finds the checkpoint from which the run resumes. Unusable checkpoints are renamed or removed.
    pub(super) fn find(&self, config: &Config, from: StartFrom<'_>, found: &mut Resumed) -> Result<(), RecordError> {
        let (checkpoints, init) = (self.file(CHECKPOINTS), from.digest());
        let init = init.as_deref();
        self.refuse_newer(&checkpoints)?;
        let before = self.find_finished(config, from, found)?;
        if found.finished.is_some() {
            return Ok(());
        }
        if found.run.as_ref().is_some_and(|run| run.own_fitness) {
            let path = self.path.escaped();
            return Err(RecordError::refused(
                format!(
                    "{path}: its fitness is not the config's, but came from the program that trained it, so it cannot be \
                     extended"
                ),
                "start a new run from its policies with --init, or choose another --out",
            ));
        }
        // If the folder cannot be written, this fails before anything changes.
        found.run.as_ref().map_or(Ok(()), |run| self.write_run(run))?;
        let mut kept = checkpoint::remove_temporary_files(&self.disk, &checkpoints)?;
        let origin_error = self.origin_error(config, found.run.as_ref(), before.is_some());
        let (is_other, had_checkpoints) = (origin_error.is_some(), !kept.is_empty());
        found.checkpoint =
            self.find_checkpoint(config, before.as_ref(), is_other, init, &mut kept, &mut found.notes)?;
        if found.checkpoint.is_none() {
            if let Some(error) = origin_error {
                return Err(error);
            }
            self.check_start(found.run.as_ref(), from, had_checkpoints)?;
        }
        found.notes.push(match &found.checkpoint {
            Some((checkpoint, _)) => Note::normal(format!("resuming at generation {}", checkpoint.snapshot.generation)),
            None if had_checkpoints => Note::damage("no checkpoint can be used: starting over, to the same results"),
            None => Note::normal("no checkpoint yet: starting from the beginning"),
        });
        found.kept = kept;
        Ok(())
    }

    /// Returns the newest usable checkpoint of a run that trains in this folder, and the generations of all.
    pub(crate) fn last_checkpoint(&self, config: &Config) -> Result<(Option<ResumePoint>, Vec<usize>), RecordError> {
        let mut kept = checkpoint::list(&self.file(CHECKPOINTS))?;
        let newest = self.find_checkpoint(config, Some(config), false, None, &mut kept, &mut Vec::new())?;
        Ok((newest, kept))
    }

    /// Reads `run.json`, and the results if the run is finished. Returns the config in the folder, if it can be read.
    pub(super) fn find_finished(
        &self,
        config: &Config,
        from: StartFrom<'_>,
        found: &mut Resumed,
    ) -> Result<Option<Config>, RecordError> {
        let before = self.compare(config, found)?;
        match self.read_run() {
            Ok(run) => found.run = Some(run),
            Err(RecordError::Read { error, .. }) if error.kind() == ErrorKind::NotFound => {}
            Err(error @ RecordError::Damaged { .. }) => {
                found.notes.push(Note::damage(format!("{error}; it is rewritten")))
            }
            Err(error) => return Err(error),
        }
        found.finished = found.run.as_ref().map_or(Ok(None), |run| self.finished(run, config))?;
        if let Some(run) = found.run.as_ref().filter(|_| found.finished.is_some()) {
            self.check_init(run.init.as_deref(), from.digest().as_deref())?;
        }
        Ok(before)
    }

    /// Returns an error if the run's origin does not allow the given config. `has_config` says that `config.toml` could
    /// be read. It then agrees with the given config, so that a mismatch means that it was edited.
    pub(super) fn origin_error(&self, config: &Config, run: Option<&Run>, has_config: bool) -> Option<RecordError> {
        let origin = Some(&run?.origin).filter(|origin| !origin.allows(config))?;
        let (existing, requested) = (origin.generations, config.learning.generations);
        Some(match existing > requested {
            true => RecordError::shorter(&self.path, existing, requested),
            false if has_config => RecordError::Edited(self.file(CONFIG)),
            false => {
                let difference = format!("  {} has another digest", self.file(RUN).display());
                RecordError::config_differs(&self.path, &[difference])
            }
        })
    }

    /// Returns the newest usable checkpoint among the generations in `kept`. Unusable ones are renamed or removed, and
    /// leave `kept`.
    ///
    /// `before` is the config in the folder, if it can be read. `is_other` says that the run's origin does not allow
    /// the given config. A checkpoint of another config is no damage then: it is kept, and the search ends there.
    fn find_checkpoint(
        &self,
        config: &Config,
        before: Option<&Config>,
        is_other: bool,
        init: Option<&str>,
        kept: &mut Vec<usize>,
        notes: &mut Vec<Note>,
    ) -> Result<Option<(Checkpoint, metrics::Writer)>, RecordError> {
        let checkpoints = self.file(CHECKPOINTS);
        while let Some(&generation) = kept.last() {
            let path = checkpoint::path(&checkpoints, generation);
            let policies = self.file(POLICIES);
            let at = |path| self.disk.at(path);
            let reason = match checkpoint::read(at(&path), at(&policies), config) {
                Ok(Some(checkpoint)) if checkpoint.is_of(config) => {
                    self.check_init(checkpoint.init.as_deref(), init)?;
                    let metrics = self.file(METRICS);
                    let resumed = metrics::Writer::resume(&self.disk, &metrics, &checkpoint.metrics, config);
                    match resumed.map_err(RecordError::write(&metrics))? {
                        Some(metrics) => return Ok(Some((checkpoint, metrics))),
                        None => format!("{}: {} has changed since this was written", path.escaped(), metrics.escaped()),
                    }
                }
                Ok(Some(_)) if is_other => break,
                Ok(Some(_)) if before.is_some() => format!("{}: it is of another run", path.escaped()),
                Ok(Some(_)) => {
                    let difference = format!("  {} has another digest", path.escaped());
                    return Err(RecordError::config_differs(&self.path, &[difference]));
                }
                Ok(None) => {
                    // Only the end of a run writes such a checkpoint. Its policies were not written yet, or others
                    // replaced them.
                    self.disk.remove(&path).map_err(RecordError::write(&path))?;
                    kept.pop();
                    continue;
                }
                Err(error @ RecordError::Damaged { .. }) => error.to_string(),
                Err(error) => return Err(error),
            };
            let next = if kept.len() > 1 { "the one before is tried" } else { "there is no other" };
            notes.push(Note::damage(format!("{reason}; set aside, and {next}")));
            let damaged = checkpoint::quarantine_path(&path);
            self.disk.rename(&path, &damaged).map_err(RecordError::write(&damaged))?;
            kept.pop();
        }
        Ok(None)
    }

    /// Fails if a run without usable checkpoints cannot start over as it began. `run` is the content of `run.json`, if
    /// it can be read.
    fn check_start(&self, run: Option<&Run>, from: StartFrom<'_>, had_checkpoints: bool) -> Result<(), RecordError> {
        let Some(run) = run else {
            if from == StartFrom::Unspecified
                && (had_checkpoints
                    || self.has(INIT_MARK)?
                    || self.has(RUN)?
                    || self.has(METRICS)?
                    || self.has(POLICIES)?)
            {
                let path = self.path.escaped();
                return Err(RecordError::refused(
                    format!(
                        "{path}: its run.json is missing or damaged, so it is not known what policies this run started \
                         from"
                    ),
                    "pass the policies that it started from with --init, or start over with --force",
                ));
            }
            return Ok(());
        };
        let init = from.digest();
        self.check_init(run.init.as_deref(), init.as_deref())?;
        match &run.init {
            Some(existing) if init.is_none() => Err(RecordError::init_needed(&self.path, existing)),
            _ => Ok(()),
        }
    }

    /// Fails if a newer version of the program wrote any of the files. Callers check this before they change a file.
    fn refuse_newer(&self, checkpoints: &Path) -> Result<(), RecordError> {
        let generations = checkpoint::list(self.disk.at(checkpoints))?.into_iter();
        let files = generations.map(|generation| checkpoint::path(checkpoints, generation));
        for path in files.chain([self.file(POLICIES)]) {
            if let Some(version) = tensors::newer(self.disk.at(&path)) {
                // Only checkpoints contain the version that wrote them.
                let recorded = || Some(self.read_run().ok()?.version);
                return Err(RecordError::newer(&path, version.or_else(recorded)));
            }
        }
        Ok(())
    }

    /// Fails if the given policies are not those that the run started from.
    fn check_init(&self, existing: Option<&str>, requested: Option<&str>) -> Result<(), RecordError> {
        match requested {
            Some(requested) if existing != Some(requested) => {
                Err(RecordError::init_differs(&self.path, existing, requested))
            }
            _ => Ok(()),
        }
    }

    /// Fails if the given config differs from the one in the folder. Only more generations are allowed. Returns the
    /// config in the folder, if it can be read.
    fn compare(&self, config: &Config, found: &mut Resumed) -> Result<Option<Config>, RecordError> {
        match self.config() {
            Ok(before) => {
                let (existing, requested) = (before.learning.generations, config.learning.generations);
                let mut as_long = before.clone();
                as_long.learning.generations = requested;
                if existing > requested && differences(&as_long, config).is_empty() {
                    return Err(RecordError::shorter(&self.path, existing, requested));
                }
                let differences = differences(if existing < requested { &as_long } else { &before }, config);
                if !differences.is_empty() {
                    return Err(RecordError::config_differs(&self.path, &differences));
                }
                Ok(Some(before))
            }
            Err(_) if !self.has(CONFIG)? && checkpoint::list(self.disk.at(&self.file(CHECKPOINTS)))?.is_empty() => {
                Ok(None)
            }
            Err(error) => {
                found.notes.push(Note::damage(format!("{error}; it is rewritten")));
                Ok(None)
            }
        }
    }

    /// Reads all metrics of a finished run. Returns the first and the last generation, and the digests.
    ///
    /// The run digest is the SHA-256 of `metrics.csv` without `seconds` and `stage`, then of the policies of every
    /// trial as in their file (f32, little-endian). All runs of a config have the same digest, on any backend and after
    /// any number of resumes.
    ///
    /// # Errors
    /// The metrics cannot be read, or they do not have exactly one row per trial and generation.
    pub fn digest(
        &self,
        config: &Config,
        policies: &[impl AsRef<[f32]>],
    ) -> Result<(FirstAndLastRows, RunSums), RecordError> {
        let path = self.file(METRICS);
        let (trials, last) = (config.learning.trials, config.learning.generations);
        let mut ends = FirstAndLastRows { first: vec![], last: vec![] };
        let found = metrics::visit(self.disk.at(&path), config, |row| {
            if row.generation == 0 {
                ends.first.push(*row);
            }
            if row.generation == last {
                ends.last.push(*row);
            }
        })?;
        let (count, mut hash) = (found.rows, found.digest);
        if count != trials * (last + 1) || found.is_torn {
            let reason = format!("it has {count} whole rows, not {}", trials * (last + 1));
            return Err(RecordError::damaged(&path, reason));
        }
        let metrics = hex(&hash.clone().finalize());
        policies.iter().for_each(|weights| hash.update(bytemuck::cast_slice::<f32, u8>(weights.as_ref())));
        Ok((ends, RunSums { run: hex(&hash.finalize()), metrics }))
    }

    /// Returns the results of a finished run, or `None` if a file has changed since the run ended.
    fn finished(&self, run: &Run, config: &Config) -> Result<Option<FirstAndLastRows>, RecordError> {
        let Some(digest) = run.digest.as_ref().filter(|_| run.state == Status::Done) else { return Ok(None) };
        if run.generations != config.learning.generations + 1 {
            return Ok(None);
        }
        if run.origin != Origin::of(config) {
            return Ok(None);
        }
        let path = self.file(POLICIES);
        let policies = policies::read_all(self.disk.at(&path), config);
        let (of_config, checksum) = policies::digests_in(self.disk.at(&path));
        if policies.is_ok() && of_config != Some(config_digest(config)) {
            return Ok(None);
        }
        let same = |found: &RunSums| {
            let files = run.files.as_ref();
            let same = files.is_none_or(|it| it.metrics == found.metrics && Some(&it.policies) == checksum.as_ref());
            found.run == *digest && same
        };
        match policies.and_then(|policies| self.digest(config, &policies)) {
            Ok((rows, found)) => Ok(same(&found).then_some(rows)),
            // Missing or damaged files are written again. A file that cannot be read now may still be intact, so that
            // is an error.
            Err(RecordError::Read { path, error }) if error.kind() != ErrorKind::NotFound => {
                Err(RecordError::Read { path, error })
            }
            Err(_) => Ok(None),
        }
    }
}

/// Returns a line for each key in which two configs differ. Keys without influence on the results are ignored.
pub fn differences(old: &Config, new: &Config) -> Vec<String> {
    let [old, new] = [old, new].map(|config| values_by_key(&without_checkpoint(config)));
    let keys: BTreeSet<_> = old.keys().chain(new.keys()).collect();
    let line = |key: &String| {
        let [there, here] = [&old, &new].map(|values| values.get(key).map_or("nothing".into(), ToString::to_string));
        let same = there.chars().zip(here.chars()).take_while(|(there, here)| there == here).count();
        let [there, here] = [there, here].map(|text| shorten(&text, same));
        format!("  {key}: {there} there, {here} here")
    };
    keys.into_iter().filter(|key| old.get(*key) != new.get(*key)).map(line).collect()
}

/// Returns a part of a long text that has the character at index `differs`.
fn shorten(text: &str, differs: usize) -> String {
    const LENGTH: usize = 60;
    let length = text.chars().count();
    if length <= LENGTH {
        return text.into();
    }
    let start = if differs < LENGTH { 0 } else { differs - LENGTH / 2 };
    let [before, after] = [start > 0, start + LENGTH < length].map(|is_cut| if is_cut { "…" } else { "" });
    let part: String = text.chars().skip(start).take(LENGTH).collect();
    format!("{before}{part}{after}")
}
