//! A run's folder: who may write in it, what is in it, and where a run in it goes on.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::checkpoint::{self, Checkpoint};
use super::disk::Disk;
use super::metrics::{self, RowsError};
use super::ownership::{self, CURVES, MAX_RUN_BYTES, REPLAY};
pub use super::ownership::{ARMS, CHECKPOINTS, CONFIG, METRICS, PAPER, POINTS, POLICIES, RESULTS, RUN, SWEEP};
use super::{RecordError, config_digest, hex, policies, read_text, tensors};
use crate::config::{Config, MAX_STAGES};
use crate::escape::PathExt;
use crate::file;
use crate::host;
use crate::trainer::Row;

/// Stands in a folder while a run from given policies begins in it, until `run.json` says so.
const INIT_MARK: &str = ".init";
/// Locked by whoever trains in the folder. The lock is the system's: it goes with the process, however that ends.
const LOCK: &str = ".lock";
/// Most bytes in a `config.toml` that is kept where another takes its place.
const MAX_KEPT_BYTES: u64 = 1 << 20;

/// What to do with a folder that holds a run already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Refuse it.
    Fresh,
    /// Write over it.
    Force,
    /// Go on with it, or start it where there is none.
    Resume,
}

/// `run.json`: what a run ran on, and how far it came.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Of the program.
    pub version: String,
    /// How far it came.
    pub state: Status,
    /// Its config's.
    pub seed: u64,
    /// "cpu" or "gpu".
    pub backend: String,
    /// What it runs on, in words.
    pub description: String,
    /// The GPU, if one was used.
    pub adapter: Option<String>,
    /// Its driver.
    pub driver: Option<String>,
    /// Threads of the CPU that work.
    pub threads: usize,
    /// UTC, of the first session's start.
    pub started: String,
    /// UTC, of this file's writing.
    pub updated: String,
    /// Time trained in all sessions.
    pub seconds: f64,
    /// How often it was started or resumed.
    pub sessions: u64,
    /// Generations played, the random start included.
    pub generations: usize,
    /// See [`RunSums::run`]; once the run is done.
    pub digest: Option<String>,
    /// What it was started with. Runs of earlier versions do not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<Origin>,
    /// Digests of its files, once the run is done. Runs of earlier versions do not have them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub files: Option<FileSums>,
    /// [`policies::Init::digest`] of what it started from, if not at random.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<String>,
    /// What the last session was started by, as a shell reads it.
    #[serde(default)]
    pub command: String,
    /// The commit that the program was built from, where it was built from one.
    #[serde(default)]
    pub commit: Option<String>,
}

/// The config that a run was started with, which it keeps when it is resumed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// [`config_digest`] of it.
    pub config: String,
    /// Its generations, which alone may grow.
    pub generations: usize,
}

impl Origin {
    /// The origin of a run of a config.
    pub fn of(config: &Config) -> Origin {
        Origin { config: config_digest(config), generations: config.learning.generations }
    }

    /// Whether a run that was started so may be resumed with a config.
    fn allows(&self, config: &Config) -> bool {
        self.generations <= config.learning.generations
            && self.config == config_digest(&checkpoint::of_length(config, self.generations))
    }
}

/// Digests of a finished run's files.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSums {
    /// See [`RunSums::metrics`].
    #[serde(rename = "metrics.csv")]
    pub metrics: String,
    /// The checksum that the file carries, see [`super::tensors`].
    #[serde(rename = "policies.safetensors")]
    pub policies: String,
}

/// Digests of what a run came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunSums {
    /// SHA-256 of the metrics and then of every trial's policies, see [`Folder::digest`].
    pub run: String,
    /// SHA-256 of `metrics.csv` without `seconds` and `stage`.
    pub metrics: String,
}

/// How far a run came.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// It trains, or was killed.
    Running,
    /// By a signal or an error, after saving.
    Stopped,
    /// It has played its last generation.
    Done,
    /// It takes the place of another run, whose files are not all gone yet: what is there counts for nothing.
    Replacing,
}

