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

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use disk::Place;
use flotilla::config::{self, Config, ConfigError};
use flotilla::escape::{self, PathExt};
use flotilla::file::{self, TextError};

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

/// Reason why the files of a run could not be written, read or used.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A write failed. The command adds what the user can do.
    #[error("{path}: cannot be written: {error}", path = path.escaped())]
    Write {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error that the system returned.
        error: io::Error,
    },
    /// A read failed.
    #[error("{path}: cannot be read: {error}", path = path.escaped())]
    Read {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error that the system returned.
        error: io::Error,
    },
    /// A file has invalid content.
    #[error("{path}: {reason}", path = path.escaped())]
    Damaged {
        /// Path of the file or folder.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// The file has no policies of the requested trial.
    #[error("{path}: {reason}", path = path.escaped())]
    NoTrial {
        /// Path of the file or folder.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// The folder already holds a run, which would be overwritten.
    #[error("{path} holds a run already", path = path.escaped())]
    Exists {
        /// Path of the folder.
        path: PathBuf,
    },
    /// A file that flotilla did not create would be overwritten.
    #[error("{path} was not made by flotilla and would be overwritten", path = path.escaped())]
    NotOurs {
        /// Path of the file.
        path: PathBuf,
    },
    /// The folder belongs to another user, and the user did not name it as the output folder.
    #[error("{path} belongs to another user, so nothing is written there", path = path.escaped())]
    OfAnotherUser {
        /// Path of the folder.
        path: PathBuf,
    },
    /// A file has the path of the folder.
    #[error("{path} is a file", path = path.escaped())]
    NoFolder {
        /// Path of the file.
        path: PathBuf,
    },
    /// The run has more generations than requested.
    #[error("{path} is a run of {existing} generations, which cannot become one of {requested}", path = path.escaped())]
    Shorter {
        /// Path of the folder.
        path: PathBuf,
        /// Generations of the run.
        existing: usize,
        /// Requested generations.
        requested: usize,
    },
    /// Another process already trains in the folder.
    #[error("another process is training in {path}", path = path.escaped())]
    Locked {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The run started from other policies than those given, so it cannot be resumed with them.
    #[error("{path} {}, so it cannot continue as a run {}", started(existing), started_from(requested), path = path.escaped())]
    InitDiffers {
        /// Path of the folder.
        path: PathBuf,
        /// [`policies::Init::digest`] of the policies that the run started from. `None` for a random start.
        existing: Option<String>,
        /// Digest of the given policies.
        requested: String,
    },
    /// The run has no usable checkpoint, so it needs the policies that it started from.
    #[error("{path} {}, and has no checkpoint yet: it can only start again from these", started(&Some(existing.clone())), path = path.escaped())]
    InitNeeded {
        /// Path of the folder.
        path: PathBuf,
        /// [`policies::Init::digest`] of these policies.
        existing: String,
    },
    /// It is not known which policies the run started from.
    #[error("{path}: its run.json is missing or damaged, so it is not known what policies this run started from")]
    OriginUnknown {
        /// Path of the folder.
        path: PathBuf,
    },
    /// Only the program that trained the run knows its fitness.
    #[error(
        "{path}: its fitness is not the config's, but came from the program that trained it, so it cannot be extended"
    )]
    OwnFitness {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The config was changed after the run was started.
    #[error("{path}: it is not the config that this run was started with (run.json has another digest)")]
    Edited {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file has changed since the run wrote it.
    #[error("{path}: it has changed since the run wrote it (run.json has another digest)")]
    Differs {
        /// Path of the file.
        path: PathBuf,
    },
    /// A newer version of the program wrote the file.
    #[error(
        "{path}: it was written by {}, in a format that is newer than this version ({}) reads",
        by(version),
        flotilla::version::VERSION
    )]
    Newer {
        /// Path of the file.
        path: PathBuf,
        /// Version that wrote the file, if known.
        version: Option<String>,
    },
    /// The run cannot be resumed with the given config.
    #[error(
        "{path} is a run of another config, so it cannot continue with this one; what differs:\n{}",
        differences.join("\n"),
        path = path.escaped()
    )]
    ConfigDiffers {
        /// Path of the folder.
        path: PathBuf,
        /// One line for each key.
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

/// Keys of later versions with their default values. A config's digest omits these lines, so that runs of earlier
/// versions can be resumed.
const DEFAULTS_ADDED_LATER: [&str; 17] = [
    "observers = \"all\"\n",
    "windows = []\n",
    "after = []\n",
    "actions = \"direct\"\n",
    "sharing = \"none\"\n",
    "groups = []\n",
    "led_within = 0\n",
    "led_by = \"most-seen\"\n",
    "poi_jitter = 0.0\n",
    "gain = 1.0\n",
    "parents = \"all\"\n",
    "partners = 1\n",
    "leniency = \"mean\"\n",
    "hall_of_fame = 0\n",
    "method = \"tournament\"\n",
    "search_sigma = 0.3\n",
    "search_step = 1.0\n",
];

/// Returns the SHA-256 of the part of a config that affects results.
pub fn config_digest(config: &Config) -> String {
    let text = without_checkpoint(config).to_toml();
    let lines: String = text.split_inclusive('\n').filter(|line| !DEFAULTS_ADDED_LATER.contains(line)).collect();
    hex(&Sha256::digest(lines))
}

/// Returns the config with the default `[checkpoint]`, because that section may differ between sessions of a run.
pub(crate) fn without_checkpoint(config: &Config) -> Config {
    Config { checkpoint: config::CheckpointConfig::default(), ..config.clone() }
}
