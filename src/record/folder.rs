//! The folder of a run: its lock, its files, and where a run in it resumes.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::{Component, Path, PathBuf};
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

/// Exists while a run from given policies starts in a folder, until `run.json` records those policies.
const INIT_MARK: &str = ".init";
/// Locked by the process that trains in the folder. The system releases the lock when the process ends, even after a
/// crash.
const LOCK: &str = ".lock";
/// Maximum size in bytes of a `config.toml` that is kept before another replaces it.
const MAX_KEPT_BYTES: u64 = 1 << 20;

/// The way to treat a folder that already holds a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// Fail.
    Fresh,
    /// Replace the run.
    Force,
    /// Resume the run, or start one if there is none.
    Resume,
}

/// Content of `run.json`: the machine of a run and its progress.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Version of the program.
    pub version: String,
    /// Progress of the run.
    pub state: Status,
    /// Random seed in the config.
    pub seed: u64,
    /// Backend, "cpu" or "gpu".
    pub backend: String,
    /// Description of the backend.
    pub description: String,
    /// Name of the GPU, if one was used.
    pub adapter: Option<String>,
    /// Driver of the GPU.
    pub driver: Option<String>,
    /// Number of CPU threads that work.
    pub threads: usize,
    /// Start of the first session, in UTC.
    pub started: String,
    /// Time of the last write to this file, in UTC.
    pub updated: String,
    /// Training time of all sessions, in seconds.
    pub seconds: f64,
    /// Number of times that the run was started or resumed.
    pub sessions: u64,
    /// Number of generations played, including generation 0.
    pub generations: usize,
    /// See [`RunSums::run`]. Only for a finished run.
    pub digest: Option<String>,
    /// Config that the run was started with. Runs of earlier versions do not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<Origin>,
    /// Digests of the files of a finished run. Runs of earlier versions do not have them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub files: Option<FileSums>,
    /// [`policies::Init::digest`] of the policies that the run started from. `None` for a random start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<String>,
    /// Command of the last session, quoted for a shell.
    #[serde(default)]
    pub command: String,
    /// Commit that the program was built from, if known.
    #[serde(default)]
    pub commit: Option<String>,
}

/// Identity of the config that a run was started with. A resumed run keeps it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// [`config_digest`] of the config.
    pub config: String,
    /// Number of generations in the config. Only this value may grow.
    pub generations: usize,
}

impl Origin {
    /// Returns the origin of a run with this config.
    pub fn of(config: &Config) -> Origin {
        Origin { config: config_digest(config), generations: config.learning.generations }
    }

    /// Returns whether a run with this origin may be resumed with a config.
    fn allows(&self, config: &Config) -> bool {
        self.generations <= config.learning.generations
            && self.config == config_digest(&checkpoint::of_length(config, self.generations))
    }
}

/// Digests of the files of a finished run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSums {
    /// Digest of `metrics.csv`. See [`RunSums::metrics`].
    #[serde(rename = "metrics.csv")]
    pub metrics: String,
    /// Checksum that is stored in the file itself. See [`super::tensors`].
    #[serde(rename = "policies.safetensors")]
    pub policies: String,
}

/// Digests of the results of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunSums {
    /// SHA-256 of the metrics and then of the policies of every trial. See [`Folder::digest`].
    pub run: String,
    /// SHA-256 of `metrics.csv` without the columns `seconds` and `stage`.
    pub metrics: String,
}

/// Progress of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// The run is training, or its process was killed.
    Running,
    /// The run stopped because of a signal or an error, after an attempt to save its state.
    Stopped,
    /// The run is finished.
    Done,
    /// The run replaces another one, some of whose files may remain. The files in the folder must not be used.
    Replacing,
}

impl Run {
    /// Creates the record of a run that has not started yet.
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

    /// Reads `run.json` from a path.
    ///
    /// # Errors
    /// The file cannot be read, has invalid content, or a newer version wrote it.
    pub fn read(path: &Path) -> Result<Run, RecordError> {
        let text = read_text(path, MAX_RUN_BYTES)?;
        Run::parse(&text).map_err(|reason| match newer_version(&text) {
            Some(version) => RecordError::Newer { path: path.into(), version: Some(version) },
            None => RecordError::damaged(path, reason),
        })
    }

    /// Parses the text of `run.json`.
    ///
    /// # Errors
    /// Returns a description of the problem.
    pub fn parse(text: &str) -> Result<Run, String> {
        serde_json::from_str(text).map_err(|error| format!("it is no record of a run: {error}"))
    }