impl Run {
    /// A run that has not started yet.
    pub fn new(config: &Config) -> Run {
        Run {
            version: String::new(),
            state: Status::Running,
            seed: config.learning.seed,
            backend: String::new(),
            description: String::new(),
            adapter: None,
            driver: None,
            threads: 0,
            started: now(),
            updated: String::new(),
            seconds: 0.0,
            sessions: 0,
            generations: 0,
            digest: None,
            origin: Some(Origin::of(config)),
            files: None,
            init: None,
            command: String::new(),
            commit: None,
        }
    }

    /// Reads `run.json`.
    ///
    /// # Errors
    /// It cannot be read, or is not what it should be.
    pub fn read(path: &Path) -> Result<Run, RecordError> {
        let text = read_text(path, MAX_RUN_BYTES)?;
        Run::parse(&text).map_err(|reason| match newer_version(&text) {
            Some(version) => RecordError::Newer { path: path.into(), version: Some(version) },
            None => RecordError::damaged(path, reason),
        })
    }

    /// Reads the text of a `run.json`.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn parse(text: &str) -> Result<Run, String> {
        serde_json::from_str(text).map_err(|error| format!("it is no record of a run: {error}"))
    }

    /// The text of `run.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain fields are JSON") + "\n"
    }
}

/// The version in the text of a `run.json`, if it is newer than this program's.
fn newer_version(text: &str) -> Option<String> {
    let numbers = |version: &str| -> Option<Vec<u64>> {
        version.split(['-', '+']).next()?.split('.').map(|number| number.parse().ok()).collect()
    };
    let version = serde_json::from_str::<serde_json::Value>(text).ok()?.get("version")?.as_str()?.to_string();
    (numbers(&version)? > numbers(crate::VERSION)?).then_some(version)
}

/// What a run is told to start from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartFrom<'a> {
    /// Nothing was said: a run that is resumed keeps what it was started from.
    Unsaid,
    /// Random policies, which is all that the run can have been started from.
    Random,
    /// Policies with this [`policies::Init::digest`].
    Policies(&'a str),
}

impl StartFrom<'_> {
    /// The digest of the given policies.
    fn digest(self) -> Option<String> {
        if let StartFrom::Policies(digest) = self { Some(digest.into()) } else { None }
    }
}

/// A folder that this process, and no other, trains in.
pub struct Folder {
    /// Where it is.
    pub path: PathBuf,
    /// What it is written through.
    pub disk: Disk,
    lock: Option<File>,
}

/// Where a run goes on, and what there is to tell about it.
pub struct Resumed {
    /// The newest whole checkpoint, and metrics cut to where it stands.
    pub checkpoint: Option<(Checkpoint, metrics::Writer)>,
    /// Generations of all checkpoints that may be used, oldest first.
    pub kept: Vec<usize>,
    /// `run.json` as the last session left it.
    pub run: Option<Run>,
    /// What the run came to, where it is done and all its files are as it left them; nothing else is looked at then.
    pub finished: Option<Story>,
    /// What there is to tell.
    pub notes: Vec<Note>,
}

/// What was found in a folder, and what is done about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Note {
    /// A checkpoint that cannot be used, for this reason.
    SetAside(String),
    /// A small file that cannot be read, for this reason.
    WrittenAnew(String),
    /// The folder's config was written by hand, and another takes its place.
    ConfigKept {
        /// Where what was there is from now on.
        path: PathBuf,
    },
    /// A replacement of the run was interrupted.
    Replacing,
    /// There is a whole checkpoint.
    GoingOn {
        /// The one that plays next.
        generation: usize,
    },
    /// None of the checkpoints can be used.
    StartingOver,
    /// There are none.
    Starting,
    /// The file system has no locks.
    NotLocked,
}

impl Note {
    /// Returns whether a person has to know this: every resumed run has the other notes.
    pub fn is_damage(&self) -> bool {
        matches!(self, Note::SetAside(_) | Note::WrittenAnew(_) | Note::StartingOver | Note::NotLocked)
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Note::SetAside(reason) => write!(f, "{reason}; set aside, going back to the one before"),
            Note::WrittenAnew(reason) => write!(f, "{reason}; it is written anew"),
            Note::ConfigKept { path } => {
                write!(f, "{CONFIG} has changed; the text that was there is kept as {}", path.display())
            }
            Note::Replacing => f.write_str("the run that was here was being replaced: what is left of it is removed"),
            Note::GoingOn { generation } => write!(f, "going on before generation {generation}"),
            Note::StartingOver => f.write_str("no checkpoint can be used: starting over, to the same results"),
            Note::NotLocked => f.write_str(
                "this file system has no locks, so another process is not kept from training here; start one at a time",
            ),
            Note::Starting => f.write_str("no checkpoint yet: starting from the beginning"),
        }
    }
}

