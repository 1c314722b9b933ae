//! The folder of a run: its lock and its files.
//!
//! | module | contents |
//! |---|---|
//! | [`run`] | `run.json` |
//! | [`resume`] | where a run resumes, and whether it is finished |
//! | [`paths`] | recognition and numbering of folders |

use std::fmt;
use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use super::checkpoint::{self, Checkpoint};
use super::disk::Disk;
pub(crate) use super::ownership::CHECKPOINTS;
use super::ownership::{self, CURVES, REPLAY};
pub use super::ownership::{ARMS, PAPER, POINTS, RESULTS};
pub use super::ownership::{CONFIG, METRICS, POLICIES, RUN, SWEEP};
use super::{RecordError, load_config, metrics, read_text};
use flotilla::config::{Config, ConfigError};

mod paths;
mod resume;
mod run;

pub use paths::{around, collection, owner};
pub use paths::{holds_run, latest, next_free, other_name};
pub use resume::{FirstAndLastRows, differences};
pub(crate) use run::RunSums;
pub use run::{FileSums, OWN_FITNESS, Origin, ProcessorInfo, Run, Status, now};

/// The folder for runs whose folder is not named.
pub const RUNS: &str = "runs";
/// Exists while a run from given policies starts in a folder, until `run.json` records those policies.
const INIT_MARK: &str = ".init";
/// Locked by the process that trains in the folder. The system releases the lock when the process ends, even after a
/// crash.
const LOCK: &str = ".lock";
/// Maximum size in bytes of a `config.toml` that is kept before another replaces it.
const MAX_KEPT_BYTES: u64 = 1 << 20;

/// The way to treat a folder that already holds a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// Fails if the folder holds a run.
    Fresh,
    /// Replaces the run.
    Force,
    /// Resumes the run, or starts one if there is none.
    Resume,
}

/// Policies from which a run should start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartFrom<'a> {
    /// Not specified: a resumed run keeps its own start.
    Unspecified,
    /// Random policies. The caller knows that the run cannot have started from others.
    Random,
    /// Given policies with this [`super::policies::Init::digest`].
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
    pub path: PathBuf,
    pub disk: Disk,
    lock: Option<File>,
}

/// State of a run that was found in its folder.
#[derive(Default)]
pub struct Resumed {
    /// Newest usable checkpoint, and the metrics truncated to match it.
    pub checkpoint: Option<(Checkpoint, metrics::Writer)>,
    /// Generations of all usable checkpoints, oldest first.
    pub kept: Vec<usize>,
    /// Content of `run.json` after the folder was opened.
    pub run: Option<Run>,
    /// Results of a finished run, if all its files match their digests. Checkpoints are not searched in that case.
    pub finished: Option<FirstAndLastRows>,
    pub notes: Vec<Note>,
}

/// Observation about a folder and the resulting action, for the user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    text: String,
    /// Whether the user must be warned. The other notes are normal for a resumed run.
    pub is_damage: bool,
}

impl Note {
    fn normal(text: impl Into<String>) -> Note {
        Note { text: text.into(), is_damage: false }
    }

    fn damage(text: impl Into<String>) -> Note {
        Note { text: text.into(), is_damage: true }
    }

