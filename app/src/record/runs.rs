//! Reads the configs and metrics of finished and unfinished runs.

use std::ffi::OsString;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::digests::{Digests, Verification};
use super::disk::Place;
use super::folder::{self, CONFIG, METRICS, POLICIES, RUNS};
use super::metrics;
use super::{RecordError, command_to_resume};
use super::{finished, policies};
use crate::shell;
use flotilla::config::{Config, ConfigError};
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla::front::Trained;
use flotilla::trainer::Row;

/// The reason why a run cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The path does not exist.
    #[error("{}: no such folder", .0.escaped())]
    Missing(PathBuf),
    /// The path is a file instead of a folder.
    #[error("{} is a file; name the folder of a run", .0.escaped())]
    NoFolder(PathBuf),
    /// The folder is not a run.
    #[error("{folder}: not a run directory (it has no {name})", folder = folder.escaped())]
    Foreign {
        folder: PathBuf,
        /// The missing file that every run has.
        name: &'static str,
    },
    /// The run's config is invalid.
    #[error("{folder}: {error}", folder = folder.escaped())]
    Config { folder: PathBuf, error: ConfigError },
    /// The folder contains several runs.
    #[error("{folder} holds {what}; name one of the runs in it, as {folder}/{example}", folder = folder.escaped())]
    Collection {
        folder: PathBuf,
        /// The kind of its contents, such as "a sweep".
        what: &'static str,
        /// The path of a run in it.
        example: &'static str,
    },
    /// The run lacks the requested data.
    #[error("{folder}: {reason}", folder = folder.escaped())]
    Unfinished { folder: PathBuf, reason: String },
    /// The run tested no teams.
    #[error("{}: {reason}", folder.escaped())]
    Untested { folder: PathBuf, reason: String },
    /// The run's files cannot be read.
    #[error(transparent)]
    Record(#[from] RecordError),
}

impl ReadError {
    /// Returns what the user can do about it.
    pub fn help(&self) -> Option<String> {
        Some(match self {
            ReadError::Missing(folder) if Path::new(RUNS).join(folder).is_dir() => {
                format!("did you mean {}?", Path::new(RUNS).join(folder).escaped())
            }
            ReadError::Missing(folder) => {
                let words = ["flotilla", "train", "CONFIG", "--out"].map(OsString::from);
                format!("`{}` makes a run there", shell::command(words.into_iter().chain([shell::argument(folder)])))
            }
            ReadError::NoFolder(path) if file::is_zip(path) => {
                format!("unpack it with `{}`", shell::command(["unzip".into(), shell::argument(path)]))
            }
            ReadError::NoFolder(_) | ReadError::Foreign { .. } => "`flotilla train CONFIG --out DIR` makes one".into(),
            ReadError::Config { .. } => {
                "find a config that is whole, and repeat the run with `flotilla train CONFIG --out DIR`".into()
            }
            ReadError::Untested { .. } => "train another run with --set learning.test_episodes=10".into(),
            ReadError::Unfinished { folder, .. } => format!("finish the run with `{}`", command_to_resume(folder, &[])),
            ReadError::Record(error) => return error.help("try again"),
            ReadError::Collection { .. } => return None,
        })
    }
}

/// Reads a run's config.
pub fn config(folder: &Path, verification: Verification) -> Result<Config, ReadError> {
    let kind = std::fs::metadata(folder).map_err(|error| match error.kind() {
        ErrorKind::NotFound => ReadError::Missing(folder.into()),
        _ => ReadError::Record(RecordError::Read { path: folder.into(), error }),
    })?;
    if !kind.is_dir() {
        return Err(ReadError::NoFolder(folder.into()));
    }
    let path = folder.join(CONFIG);
    if !exists(&path)? {
        if let Some(what) = folder::collection(folder) {
            let example = if what == "a sweep" { "points/0000" } else { "arms/chaotic-leader-follower-Df" };
            return Err(ReadError::Collection { folder: folder.into(), what, example });
        }
        return Err(ReadError::Foreign { folder: folder.into(), name: CONFIG });
    }
    let config = Config::load(&path).map_err(|error| ReadError::Config { folder: folder.into(), error })?;
    Digests::read(folder, verification)?.compare_config(&path, &config)?;
    Ok(config)
}

/// Reports whether a file exists.
pub(crate) fn exists(path: &Path) -> Result<bool, RecordError> {
    file::exists(path).map_err(RecordError::read(path))
}

/// Calls `each` with every complete row of a run's metrics. A partial last line is ignored, because it is still being
/// written.
///
/// # Errors
/// The metrics are missing, belong to another run, or were changed after the run. The last error may appear only after
/// all rows.
pub fn metrics<'a>(
    place: impl Into<Place<'a>>,
    config: &Config,
    verification: Verification,
    each: impl FnMut(&Row),
) -> Result<(), ReadError> {
    let place = place.into();
    let (folder, path) = (place.path(), place.path().join(METRICS));
    // The digests are read before the metrics, because the run may finish in between.
    let digests = Digests::read(place, verification)?;
    let unfinished = |reason: String| ReadError::Unfinished { folder: folder.into(), reason };
    if !place.at(&path).exists().map_err(RecordError::read(&path))? {
        return Err(unfinished(format!("it has no {METRICS} yet")));
    }
    let found = metrics::visit(place.at(&path), config, each)?;
    digests.compare_metrics(&path, found.digest)?;
    if found.rows == 0 { Err(unfinished(format!("its {METRICS} has no rows yet"))) } else { Ok(()) }
}

/// Reads the results of a finished run from its folder.
pub fn trained(folder: &Path, verification: Verification) -> Result<Trained, ReadError> {
    let config = config(folder, verification)?;
    let mut rows = Vec::new();
    metrics(folder, &config, verification, |row| rows.push(*row))?;
    let (found, expected) = (rows.len(), config.learning.trials * (config.learning.generations + 1));
    if found != expected {
        let reason = format!("its {} has {found} rows of {expected}", METRICS);
        return Err(ReadError::Unfinished { folder: folder.into(), reason });
    }
    let path = folder.join(POLICIES);
    let policies = policies::read_all(&path, &config)?;
    let digests = Digests::read(folder, verification)?;
    let ending = finished::read_ending(folder, &config);
    let trained = Trained::new(config, &rows, policies, ending);
    // The config and the metrics match their digests, so the policies must differ.
    match digests.run {
        Some(digest) if digest != trained.digest() => Err(RecordError::Differs(path).into()),
        _ => Ok(trained),
    }
}