/// Where a run came from and to, `[trials]` each.
#[derive(Clone, Debug, PartialEq)]
pub struct Story {
    /// Of the random start.
    pub first: Vec<Row>,
    /// Of the last generation.
    pub last: Vec<Row>,
}

impl Folder {
    /// Takes a folder for a run of a config, creating it where needed. What the run starts from is recorded before
    /// anything else is written.
    ///
    /// # Errors
    /// It holds a run that must not be written over, is in use, belongs to another config or a newer version, started
    /// from other or unknown policies, or needs those that it started from; or it cannot be written.
    pub fn open(
        path: &Path,
        start: Start,
        config: &Config,
        from: StartFrom<'_>,
        disk: Disk,
    ) -> Result<(Folder, Resumed), RecordError> {
        if path.is_file() {
            return Err(RecordError::NoFolder { path: path.into() });
        }
        let holds_run = || match ownership::holds_run(path, config)? {
            true if start == Start::Fresh => Err(RecordError::Exists { path: path.into() }),
            holds => Ok(holds),
        };
        holds_run()?;
        disk.create_folder(path).map_err(RecordError::write(path))?;
        let disk = ownership::enter(&disk, path, true)?;
        ownership::refuse_links(&disk, path)?;
        let mark = path.join(INIT_MARK);
        if from.digest().is_some() && !file::exists(&path.join(RUN)).map_err(RecordError::read(path))? {
            // Whoever resumes a run that was killed before `run.json` was whole must not take random policies.
            disk.create(&mark).map_err(RecordError::write(&mark))?;
        }
        let lock = lock(&disk, path)?;
        // Only now is nobody else writing here.
        let there = holds_run()?;
        let folder = Folder { path: path.into(), disk, lock };
        let mut found = Resumed { checkpoint: None, kept: vec![], run: None, finished: None, notes: vec![] };
        found.notes.extend(folder.lock.is_none().then_some(Note::NotLocked));
        let interrupted = Run::read(&folder.file(RUN)).ok().filter(|run| run.state == Status::Replacing);
        match (start, interrupted) {
            (Start::Force, _) if there => {
                folder.clear(&Run { init: from.digest(), ..Run::new(config) }, config, &mut found)?;
            }
            (Start::Resume, Some(run)) => {
                found.notes.push(Note::Replacing);
                folder.clear(&run, config, &mut found)?;
            }
            _ => {}
        }
        if start == Start::Resume {
            folder.find(config, from, &mut found)?;
        }
        if found.finished.is_some() {
            if Config::load(&folder.file(CONFIG)).is_err() {
                found.notes.extend(folder.write_config(config)?);
            }
            return Ok((folder, found));
        }
        folder.record_origin(config, from, &mut found)?;
        folder.disk.remove(&mark).map_err(RecordError::write(&mark))?;
        let checkpoints = folder.file(CHECKPOINTS);
        folder.disk.create_folder(&checkpoints).map_err(RecordError::write(&checkpoints))?;
        // A file that says the same may be somebody's own, with comments.
        if Config::load(&folder.file(CONFIG)).ok().as_ref() != Some(config) {
            found.notes.extend(folder.write_config(config)?);
        }
        Ok((folder, found))
    }

    /// Writes into `run.json` what a run starts from, unless it is there. A finished run that goes on is no longer
    /// finished, so that nobody compares its files with digests that are about to be wrong.
    fn record_origin(&self, config: &Config, from: StartFrom<'_>, found: &mut Resumed) -> Result<(), RecordError> {
        let there = found.checkpoint.as_ref().and_then(|(checkpoint, _)| checkpoint.init.clone());
        let before = found.run.clone();
        let mut run = before.clone().unwrap_or_else(|| Run::new(config));
        run.init = from.digest().or(there).or(run.init);
        if run.state == Status::Done {
            run = Run { state: Status::Running, digest: None, files: None, ..run };
        }
        // What an earlier version left out.
        run.origin = run.origin.or_else(|| Some(Origin::of(config)));
        if before.as_ref() != Some(&run) {
            self.write_run(&run)?;
        }
        found.run = Some(run);
        Ok(())
    }