    /// Returns the text of `run.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain fields are JSON") + "\n"
    }
}

/// Returns the version in the text of `run.json` if it is newer than this program.
fn newer_version(text: &str) -> Option<String> {
    let numbers = |version: &str| -> Option<Vec<u64>> {
        version.split(['-', '+']).next()?.split('.').map(|number| number.parse().ok()).collect()
    };
    let version = serde_json::from_str::<serde_json::Value>(text).ok()?.get("version")?.as_str()?.to_string();
    (numbers(&version)? > numbers(crate::VERSION)?).then_some(version)
}

/// Policies from which a run should start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartFrom<'a> {
    /// Not specified: a resumed run keeps its own start.
    Unsaid,
    /// Random policies. The caller knows that the run cannot have started from others.
    Random,
    /// Given policies with this [`policies::Init::digest`].
    Policies(&'a str),
}

impl StartFrom<'_> {
    /// Returns the digest of the given policies.
    fn digest(self) -> Option<String> {
        if let StartFrom::Policies(digest) = self { Some(digest.into()) } else { None }
    }
}

/// A folder in which this process trains. No other process can, if the file system supports locks.
pub struct Folder {
    /// Path of the folder.
    pub path: PathBuf,
    /// Disk that writes in the folder.
    pub disk: Disk,
    lock: Option<File>,
}

/// State of a run that was found in its folder.
pub struct Resumed {
    /// Newest usable checkpoint, and the metrics truncated to match it.
    pub checkpoint: Option<(Checkpoint, metrics::Writer)>,
    /// Generations of all usable checkpoints, oldest first.
    pub kept: Vec<usize>,
    /// Content of `run.json` after the folder was opened.
    pub run: Option<Run>,
    /// Results of a finished run, if all its files match their digests. Checkpoints are not searched in that case.
    pub finished: Option<Story>,
    /// Notes for the user.
    pub notes: Vec<Note>,
}

/// Observation about a folder and the resulting action, for the user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Note {
    /// A checkpoint cannot be used, for this reason.
    SetAside(String),
    /// A small file cannot be read, for this reason.
    WrittenAnew(String),
    /// The text of `config.toml` was written by hand, and another text replaces it.
    ConfigKept {
        /// Path of the copy of the old text.
        path: PathBuf,
    },
    /// The replacement of a run was interrupted.
    Replacing,
    /// The run resumes from a checkpoint.
    GoingOn {
        /// Generation that is played next.
        generation: usize,
    },
    /// None of the checkpoints can be used.
    StartingOver,
    /// There are no checkpoints.
    Starting,
    /// The file system does not support locks.
    NotLocked,
}

impl Note {
    /// Returns whether the user must be warned. The other notes are normal for a resumed run.
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
            Note::GoingOn { generation } => write!(f, "resuming at generation {generation}"),
            Note::StartingOver => f.write_str("no checkpoint can be used: starting over, to the same results"),
            Note::NotLocked => f.write_str(
                "this file system has no locks, so another process is not kept from training here; start one at a time",
            ),
            Note::Starting => f.write_str("no checkpoint yet: starting from the beginning"),
        }
    }
}

/// Rows of a run's first and last generation, `[trials]` each.
#[derive(Clone, Debug, PartialEq)]
pub struct Story {
    /// Rows of generation 0.
    pub first: Vec<Row>,
    /// Rows of the last generation.
    pub last: Vec<Row>,
}

