//! Files of a run, and how a run is restored from them.
//!
//! | module | contents |
//! |---|---|
//! | [`rooted_folder`] | access to a folder and the entries below it without following links |
//! | [`disk`] | atomic replacement of files; all writes use it, so that tests can make any write fail |
//! | [`tensors`] | safetensors files with a checksum |
//! | [`policies`] | `policies.safetensors` |
//! | [`metrics`] | `metrics.csv` |
//! | [`ownership`] | which files may be written, replaced, renamed and deleted |
//! | [`checkpoint`] | `checkpoints/`, written during training |
//! | [`folder`] | the folder of a run, its lock and `run.json` |
//! | [`digests`] | comparison of files with the digests in `run.json` |
//! | [`runs`] | configs and metrics of runs |
//! | [`finished`] | a finished run that was trained in memory |
//!
//! Every file that is read is untrusted. Its size is checked before memory is allocated, and its values are checked
//! before they are used. Nothing in it can name another file.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Display;
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::shell;
use disk::Place;
use flotilla::config::{self, Config, ConfigError, STAGES};
use flotilla::escape::{self, PathExt};
use flotilla::file::{self, TextError};
use ownership::{CONFIG, METRICS, POLICIES, RUN};

pub use flotilla::trainer::digest::hex;

pub mod checkpoint;
pub mod digests;
pub mod disk;
pub mod finished;
pub mod folder;
pub mod metrics;
pub mod ownership;
pub mod policies;
pub(crate) mod rooted_folder;
pub mod runs;
pub mod tensors;

/// `EMFILE`: the process has too many open files. The number is the same on every Unix, and the standard library has no
/// name for it.
const TOO_MANY_FILES: i32 = 24;
/// `EIO`: a device failed to read or write. The number is the same on every Unix.
const INPUT_OUTPUT: i32 = 5;

/// Reason why the files of a run could not be written, read or used.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error("{path}: cannot be written: {error}", path = path.escaped())]
    Write { path: PathBuf, error: io::Error },
    #[error("{path}: cannot be read: {error}", path = path.escaped())]
    Read { path: PathBuf, error: io::Error },
    /// A file has invalid content.
    #[error("{path}: {reason}", path = path.escaped())]
    Damaged { path: PathBuf, reason: String },
    /// The file has no policies of the requested trial.
    #[error("{path}: {reason}", path = path.escaped())]
    NoTrial { path: PathBuf, reason: String },
    /// The folder already holds a run, which would be overwritten.
    #[error("{} holds a run already", .0.escaped())]
    Exists(PathBuf),
    /// A file that flotilla did not create would be overwritten.
    #[error("{} was not made by flotilla, or has been changed since, and would be overwritten", .0.escaped())]
    NotOurs(PathBuf),
    /// The folder belongs to another user, and the user did not name it as the output folder.
    #[error("{} belongs to another user, so nothing is written there", .0.escaped())]
    OfAnotherUser(PathBuf),
    /// Another process already trains in the folder.
    #[error("another process is training in {}", .0.escaped())]
    Locked(PathBuf),
    /// The config was changed after the run was started.
    #[error("{}: it is not the config that this run was started with (run.json has another digest)", .0.escaped())]
    Edited(PathBuf),
    /// The file has changed since the run wrote it.
    #[error("{}: it has changed since the run wrote it (run.json has another digest)", .0.escaped())]
    Differs(PathBuf),
    /// A finished run has no `run.json`.
    #[error("{}: it is missing, so the run's files cannot be compared with their digests", .0.escaped())]
    Unrecorded(PathBuf),
    /// The files are intact, but do not fit the request.
    #[error("{message}")]
    Refused { message: String, remedy: String },
}

fn started_from(digest: &str) -> String {
    format!("started from a file of policies with SHA-256 {}", brief(digest))
}

/// Returns the start of a digest, which is enough to distinguish files.
fn brief(digest: &str) -> String {
    digest.chars().take(16).chain(['…']).collect()
}

impl RecordError {
    /// Returns a function that makes the error of a failed write of a path.
    pub fn write(path: &Path) -> impl FnOnce(io::Error) -> RecordError {
        move |error| RecordError::Write { path: path.into(), error }
    }

    /// Returns a function that makes the error of a failed read of a path.
    pub fn read(path: &Path) -> impl FnOnce(io::Error) -> RecordError {
        move |error| RecordError::Read { path: path.into(), error }
    }

    fn damaged(path: &Path, reason: impl Display) -> RecordError {
        RecordError::Damaged { path: path.into(), reason: reason.to_string() }
    }