    /// Writes `config.toml`; a text that was written by hand is kept beside it, which the note says.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<Option<Note>, RecordError> {
        let kept = self.keep_config()?;
        self.write_text(CONFIG, &config.to_toml())?;
        Ok(kept.map(|path| Note::ConfigKept { path }))
    }

    /// Copies `config.toml` if it is another text than flotilla writes; gives where the copy is.
    fn keep_config(&self) -> Result<Option<PathBuf>, RecordError> {
        let Ok(text) = read_text(&self.file(CONFIG), MAX_KEPT_BYTES) else { return Ok(None) };
        if Config::parse(&text, CONFIG).is_ok_and(|config| config.to_toml() == text) {
            return Ok(None);
        }
        for number in 1.. {
            let path = self.file(&numbered_config(number));
            if self.disk.kind(&path).map_err(RecordError::write(&path))?.is_none() {
                self.disk
                    .replace(&path, |output| output.write_all(text.as_bytes()))
                    .map_err(RecordError::write(&path))?;
                return Ok(Some(path));
            }
            // Kept already, where what came after was interrupted.
            if read_text(&path, MAX_KEPT_BYTES).is_ok_and(|there| there == text) {
                return Ok(Some(path));
            }
        }
        unreachable!("there are more numbers than files")
    }

    /// Removes a run; whatever else is in the folder stays. From its first step on `run.json` says that the run is being
    /// replaced, and by what.
    fn clear(&self, by: &Run, config: &Config, found: &mut Resumed) -> Result<(), RecordError> {
        self.write_run(&Run { state: Status::Replacing, ..by.clone() })?;
        let checkpoints = self.file(CHECKPOINTS);
        let generations = checkpoint::tidy(&self.disk, &checkpoints)?;
        let old = generations.into_iter().map(|generation| checkpoint::path(&checkpoints, generation));
        for path in old.chain([METRICS, POLICIES].map(|name| self.file(name))) {
            self.disk.remove(&path).map_err(RecordError::write(&path))?;
        }
        for name in [CURVES, REPLAY] {
            ownership::withdraw(&self.disk, &self.file(name))?;
        }
        // Replaced whole, since the new run may be read from it.
        if Config::load(&self.file(CONFIG)).ok().as_ref() != Some(config) {
            found.notes.extend(self.write_config(config)?);
        }
        self.write_run(&Run { state: Status::Running, ..by.clone() })
    }

    /// Finds where the run goes on; what cannot go on is left as it is.
    fn find(&self, config: &Config, from: StartFrom<'_>, found: &mut Resumed) -> Result<(), RecordError> {
        let (checkpoints, init) = (self.file(CHECKPOINTS), from.digest());
        let init = init.as_deref();
        self.refuse_newer(&checkpoints)?;
        let mut kept = checkpoint::tidy(&self.disk, &checkpoints)?;
        let before = self.compare(config, found, !kept.is_empty())?;
        match Run::read(&self.file(RUN)) {
            Ok(run) => found.run = Some(run),
            Err(RecordError::Read { error, .. }) if error.kind() == ErrorKind::NotFound => {}
            Err(error @ RecordError::Damaged { .. }) => found.notes.push(Note::WrittenAnew(error.to_string())),
            Err(error) => return Err(error),
        }
        found.finished = found.run.as_ref().map_or(Ok(None), |run| self.finished(run, config))?;
        let began = found.run.as_ref().map(|run| run.init.clone());
        if found.finished.is_some() {
            return began.map_or(Ok(()), |there| self.started_alike(there, init));
        }
        // Where nothing says otherwise, the file there was edited: it says the same as the config given.
        let edited = || {
            let origin = found.run.as_ref()?.origin.as_ref().filter(|origin| !origin.allows(config))?;
            let (path, there, here) = (self.path.clone(), origin.generations, config.learning.generations);
            Some(match there > here {
                true => RecordError::Shorter { path, there, here },
                false if before.is_some() => RecordError::Edited { path: self.file(CONFIG) },
                false => {
                    let differences = vec![format!("  {} says so, without saying what", self.file(RUN).display())];
                    RecordError::ConfigDiffers { path, differences }
                }
            })
        };
        let edited = edited();
        let any = !kept.is_empty();
        while let Some(&generation) = kept.last() {
            let path = checkpoint::path(&checkpoints, generation);
            // Those of an earlier version do not say how long their run was to be, but the config there does.
            let reason = match checkpoint::read(&path, &self.file(POLICIES), before.as_ref().unwrap_or(config)) {
                Ok(Some(checkpoint)) if checkpoint.is_of(config) => {
                    self.started_alike(checkpoint.init.clone(), init)?;
                    let metrics = self.file(METRICS);
                    let resumed = metrics::Writer::resume(&self.disk, &metrics, &checkpoint.metrics, config);
                    match resumed.map_err(RecordError::write(&metrics))? {
                        Some(metrics) => {
                            found.checkpoint = Some((checkpoint, metrics));
                            break;
                        }
                        None => format!("{}: {} is not as this left it", path.escaped(), metrics.escaped()),
                    }
                }
                Ok(Some(_)) if edited.is_some() => break,
                Ok(Some(_)) if before.is_some() => format!("{}: it is of another run", path.escaped()),
                Ok(Some(_)) => {
                    let differences = vec![format!("  {} says so, without saying what", path.escaped())];
                    return Err(RecordError::ConfigDiffers { path: self.path.clone(), differences });
                }
                Ok(None) => {
                    // Only the end of a run leaves one, before the policies that belong to it or after others.
                    self.disk.remove(&path).map_err(RecordError::write(&path))?;
                    kept.pop();
                    continue;
                }
                Err(error @ RecordError::Damaged { .. }) => error.to_string(),
                Err(error) => return Err(error),
            };
            found.notes.push(Note::SetAside(reason));
            let aside = checkpoint::aside(&path);
            self.disk.rename(&path, &aside).map_err(RecordError::write(&aside))?;
            kept.pop();
        }
        if let Some(edited) = edited.filter(|_| found.checkpoint.is_none()) {
            return Err(edited);
        }
        if began.is_none() && found.checkpoint.is_none() && from == StartFrom::Unsaid {
            let is_there = |name: &str| file::exists(&self.file(name)).map_err(RecordError::read(&self.file(name)));
            if any || is_there(INIT_MARK)? || is_there(RUN)? || is_there(METRICS)? || is_there(POLICIES)? {
                return Err(RecordError::OriginUnknown { path: self.path.clone() });
            }
        }
        if let Some(there) = began.filter(|_| found.checkpoint.is_none()) {
            self.started_alike(there.clone(), init)?;
            if let Some(there) = there.filter(|_| init.is_none()) {
                return Err(RecordError::InitNeeded { path: self.path.clone(), there });
            }
        }
        found.notes.push(match &found.checkpoint {
            Some((checkpoint, _)) => Note::GoingOn { generation: checkpoint.snapshot.generation },
            None if any => Note::StartingOver,
            None => Note::Starting,
        });
        found.kept = kept;
        Ok(())
    }

    /// Refuses files that a newer version of the program wrote, before any of them is touched.
    fn refuse_newer(&self, checkpoints: &Path) -> Result<(), RecordError> {
        let generations = checkpoint::list(checkpoints)?.into_iter();
        let files = generations.map(|generation| checkpoint::path(checkpoints, generation));
        for path in files.chain([self.file(POLICIES)]) {
            if let Some(version) = tensors::newer(&path) {
                // Only checkpoints say which version wrote them.
                let recorded = || Some(Run::read(&self.file(RUN)).ok()?.version);
                return Err(RecordError::Newer { path, version: version.or_else(recorded) });
            }
        }
        Ok(())
    }

    /// Refuses other policies to start from than the run's own.
    fn started_alike(&self, there: Option<String>, here: Option<&str>) -> Result<(), RecordError> {
        match here {
            Some(here) if there.as_deref() != Some(here) => {
                Err(RecordError::InitDiffers { path: self.path.clone(), there, here: here.into() })
            }
            _ => Ok(()),
        }
    }

    /// Refuses another config than the one the run was started with, but for more generations; gives that one, where it
    /// is there.
    fn compare(&self, config: &Config, found: &mut Resumed, checkpoints: bool) -> Result<Option<Config>, RecordError> {
        let path = self.file(CONFIG);
        match Config::load(&path) {
            Ok(before) => {
                let (there, here) = (before.learning.generations, config.learning.generations);
                let mut as_long = before.clone();
                as_long.learning.generations = here;
                if there > here && differences(&as_long, config).is_empty() {
                    return Err(RecordError::Shorter { path: self.path.clone(), there, here });
                }
                let differences = differences(if there < here { &as_long } else { &before }, config);
                if !differences.is_empty() {
                    return Err(RecordError::ConfigDiffers { path: self.path.clone(), differences });
                }
                Ok(Some(before))
            }
            Err(_) if !path.exists() && !checkpoints => Ok(None),
            Err(error) => {
                found.notes.push(Note::WrittenAnew(error.to_string()));
                Ok(None)
            }
        }
    }

    /// Writes a small text file, whole or not at all.
    fn write_text(&self, name: &str, text: &str) -> Result<(), RecordError> {
        let path = self.file(name);
        self.disk.replace(&path, |output| output.write_all(text.as_bytes())).map_err(RecordError::write(&path))
    }

    /// Writes `run.json`.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_run(&self, run: &Run) -> Result<(), RecordError> {
        self.write_text(RUN, &run.to_json())
    }

    /// Where a file of the folder is.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Reads the whole of the metrics of a finished run: where it came from and to, and its digests.
    ///
    /// The digest is SHA-256 over `metrics.csv` without `seconds` (and `stage`), then over every trial's policies as in
    /// their file (f32, little-endian). It is the same for all runs of a config, on any backend, however often resumed.
    ///
    /// # Errors
    /// The metrics cannot be read, or have not one row for every trial and generation.
    pub fn digest(&self, config: &Config, policies: &[impl AsRef<[f32]>]) -> Result<(Story, RunSums), RecordError> {
        let path = self.file(METRICS);
        let damaged = |reason: String| RecordError::damaged(&path, reason);
        let mut rows = metrics::open(&path)?;
        let (trials, last) = (config.learning.trials, config.learning.generations);
        let mut story = Story { first: vec![], last: vec![] };
        let mut count = 0;
        for row in &mut rows {
            let (row, _) = row.map_err(|error| match error {
                RowsError::Read(error) => RecordError::read(&path)(error),
                wrong => RecordError::damaged(&path, wrong),
            })?;
            if (row.generation, row.trial) != (count / trials, count % trials) {
                let (generation, trial) = (count / trials, count % trials);
                return Err(damaged(format!("line {} is not trial {trial}, generation {generation}", count + 2)));
            }
            if row.generation == 0 {
                story.first.push(row);
            }
            if row.generation == last {
                story.last.push(row);
            }
            count += 1;
        }
        if count != trials * (last + 1) {
            return Err(damaged(format!("it has {count} rows, not {}", trials * (last + 1))));
        }
        let mut hash: Sha256 = rows.digest();
        let metrics = hex(&hash.clone().finalize());
        policies.iter().for_each(|weights| hash.update(bytemuck::cast_slice::<f32, u8>(weights.as_ref())));
        Ok((story, RunSums { run: hex(&hash.finalize()), metrics }))
    }

    /// What a run that is done came to; none where its files are not all as it left them.
    fn finished(&self, run: &Run, config: &Config) -> Result<Option<Story>, RecordError> {
        let Some(digest) = run.digest.as_ref().filter(|_| run.state == Status::Done) else { return Ok(None) };
        if run.generations != config.learning.generations + 1 {
            return Ok(None);
        }
        if run.origin.as_ref().is_some_and(|origin| *origin != Origin::of(config)) {
            return Ok(None);
        }
        let path = self.file(POLICIES);
        let policies = policies::read_all(&path, config);
        let (of_config, checksum) = policies::mark(&path);
        if policies.is_ok() && of_config != Some(config_digest(config)) {
            return Ok(None);
        }
        let same = |found: &RunSums| {
            let files = run.files.as_ref();
            let same = files.is_none_or(|it| it.metrics == found.metrics && Some(&it.policies) == checksum.as_ref());
            found.run == *digest && same
        };
        match policies.and_then(|policies| self.digest(config, &policies)) {
            Ok((story, found)) => Ok(same(&found).then_some(story)),
            // What is gone or damaged is made again; what cannot be read now may be whole.
            Err(RecordError::Read { path, error }) if error.kind() != ErrorKind::NotFound => {
                Err(RecordError::Read { path, error })
            }
            Err(_) => Ok(None),
        }
    }
}