    /// Returns the note for a file system that does not support locks.
    pub(crate) fn not_locked() -> Note {
        Note::damage("this file system has no locks, so start only one process at a time in this folder")
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
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
            return Err(RecordError::no_folder(path));
        }
        let disk = ownership::create_output_folder(&disk, path, true)?;
        ownership::refuse_links(&disk, path)?;
        let holds_run = || match ownership::holds_run(disk.at(path), config)? {
            true if start == Start::Fresh => Err(RecordError::Exists(path.into())),
            holds => Ok(holds),
        };
        holds_run()?;
        let mark = path.join(INIT_MARK);
        if from.digest().is_some() && !disk.at(&path.join(RUN)).exists().map_err(RecordError::read(path))? {
            // If the process is killed before `run.json` is complete, a resumed run must not start from random
            // policies.
            disk.create(&mark).map_err(RecordError::write(&mark))?;
        }
        let lock = match lock(&disk, path) {
            Err(RecordError::Write { path: name, error }) if start == Start::Resume && is_read_only(&error) => {
                let (folder, mut found) = (Folder { path: path.into(), disk, lock: None }, Resumed::default());
                folder.find_finished(config, from, &mut found)?;
                let failed = RecordError::Write { path: name, error };
                return found.finished.is_some().then_some((folder, found)).ok_or(failed);
            }
            lock => lock?,
        };
        // Another process may have written here before the lock was taken, so the check is repeated.
        let holds_run = holds_run()?;
        let folder = Folder { path: path.into(), disk, lock };
        let mut found = Resumed::default();
        found.notes.extend(folder.lock.is_none().then(Note::not_locked));
        let interrupted = folder.read_run().ok().filter(|run| run.state == Status::Replacing);
        match (start, interrupted) {
            (Start::Force, _) if holds_run => {
                folder.clear(&Run { init: from.digest(), ..Run::new(config) }, config, &mut found)?;
            }
            (Start::Resume, Some(run)) => {
                if let Some(error) = folder.origin_error(config, Some(&run), false) {
                    return Err(error);
                }
                found
                    .notes
                    .push(Note::normal("the replacement of a run was interrupted: the rest of that run is removed"));
                folder.clear(&run, config, &mut found)?;
            }
            _ => {}
        }
        if start == Start::Resume {
            folder.find(config, from, &mut found)?;
        }
        if found.finished.is_some() {
            if folder.config().is_err() {
                found.notes.extend(folder.write_config(config)?);
            }
            return Ok((folder, found));
        }
        folder.record_origin(config, from, &mut found)?;
        folder.disk.remove(&mark).map_err(RecordError::write(&mark))?;
        let checkpoints = folder.file(CHECKPOINTS);
        folder.disk.create_folder(&checkpoints).map_err(RecordError::write(&checkpoints))?;
        // A config with the same content may have the user's comments, so it is not replaced.
        if folder.config().ok().as_ref() != Some(config) {
            found.notes.extend(folder.write_config(config)?);
        }
        Ok((folder, found))
    }

    /// Records in `run.json` what a run starts from. A finished run that is extended is marked as running, so that its
    /// files are no longer compared with outdated digests.
    fn record_origin(&self, config: &Config, from: StartFrom<'_>, found: &mut Resumed) -> Result<(), RecordError> {
        let init = found.checkpoint.as_ref().and_then(|(checkpoint, _)| checkpoint.init.clone());
        let before = found.run.clone();
        let mut run = before.clone().unwrap_or_else(|| Run::new(config));
        run.init = from.digest().or(init).or(run.init);
        if run.state == Status::Done {
            run = Run { state: Status::Running, digest: None, files: None, ..run };
        }
        if before.as_ref() != Some(&run) {
            self.write_run(&run)?;
        }
        found.run = Some(run);
        Ok(())
    }

    /// Writes `config.toml`. A text that was written by hand is copied first, and the returned note names the copy.
    pub(crate) fn write_config(&self, config: &Config) -> Result<Option<Note>, RecordError> {
        let kept = self.keep_config()?;
        self.write_text(CONFIG, &config.to_toml())?;
        let note =
            |path: PathBuf| Note::normal(format!("{CONFIG} has changed; its old text is kept as {}", path.display()));
        Ok(kept.map(note))
    }

    /// Copies `config.toml` unless flotilla wrote its text. Returns the path of the copy.
    fn keep_config(&self) -> Result<Option<PathBuf>, RecordError> {
        let Ok(text) = read_text(self.disk.at(&self.file(CONFIG)), MAX_KEPT_BYTES) else { return Ok(None) };
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
            if read_text(self.disk.at(&path), MAX_KEPT_BYTES).is_ok_and(|existing| existing == text) {
                return Ok(Some(path));
            }
        }
        unreachable!("there are more numbers than files")
    }

    /// Removes a run and keeps all other files in the folder. During the removal, `run.json` has the state `Replacing`
    /// and the data of the new run.
    fn clear(&self, by: &Run, config: &Config, found: &mut Resumed) -> Result<(), RecordError> {
        // If these cannot be removed, the run stays whole.
        for name in [REPLAY, CURVES] {
            ownership::remove_published(&self.disk, &self.file(name))?;
        }
        self.write_run(&Run { state: Status::Replacing, ..by.clone() })?;
        self.sync()?;
        let checkpoints = self.file(CHECKPOINTS);
        let generations = checkpoint::remove_temporary_files(&self.disk, &checkpoints)?;
        let old = generations.into_iter().map(|generation| checkpoint::path(&checkpoints, generation));
        for path in old.chain([METRICS, POLICIES].map(|name| self.file(name))) {
            self.disk.remove(&path).map_err(RecordError::write(&path))?;
        }
        // The config is replaced as a whole, because the new run may have been read from it.
        if self.config().ok().as_ref() != Some(config) {
            found.notes.extend(self.write_config(config)?);
        }
        self.write_run(&Run { state: Status::Running, ..by.clone() })
    }

    /// Writes a small text file, whole or not at all.
    fn write_text(&self, name: &str, text: &str) -> Result<(), RecordError> {
        let path = self.file(name);
        self.disk.replace(&path, |output| output.write_all(text.as_bytes())).map_err(RecordError::write(&path))
    }

    /// Writes `run.json`.
    pub fn write_run(&self, run: &Run) -> Result<(), RecordError> {
        self.write_text(RUN, &run.to_json())
    }

    /// Flushes the names in the folder to the disk, so that they survive a power loss.
    pub(crate) fn sync(&self) -> Result<(), RecordError> {
        self.disk.sync_folder(&self.path).map_err(RecordError::write(&self.path))
    }

    /// Reads `run.json`.
    fn read_run(&self) -> Result<Run, RecordError> {
        Run::read(self.disk.at(&self.file(RUN)))
    }

    /// Reads `config.toml`.
    fn config(&self) -> Result<Config, ConfigError> {
        load_config(self.disk.at(&self.file(CONFIG)))
    }

    /// Reports whether a file exists in the folder.
    pub(crate) fn has(&self, name: &str) -> Result<bool, RecordError> {
        let path = self.file(name);
        self.disk.at(&path).exists().map_err(RecordError::read(&path))
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }
}