    fn refused(message: String, remedy: impl Into<String>) -> RecordError {
        RecordError::Refused { message, remedy: remedy.into() }
    }

    /// Returns the error for a folder whose path is that of a file.
    pub fn no_folder(path: &Path) -> RecordError {
        RecordError::refused(format!("{} is a file", path.escaped()), "choose a folder with --out")
    }

    /// Returns the error for a run with more generations than requested.
    fn shorter(path: &Path, existing: usize, requested: usize) -> RecordError {
        let path = path.escaped();
        RecordError::refused(
            format!("{path} is a run of {existing} generations, which cannot become one of {requested}"),
            format!("resume with --generations {existing} or more, or choose another --out"),
        )
    }

    /// Returns the error for a run that started from policies with the digest `existing`, or from random ones, and
    /// should continue from others.
    fn init_differs(path: &Path, existing: Option<&str>, requested: &str) -> RecordError {
        let (path, requested) = (path.escaped(), brief(requested));
        let (started, file) = match existing {
            Some(existing) => (started_from(existing), " or with that file"),
            None => ("did not start from a file of policies".into(), ""),
        };
        RecordError::refused(
            format!("{path} {started}, so it cannot continue as a run from the file with SHA-256 {requested}"),
            format!("resume without --init{file}, or choose another --out"),
        )
    }

    /// Returns the error for a run that needs the policies that it started from, because it has no usable checkpoint.
    pub(crate) fn init_needed(path: &Path, existing: &str) -> RecordError {
        let (path, started) = (path.escaped(), started_from(existing));
        RecordError::refused(
            format!("{path} {started}, and has no checkpoint yet: it can only start again from these"),
            "pass that file with --init",
        )
    }

    /// Returns the error for a file that a newer version of the program wrote. `version` is that version, if known.
    fn newer(path: &Path, version: Option<String>) -> RecordError {
        let (path, this) = (path.escaped(), flotilla::version::VERSION);
        let by = version.map_or("a newer flotilla".into(), |version| format!("flotilla {}", escape::line(&version)));
        RecordError::refused(
            format!("{path}: it was written by {by}, in a format that is newer than this version ({this}) reads"),
            "use that version, or choose another --out",
        )
    }

    /// Returns the error for a run that cannot be resumed with the given config. `differences` has a line for each key.
    fn config_differs(path: &Path, differences: &[String]) -> RecordError {
        let (command, path, differences) = (command_to_resume(path, &[]), path.escaped(), differences.join("\n"));
        RecordError::refused(
            format!(
                "{path} is a run of another config, so it cannot continue with this one; what differs:\n{differences}"
            ),
            format!("resume it as it was started with `{command}`, or choose another --out"),
        )
    }

    /// Returns what the user can do about it. `next` follows the remedy of a full disk, such as "run it again".
    pub fn help(&self, next: &str) -> Option<String> {
        let again = |path: &Path| format!("make it again with `{}`", command_to_resume(file::folder(path), &[]));
        Some(match self {
            RecordError::Write { error, .. } | RecordError::Read { error, .. }
                if cfg!(unix) && error.raw_os_error() == Some(TOO_MANY_FILES) =>
            {
                format!("the system allows no more open files here (see `ulimit -n`): raise that, then {next}")
            }
            RecordError::Write { error, .. } => match error.kind() {
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded => format!("free some space, then {next}"),
                ErrorKind::FileTooLarge => {
                    format!("the system allows no larger file here (see `ulimit -f`): raise that, then {next}")
                }
                ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "choose a place you may write to".into(),
                _ if cfg!(unix) && error.raw_os_error() == Some(INPUT_OUTPUT) => {
                    format!("check the disk, then {next}")
                }
                _ => return None,
            },
            RecordError::Read { error, .. } => match error.kind() {
                ErrorKind::NotFound | ErrorKind::NotADirectory => "check the path".into(),
                ErrorKind::PermissionDenied => "ask its owner for permission to read it".into(),
                _ => return None,
            },
            RecordError::Exists { .. } => {
                "pass --resume to continue it or --force to overwrite it, or choose another --out".into()
            }
            RecordError::NotOurs { .. } => "move it away, or choose another --out".into(),
            RecordError::OfAnotherUser { .. } => "to write there all the same, name it with --out".into(),
            RecordError::Locked { .. } => "wait for it, stop it, or choose another --out".into(),
            RecordError::Edited(path) => format!(
                "restore what it was, or move {} away and name the run's own config, or choose another --out",
                path.display()
            ),
            RecordError::Differs(path) if path.ends_with(CONFIG) => {
                "restore it, or read it all the same with --unverified".into()
            }
            RecordError::Differs(path) | RecordError::Unrecorded(path) => {
                format!("restore it, {}, or read it all the same with --unverified", again(path))
            }
            RecordError::Damaged { path, .. }
                if [RUN, METRICS, POLICIES].iter().any(|name| path.ends_with(name))
                    && file::folder(path).join(CONFIG).exists() =>
            {
                format!("restore it, or {}", again(path))
            }
            RecordError::Refused { remedy, .. } => remedy.clone(),
            RecordError::Damaged { .. } | RecordError::NoTrial { .. } => return None,
        })
    }
}