/// Whether a folder holds anything of a run.
///
/// # Errors
/// The folder cannot be looked into.
pub fn holds_run(path: &Path) -> Result<bool, RecordError> {
    for name in [CONFIG, RUN, METRICS, POLICIES, CHECKPOINTS] {
        let name = path.join(name);
        if file::exists(&name).map_err(RecordError::read(&name))? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Where the text of a config is kept whose place another took.
fn numbered_config(number: usize) -> String {
    if number == 1 { "config.old.toml".into() } else { format!("config.old-{number}.toml") }
}

/// Whether runs may be started in folders, of which none is touched: none holds a run where it is not to be written
/// over or gone on with, and where it is, nobody trains in it.
///
/// # Errors
/// The first folder that may not be used, or that cannot be looked into.
pub(crate) fn check<'a>(
    disk: &Disk,
    folders: impl IntoIterator<Item = (&'a Path, &'a Config)>,
    start: Start,
) -> Result<(), RecordError> {
    for (path, config) in folders {
        if ownership::holds_run(path, config)? && start == Start::Fresh {
            return Err(RecordError::Exists { path: path.into() });
        }
        // Where there is no lock, nobody has one.
        if start != Start::Fresh && path.join(LOCK).exists() {
            // Closing the file is not enough where a process being started has a copy of it for a moment.
            if let Some(lock) = lock(&disk.within(path).map_err(RecordError::write(path))?, path)? {
                let _ = lock.unlock();
            }
        }
    }
    Ok(())
}

impl Drop for Folder {
    fn drop(&mut self) {
        // As in `check`.
        if let Some(lock) = &self.lock {
            let _ = lock.unlock();
        }
    }
}

/// Locks a folder for this process, as long as what this gives is kept; nothing where the file system has no locks.
///
/// # Errors
/// Another process has it, or it cannot be written.
pub(crate) fn lock(disk: &Disk, path: &Path) -> Result<Option<File>, RecordError> {
    let name = path.join(LOCK);
    let file = disk.open_lock(&name).map_err(RecordError::write(&name))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Err(RecordError::Locked { path: path.into() }),
        Err(TryLockError::Error(error)) if has_no_locks(&error) => Ok(None),
        Err(TryLockError::Error(error)) => Err(RecordError::write(&name)(error)),
    }
}