/// Returns the name of the copy of a replaced `config.toml`.
fn numbered_config(number: usize) -> String {
    if number == 1 { "config.old.toml".into() } else { format!("config.old-{number}.toml") }
}

/// Checks whether runs may be started in folders, without changing them. With `Start::Fresh`, no folder may hold a run.
/// Otherwise no other process may train in them.
pub fn check<'a>(
    disk: &Disk,
    folders: impl IntoIterator<Item = (&'a Path, &'a Config)>,
    start: Start,
) -> Result<(), RecordError> {
    for (path, config) in folders {
        let disk = match disk.within(path) {
            // No run is in a folder that does not exist. Opening the run reports a file that has the folder's path.
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => continue,
            disk => disk.map_err(RecordError::write(path))?,
        };
        if ownership::holds_run(disk.at(path), config)? && start == Start::Fresh {
            return Err(RecordError::Exists(path.into()));
        }
        // Without a lock file, no process trains in the folder.
        let name = path.join(LOCK);
        if start != Start::Fresh && disk.at(&name).exists().map_err(RecordError::read(&name))? {
            // Closing the file may not release the lock, because a process that is being started can briefly hold a
            // copy of the file.
            match lock(&disk, path) {
                // A finished run needs no lock. Opening the run reports any other.
                Err(RecordError::Write { error, .. }) if start == Start::Resume && is_read_only(&error) => {}
                lock => drop(lock?.map(|lock| lock.unlock())),
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

/// Reports whether a write failed because nothing may be written.
fn is_read_only(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied)
}

/// Locks a folder for this process while the returned file is open. Returns `None` if the file system has no locks.
///
/// # Errors
/// Another process holds the lock, or the file cannot be written.
pub fn lock(disk: &Disk, path: &Path) -> Result<Option<File>, RecordError> {
    let name = path.join(LOCK);
    disk.lock(&name).map_err(|error| match error.kind() {
        ErrorKind::WouldBlock => RecordError::Locked(path.into()),
        _ => RecordError::write(&name)(error),
    })
}