/// Returns the command that resumes the run in a folder with its own config.
pub(crate) fn command_to_resume(folder: &Path, flags: &[OsString]) -> String {
    let [config, out] = [&folder.join(CONFIG), folder].map(shell::argument);
    let words = ["flotilla".into(), "train".into(), config, "--out".into(), out, "--resume".into()];
    shell::command(words.iter().chain(flags))
}

/// Passes bytes on, and hashes them.
struct Hashing<'a> {
    output: &'a mut dyn Write,
    hash: &'a mut Sha256,
}

impl Write for Hashing<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.output.write(bytes)?;
        self.hash.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.output.flush()
    }
}

/// Hashes everything that is left in a file.
fn hash_rest(file: &mut impl Read, hash: &mut Sha256) -> io::Result<()> {
    io::copy(file, &mut Hashing { output: &mut io::sink(), hash }).map(drop)
}

/// Reads a text file of at most `most` bytes.
fn read_text<'a>(place: impl Into<Place<'a>>, most: u64) -> Result<String, RecordError> {
    let place = place.into();
    let path = place.path();
    let file = place.open().map_err(RecordError::read(path))?;
    file::text(file, most).map_err(|error| match error {
        TextError::Read(error) => RecordError::read(path)(error),
        wrong => RecordError::damaged(path, wrong),
    })
}

/// Reads the config of a run.
pub(crate) fn load_config(place: Place<'_>) -> Result<Config, ConfigError> {
    let name = config::name(place.path());
    Config::parse(&config::read_text(place.open(), &name)?, &name)
}

/// Returns the SHA-256 of the part of a config that affects results.
pub fn config_digest(config: &Config) -> String {
    hex(&Sha256::digest(without_checkpoint(config).to_toml()))
}

/// Returns the config with the default `[checkpoint]`, because that section may differ between sessions of a run.
pub(crate) fn without_checkpoint(config: &Config) -> Config {
    Config { checkpoint: config::CheckpointConfig::default(), ..config.clone() }
}

/// Returns the values of a config by their dotted keys. Each stage is one value.
pub(crate) fn values_by_key(config: &Config) -> BTreeMap<String, toml::Value> {
    let mut values = BTreeMap::new();
    for (section, content) in toml::Table::try_from(config).unwrap_or_default() {
        match content {
            toml::Value::Table(keys) => {
                values.extend(keys.into_iter().map(|(key, value)| (format!("{section}.{key}"), value)));
            }
            toml::Value::Array(stages) if section == STAGES => {
                let stages = stages.into_iter().enumerate();
                values.extend(stages.map(|(index, stage)| (format!("{section}[{index}]"), stage)));
            }
            toml::Value::Array(tables) => {
                let name = |table: &toml::Value| table.get("name").cloned();
                values.insert(section.clone(), toml::Value::Array(tables.iter().filter_map(name).collect()));
                tables.into_iter().for_each(|table| {
                    let key = table.get("name").and_then(toml::Value::as_str).map(|name| format!("{section}.{name}"));
                    add_keys(&mut values, key.unwrap_or(section.clone()), table);
                });
            }
            value => drop(values.insert(section, value)),
        }
    }
    values
}

/// Adds the keys below a key of a class or group, as `--set` names them.
fn add_keys(values: &mut BTreeMap<String, toml::Value>, key: String, value: toml::Value) {
    match value {
        toml::Value::Table(keys) => {
            keys.into_iter().for_each(|(below, value)| add_keys(values, format!("{key}.{below}"), value));
        }
        toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {
            let items = items.into_iter().enumerate();
            items.for_each(|(index, item)| add_keys(values, format!("{key}[{index}]"), item));
        }
        value => drop(values.insert(key, value)),
    }
}