/// Returns whether a lock failed because the file system has none: NFS without its lock service says `ENOLCK`.
fn has_no_locks(error: &io::Error) -> bool {
    const ENOLCK: i32 = if cfg!(target_os = "linux") { 37 } else { 77 };
    error.kind() == ErrorKind::Unsupported || cfg!(unix) && error.raw_os_error() == Some(ENOLCK)
}

/// What a folder holds many runs of, if it does: "a paper" or "a sweep".
pub fn collection(path: &Path) -> Option<&'static str> {
    let all = [(PAPER, "a paper"), (SWEEP, "a sweep")];
    all.into_iter().find(|(name, _)| path.join(name).exists()).map(|(_, what)| what)
}

/// The folder of the run, sweep or paper that a file is needed by, if it is one of theirs; pictures are not needed.
pub fn owner(path: &Path) -> Option<PathBuf> {
    let path = file::resolved(path);
    let (folder, name) = (file::folder(&path), path.file_name()?.to_str()?);
    let has = |folder: &Path, names: &[&str]| names.iter().any(|name| folder.join(name).exists());
    let is_run = |folder: &Path| has(folder, &[CONFIG]) && has(folder, &[RUN, METRICS, CHECKPOINTS]);
    let of_run = [CONFIG, RUN, METRICS, POLICIES, LOCK].contains(&name) && is_run(folder);
    let of_sweep = [SWEEP, RESULTS, POINTS].contains(&name) && has(folder, &[SWEEP]);
    let of_paper = name == PAPER && has(folder, &[ARMS]);
    let checkpoint = folder.ends_with(CHECKPOINTS) && is_run(file::folder(folder));
    match (of_run || of_sweep || of_paper, checkpoint) {
        (true, _) => Some(folder.into()),
        (_, true) => Some(file::folder(folder).into()),
        _ => None,
    }
}

