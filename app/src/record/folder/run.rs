//! `run.json`: the machine of a run and its progress.

use std::time::{Duration, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use std::path::Path;

use crate::record::disk::Place;
use crate::record::ownership::{MAX_RUN_BYTES, RUN};
use crate::record::{RecordError, checkpoint, config_digest, read_text};
use flotilla::backend::Machine;
use flotilla::config::Config;
use flotilla::host;

/// Content of `run.json`: the machine of a run and its progress.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Version of the program.
    pub version: String,
    pub state: Status,
    /// Name of a run that `flotilla train` started, by default that of its config.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Random seed in the config.
    pub seed: u64,
    /// Processor of the last session.
    #[serde(flatten)]
    pub processor: ProcessorInfo,
    /// Index of the GPU in `flotilla devices`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adapter_index: Option<usize>,
    /// PCI address of the GPU, if its driver reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adapter_pci: Option<String>,
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
    /// Config that the run was started with.
    pub origin: Origin,
    /// Digests of the files. Only for a finished run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub files: Option<FileSums>,
    /// [`crate::record::policies::Init::digest`] of the policies that the run started from. `None` for a random start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<String>,
    /// Whether the run was trained with another fitness than its config's, which came from the caller.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub own_fitness: bool,
    /// Command of the last session, quoted for a shell.
    #[serde(default)]
    pub command: String,
    /// Commit that the program was built from, if known.
    #[serde(default)]
    pub commit: Option<String>,
}

/// The processor that episodes were played on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProcessorInfo {
    /// "cpu" or "gpu".
    pub backend: String,
    /// The processor in words.
    pub description: String,
    /// Name of the GPU, if one was used.
    pub adapter: Option<String>,
    /// Driver of the GPU.
    pub driver: Option<String>,
    /// Number of CPU threads that work.
    pub threads: usize,
}

impl ProcessorInfo {
    /// Describes the processor of an open backend.
    pub fn of(machine: &Machine, description: &str) -> ProcessorInfo {
        let Machine { backend, adapter, driver, threads, .. } = machine.clone();
        ProcessorInfo { backend, description: description.into(), adapter, driver, threads }
    }

    /// Returns the record of a run that this processor trained in one session, which ends now.
    pub fn record(self, config: &Config, command: &str, started: String) -> Run {
        Run {
            version: flotilla::VERSION.into(),
            processor: self,
            started,
            updated: now(),
            sessions: 1,
            command: command.into(),
            commit: flotilla::COMMIT.map(String::from),
            ..Run::new(config)
        }
    }

    /// Adds the fields to a JSON object.
    pub fn add_to(&self, object: &mut serde_json::Value) {
        let fields = serde_json::to_value(self).expect("texts and numbers are JSON");
        for (name, value) in fields.as_object().into_iter().flatten() {
            object[name] = value.clone();
        }
    }
}

/// Identity of the config that a run was started with. A resumed run keeps it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// [`config_digest`] of the config.
    pub config: String,
    /// Number of generations in the config. Only this value may grow.
    pub generations: usize,
}

impl Origin {
    pub fn of(config: &Config) -> Origin {
        Origin { config: config_digest(config), generations: config.learning.generations }
    }

    /// Reports whether a run with this origin may be resumed with a config.
    pub(super) fn allows(&self, config: &Config) -> bool {
        self.generations <= config.learning.generations
            && self.config == config_digest(&checkpoint::of_length(config, self.generations))
    }
}

/// Name of a fitness that is not the config's, in arms' names and on pages.
pub const OWN_FITNESS: &str = "own";

/// Digests of the files of a finished run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSums {
    /// Digest of `metrics.csv`. See [`RunSums::metrics`].
    #[serde(rename = "metrics.csv")]
    pub metrics: String,
    /// Checksum that is stored in the file itself. See [`crate::record::tensors`].
    #[serde(rename = "policies.safetensors")]
    pub policies: String,
}

/// Digests of the results of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunSums {
    /// SHA-256 of the metrics and then of the policies of every trial. See [`super::Folder::digest`].
    pub run: String,
    /// SHA-256 of `metrics.csv` without the columns `seconds` and `stage`.
    pub metrics: String,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// The run is training, or its process was killed.
    #[default]
    Running,
    /// The run stopped because of a signal or an error, after an attempt to save its state.
    Stopped,
    Done,
    /// The run replaces another one, some of whose files may remain. The files in the folder must not be used.
    Replacing,
}

impl Run {
    /// Creates the record of a run that has not started yet.
    pub fn new(config: &Config) -> Run {
        Run { seed: config.learning.seed, started: now(), origin: Origin::of(config), ..Run::default() }
    }

    /// Reads `run.json`.
    pub fn read<'a>(place: impl Into<Place<'a>>) -> Result<Run, RecordError> {
        let place = place.into();
        let text = read_text(place, MAX_RUN_BYTES)?;
        Run::parse(&text).map_err(|reason| match newer_version(&text) {
            Some(version) => RecordError::newer(place.path(), Some(version)),
            None => RecordError::damaged(place.path(), reason),
        })
    }

    /// Reports whether the run in a folder says that its fitness is not the config's.
    pub fn has_own_fitness(folder: &Path) -> bool {
        Run::read(&folder.join(RUN)).is_ok_and(|run| run.own_fitness)
    }

    /// Parses the text of `run.json`.
    pub fn parse(text: &str) -> Result<Run, String> {
        let run: Run = serde_json::from_str(text).map_err(|error| format!("not the record of a run: {error}"))?;
        match run.state == Status::Done && (run.digest.is_none() || run.files.is_none()) {
            true => Err("not the record of a run: it is finished and has no digests".into()),
            false => Ok(run),
        }
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
    (numbers(&version)? > numbers(flotilla::version::VERSION)?).then_some(version)
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
