//! What a run leaves on disk, and how it is found again after anything.
//!
//! | module | holds |
//! |---|---|
//! | [`beneath`] | a folder and what is below it, reached without following links |
//! | [`disk`] | files replaced whole or not at all; the one place that writes, so that tests can make any write fail |
//! | [`tensors`] | safetensors files under a checksum |
//! | [`policies`] | `policies.safetensors` |
//! | [`metrics`] | `metrics.csv` |
//! | [`ownership`] | what may be written, replaced, renamed and deleted |
//! | [`checkpoint`] | `checkpoints/`, written beside training |
//! | [`folder`] | the run's folder, its lock and `run.json` |
//! | [`digests`] | whether files are as `run.json` says |
//! | [`evidence`] | what was seen on a machine, for `docs/develop/evidence.md` |
//!
//! Every file that is read is taken as hostile: its size is checked before memory is taken, what it says is checked
//! before it is used, and nothing in it names another file.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::config::{self, Config};
use crate::escape::{self, PathExt};
use crate::file::{self, TextError};

pub mod beneath;
pub mod checkpoint;
pub mod digests;
pub mod disk;
pub mod evidence;
pub mod folder;
pub mod metrics;
pub mod ownership;
pub mod policies;
pub mod tensors;

/// Why a run's files could not be written, read or used.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// What to do about it depends on the command.
    #[error("{path}: cannot be written: {error}", path = path.escaped())]
    Write {
        /// The file or the folder.
        path: PathBuf,
        /// The system's words.
        error: io::Error,
    },
    /// The system does not let it be read.
    #[error("{path}: cannot be read: {error}", path = path.escaped())]
    Read {
        /// The file or the folder.
        path: PathBuf,
        /// The system's words.
        error: io::Error,
    },
    /// The file is not what it should be; `reason` says in what.
    #[error("{path}: {reason}", path = path.escaped())]
    Damaged {
        /// The file or the folder.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Policies of a trial that the file does not have.
    #[error("{path}: {reason}", path = path.escaped())]
    NoTrial {
        /// The file or the folder.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A run that would be written over.
    #[error("{path} holds a run already", path = path.escaped())]
    Exists {
        /// The file or the folder.
        path: PathBuf,
    },
    /// A file that flotilla did not make.
    #[error("{path} was not made by flotilla and would be overwritten", path = path.escaped())]
    NotOurs {
        /// The file.
        path: PathBuf,
    },
    /// A folder of another user, to which the user did not ask to write.
    #[error("{path} belongs to another user, so nothing is written there", path = path.escaped())]
    OfAnotherUser {
        /// The folder.
        path: PathBuf,
    },
    /// A file where the folder should be.
    #[error("{path} is a file", path = path.escaped())]
    NoFolder {
        /// The file or the folder.
        path: PathBuf,
    },
    /// A run that has more generations than are asked for.
    #[error("{path} is a run of {there} generations, which cannot become one of {here}", path = path.escaped())]
    Shorter {
        /// The file or the folder.
        path: PathBuf,
        /// Generations that it has.
        there: usize,
        /// Generations asked for.
        here: usize,
    },
    /// Two processes would write the same files.
    #[error("another process is training in {path}", path = path.escaped())]
    Locked {
        /// The file or the folder.
        path: PathBuf,
    },
    /// A run that started from given policies, or that did not, cannot go on as if it had started from others.
    #[error("{path} {}, so it cannot go on as a run {}", started(there), started_from(here), path = path.escaped())]
    InitDiffers {
        /// The file or the folder.
        path: PathBuf,
        /// [`policies::Init::digest`] of what it started from, if not at random.
        there: Option<String>,
        /// The digest of what was given.
        here: String,
    },
    /// A run that starts over needs the policies that it started from.
    #[error("{path} {}, and has no checkpoint yet: it starts over from these alone", started(&Some(there.clone())), path = path.escaped())]
    InitNeeded {
        /// The file or the folder.
        path: PathBuf,
        /// [`policies::Init::digest`] of these.
        there: String,
    },
    /// A run that was started from nobody knows what.
    #[error("{path}: its run.json is missing or damaged, so it is not known what policies this run started from")]
    OriginUnknown {
        /// The folder.
        path: PathBuf,
    },
    /// A config that was changed after its run was started.
    #[error("{path}: it is not the config that this run was started with (run.json has another digest)")]
    Edited {
        /// The file.
        path: PathBuf,
    },
    /// A file that is not as the run left it.
    #[error("{path}: it is not as the run left it (run.json has another digest)")]
    Differs {
        /// The file.
        path: PathBuf,
    },
    /// A file of a newer version of the program.
    #[error(
        "{path}: it was written by {}, in a format that is newer than this version ({}) reads",
        by(version),
        crate::VERSION
    )]
    Newer {
        /// The file.
        path: PathBuf,
        /// The version that wrote it, if that is known.
        version: Option<String>,
    },
    /// A run that cannot go on under the config given.
    #[error(
        "{path} is a run of another config, so it cannot go on with this one; what differs:\n{}",
        differences.join("\n"),
        path = path.escaped()
    )]
    ConfigDiffers {
        /// The file or the folder.
        path: PathBuf,
        /// A line for each key.
        differences: Vec<String>,
    },
}