/// Creates and gives the one after the last of `stem`, `stem-2`, `stem-3`, … that exists.
///
/// # Errors
/// A folder cannot be created.
pub fn next_free(parent: &Path, stem: &str) -> Result<PathBuf, RecordError> {
    fs::create_dir_all(parent).map_err(RecordError::write(parent))?;
    let mut number = newest(parent, stem) + 1;
    loop {
        let path = numbered(parent, stem, number);
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(RecordError::write(&path)(error)),
        }
    }
}

/// The last of `stem`, `stem-2`, … that exists, or else `stem`.
pub fn latest(parent: &Path, stem: &str) -> PathBuf {
    numbered(parent, stem, newest(parent, stem).max(1))
}

/// The largest number of those that exist; 0 without any.
fn newest(parent: &Path, stem: &str) -> usize {
    let number = |name: &str| match name.strip_prefix(stem)? {
        "" => Some(1),
        rest => rest.strip_prefix('-')?.parse().ok().filter(|&number| name == format!("{stem}-{number}") && number > 1),
    };
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    entries.filter_map(|entry| number(entry.file_name().to_str()?)).max().unwrap_or(0)
}

fn numbered(parent: &Path, stem: &str, number: usize) -> PathBuf {
    parent.join(if number == 1 { stem.to_string() } else { format!("{stem}-{number}") })
}