impl Folder {
    /// Opens a folder for a run of a config, and creates the folder if needed. The policies that the run starts from
    /// are recorded before anything else is written.
    ///
    /// # Errors
    /// Fails in these cases:
    ///
    /// - The folder holds a run that must not be overwritten, or another process trains in it.
    /// - The run belongs to another config or to a newer version.
    /// - The run started from other or unknown policies, or needs the policies that it started from.
    /// - The folder cannot be read or written.
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
            // If the process is killed before `run.json` is complete, a resumed run must not start from random
            // policies.
            disk.create(&mark).map_err(RecordError::write(&mark))?;
        }
        let lock = lock(&disk, path)?;
        // Another process may have written here before the lock was taken, so the check is repeated.
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
        // A config with the same content may have the user's comments, so it is not replaced.
        if Config::load(&folder.file(CONFIG)).ok().as_ref() != Some(config) {
            found.notes.extend(folder.write_config(config)?);
        }
        Ok((folder, found))
    }

    /// Records in `run.json` what a run starts from. A finished run that is extended is marked as running, so that its
    /// files are no longer compared with outdated digests.
    fn record_origin(&self, config: &Config, from: StartFrom<'_>, found: &mut Resumed) -> Result<(), RecordError> {
        let there = found.checkpoint.as_ref().and_then(|(checkpoint, _)| checkpoint.init.clone());
        let before = found.run.clone();
        let mut run = before.clone().unwrap_or_else(|| Run::new(config));
        run.init = from.digest().or(there).or(run.init);
        if run.state == Status::Done {
            run = Run { state: Status::Running, digest: None, files: None, ..run };
        }
        // Earlier versions did not write the origin.
        run.origin = run.origin.or_else(|| Some(Origin::of(config)));
        if before.as_ref() != Some(&run) {
            self.write_run(&run)?;
        }
        found.run = Some(run);
        Ok(())
    }

    /// Writes `config.toml`. A text that was written by hand is copied first, and the returned note names the copy.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<Option<Note>, RecordError> {
        let kept = self.keep_config()?;
        self.write_text(CONFIG, &config.to_toml())?;
        Ok(kept.map(|path| Note::ConfigKept { path }))
    }

    /// Copies `config.toml` unless flotilla wrote its text. Returns the path of the copy.
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
            // An interrupted session already made this copy.
            if read_text(&path, MAX_KEPT_BYTES).is_ok_and(|there| there == text) {
                return Ok(Some(path));
            }
        }
        unreachable!("there are more numbers than files")
    }

    /// Removes a run and keeps all other files in the folder. During the removal, `run.json` has the state `Replacing`
    /// and the data of the new run.
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
        // The config is replaced as a whole, because the new run may have been read from it.
        if Config::load(&self.file(CONFIG)).ok().as_ref() != Some(config) {
            found.notes.extend(self.write_config(config)?);
        }
        self.write_run(&Run { state: Status::Running, ..by.clone() })
    }

    /// Finds the checkpoint from which the run resumes. Unusable checkpoints are renamed or removed.
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
        // If the config file agrees with the given config but the origin does not, then the file was edited.
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
            // Checkpoints of earlier versions lack the number of generations. The config in the folder has it.
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
                    // Only the end of a run writes such a checkpoint. Its policies were not written yet, or others
                    // replaced them.
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

    /// Fails if a newer version of the program wrote any of the files. Callers check this before they change a file.
    fn refuse_newer(&self, checkpoints: &Path) -> Result<(), RecordError> {
        let generations = checkpoint::list(checkpoints)?.into_iter();
        let files = generations.map(|generation| checkpoint::path(checkpoints, generation));
        for path in files.chain([self.file(POLICIES)]) {
            if let Some(version) = tensors::newer(&path) {
                // Only checkpoints contain the version that wrote them.
                let recorded = || Some(Run::read(&self.file(RUN)).ok()?.version);
                return Err(RecordError::Newer { path, version: version.or_else(recorded) });
            }
        }
        Ok(())
    }

    /// Fails if the given policies are not those that the run started from.
    fn started_alike(&self, there: Option<String>, here: Option<&str>) -> Result<(), RecordError> {
        match here {
            Some(here) if there.as_deref() != Some(here) => {
                Err(RecordError::InitDiffers { path: self.path.clone(), there, here: here.into() })
            }
            _ => Ok(()),
        }
    }

    /// Fails if the given config differs from the one in the folder. Only more generations are allowed. Returns the
    /// config in the folder, if it can be read.
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
    /// The file cannot be written.
    pub fn write_run(&self, run: &Run) -> Result<(), RecordError> {
        self.write_text(RUN, &run.to_json())
    }

    /// Returns the path of a file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Reads all metrics of a finished run. Returns the first and the last generation, and the digests.
    ///
    /// The run digest is the SHA-256 of `metrics.csv` without `seconds` and `stage`, then of the policies of every
    /// trial as in their file (f32, little-endian). All runs of a config have the same digest, on any backend and after
    /// any number of resumes.
    ///
    /// # Errors
    /// The metrics cannot be read, or they do not have exactly one row per trial and generation.
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

    /// Returns the results of a finished run, or `None` if a file has changed since the run ended.
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
            // Missing or damaged files are written again. A file that cannot be read now may still be intact, so that
            // is an error.
            Err(RecordError::Read { path, error }) if error.kind() != ErrorKind::NotFound => {
                Err(RecordError::Read { path, error })
            }
            Err(_) => Ok(None),
        }
    }
}