fn by(version: &Option<String>) -> String {
    version.as_ref().map_or("a newer flotilla".into(), |version| format!("flotilla {}", escape::line(version)))
}

fn started(digest: &Option<String>) -> String {
    match digest {
        Some(digest) => format!("started from a file of policies with SHA-256 {}", brief(digest)),
        None => "did not start from a file of policies".into(),
    }
}

fn started_from(digest: &str) -> String {
    format!("from the file with SHA-256 {}", brief(digest))
}

/// The start of a digest, enough to tell files apart.
fn brief(digest: &str) -> String {
    digest.chars().take(16).chain(['…']).collect()
}

impl RecordError {
    fn write(path: &Path) -> impl FnOnce(io::Error) -> RecordError {
        move |error| RecordError::Write { path: path.into(), error }
    }

    fn read(path: &Path) -> impl FnOnce(io::Error) -> RecordError {
        move |error| RecordError::Read { path: path.into(), error }
    }

    fn damaged(path: &Path, reason: impl Display) -> RecordError {
        RecordError::Damaged { path: path.into(), reason: reason.to_string() }
    }
}

/// A small text file, refused where it is larger than `most` bytes.
fn read_text(path: &Path, most: u64) -> Result<String, RecordError> {
    let file = file::open(path).map_err(RecordError::read(path))?;
    file::text(file, most).map_err(|error| match error {
        TextError::Read(error) => RecordError::read(path)(error),
        wrong => RecordError::damaged(path, wrong),
    })
}

/// Keys that came later, at their defaults: they are left out of a config's digest, so that a run of an earlier version
/// can go on.
const LATER: [&str; 10] = [
    "observers = \"all\"\n",
    "windows = []\n",
    "after = []\n",
    "actions = \"direct\"\n",
    "sharing = \"none\"\n",
    "led_within = 0\n",
    "led_by = \"most-seen\"\n",
    "poi_jitter = 0.0\n",
    "gain = 1.0\n",
    "parents = \"all\"\n",
];

/// SHA-256 of all of a config that has a say in the results.
pub fn config_digest(config: &Config) -> String {
    let text = without_checkpoint(config).to_toml();
    let lines: String = text.split_inclusive('\n').filter(|line| !LATER.contains(line)).collect();
    hex(&Sha256::digest(lines))
}

/// The config with `[checkpoint]`, which may differ between sessions of one run, at its defaults.
pub fn without_checkpoint(config: &Config) -> Config {
    Config { checkpoint: config::Saving::default(), ..config.clone() }
}

/// Lowercase hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