/// The keys in which two configs differ, those without a say in the results left out.
pub fn differences(old: &Config, new: &Config) -> Vec<String> {
    let table = |config: &Config| toml::Table::try_from(super::without_checkpoint(config)).unwrap_or_default();
    let (old, new) = (table(old), table(new));
    let mut differences = Vec::new();
    for (section, keys) in &new {
        for (key, value) in keys.as_table().into_iter().flatten() {
            let before = old.get(section).and_then(|keys| keys.get(key));
            if before != Some(value) {
                let before = before.map_or("nothing".to_string(), shorten);
                differences.push(format!("  {section}.{key}: {before} there, {} here", shorten(value)));
            }
        }
    }
    let stage = |table: &toml::Table, index: usize| table.get("stages")?.as_array()?.get(index).cloned();
    for index in 0..MAX_STAGES {
        match [stage(&old, index), stage(&new, index)] {
            [None, None] => break,
            [there, here] if there == here => {}
            [there, here] => {
                let told = |stage: Option<toml::Value>| stage.as_ref().map_or("nothing".into(), shorten);
                differences.push(format!("  stages[{index}]: {} there, {} here", told(there), told(here)));
            }
        }
    }
    differences
}

fn shorten(value: &toml::Value) -> String {
    let text = value.to_string();
    if text.len() > 60 { text.chars().take(60).chain(['…']).collect() } else { text }
}

/// Returns the current time, such as "2026-01-31T23:59:59Z".
pub fn now() -> String {
    timestamp(host::since_1970())
}

/// Returns a time since 1970 as text. A clock beyond the year 9999, the last of the format, counts as its last second.
fn timestamp(since_1970: Duration) -> String {
    const LAST: Duration = Duration::from_secs(253_402_300_799);
    humantime::format_rfc3339_seconds(UNIX_EPOCH + since_1970.min(LAST)).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_clock_has_a_timestamp() {
        assert_eq!(timestamp(Duration::from_secs(0)), "1970-01-01T00:00:00Z");
        for seconds in [253_402_300_799, 253_402_300_800, i64::MAX as u64, u64::MAX] {
            assert_eq!(timestamp(Duration::from_secs(seconds)), "9999-12-31T23:59:59Z");
        }
    }
}