/// Returns whether a folder contains any file of a run.
///
/// # Errors
/// The folder cannot be read.
pub fn holds_run(path: &Path) -> Result<bool, RecordError> {
    for name in [CONFIG, RUN, METRICS, POLICIES, CHECKPOINTS] {
        let name = path.join(name);
        if file::exists(&name).map_err(RecordError::read(&name))? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Returns the name of the copy of a replaced `config.toml`.
fn numbered_config(number: usize) -> String {
    if number == 1 { "config.old.toml".into() } else { format!("config.old-{number}.toml") }
}

/// Checks whether runs may be started in folders, without changing them. With `Start::Fresh`, no folder may hold a run.
/// Otherwise no other process may train in them.
///
/// # Errors
/// One of the folders may not be used or cannot be read.
pub(crate) fn check<'a>(
    disk: &Disk,
    folders: impl IntoIterator<Item = (&'a Path, &'a Config)>,
    start: Start,
) -> Result<(), RecordError> {
    for (path, config) in folders {
        if ownership::holds_run(path, config)? && start == Start::Fresh {
            return Err(RecordError::Exists { path: path.into() });
        }
        // Without a lock file, no process trains in the folder.
        if start != Start::Fresh && path.join(LOCK).exists() {
            // Closing the file may not release the lock, because a process that is being started can briefly hold a
            // copy of the file.
            if let Some(lock) = lock(&disk.within(path).map_err(RecordError::write(path))?, path)? {
                let _ = lock.unlock();
            }
        }
    }
    Ok(())
}

impl Drop for Folder {
    fn drop(&mut self) {
        // The lock is released explicitly for the same reason as in `check`.
        if let Some(lock) = &self.lock {
            let _ = lock.unlock();
        }
    }
}

/// Locks a folder for this process while the returned file is open. Returns `None` if the file system has no locks.
///
/// # Errors
/// Another process holds the lock, or the file cannot be written.
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

/// Returns whether the file system does not support locks. NFS without its lock service returns `ENOLCK`.
fn has_no_locks(error: &io::Error) -> bool {
    const ENOLCK: i32 = if cfg!(target_os = "linux") { 37 } else { 77 };
    error.kind() == ErrorKind::Unsupported || cfg!(unix) && error.raw_os_error() == Some(ENOLCK)
}

/// Returns "a paper" or "a sweep" if the folder contains the runs of one.
pub fn collection(path: &Path) -> Option<&'static str> {
    let all = [(PAPER, "a paper"), (SWEEP, "a sweep")];
    all.into_iter().find(|(name, _)| path.join(name).exists()).map(|(_, what)| what)
}

/// Returns the folder of the run, sweep or paper that needs a file. Pictures and pages are not needed.
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

/// Returns the outermost folder of a run, sweep or paper that a path lies in, as the path names it.
pub fn around(path: &Path) -> Option<&Path> {
    let is_ours = |folder: &Path| {
        let has = |name: &str| folder.join(name).exists();
        has(CONFIG) && [RUN, METRICS, CHECKPOINTS].into_iter().any(has)
            || has(SWEEP) && has("points")
            || has(PAPER) && has(ARMS)
    };
    let descends = |folder: &&Path| {
        let below = path.strip_prefix(folder).unwrap_or(path);
        below.components().all(|part| matches!(part, Component::Normal(_)))
    };
    let folders =
        path.ancestors().skip(1).map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder });
    folders.filter(descends).filter(|folder| is_ours(folder)).last()
}

/// Creates the next folder after the last existing one of `stem`, `stem-2`, `stem-3`, … and returns its path.
///
/// # Errors
/// The folder cannot be created.
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

/// Returns the last existing path of `stem`, `stem-2`, …, or `stem` if none exists.
pub fn latest(parent: &Path, stem: &str) -> PathBuf {
    numbered(parent, stem, newest(parent, stem).max(1))
}

/// Returns the largest number of the existing folders, or 0 if there is none.
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

/// Returns a line for each key in which two configs differ. Keys without influence on the results are ignored.
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

/// Returns the current time in UTC, such as "2026-01-31T23:59:59Z".
pub fn now() -> String {
    timestamp(host::since_1970())
}

/// Formats a time since 1970. The format ends with the year 9999, so later times count as its last second.
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
