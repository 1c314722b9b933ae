//! Compares what a run's folder holds with the digests in its `run.json`.
//!
//! Digests are of what a file says, not of its bytes: of the config without `[checkpoint]` and comments, of the metrics
//! without the columns `seconds` and `stage`, of the policies by the checksum that their file carries.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::folder::{FileSums, Origin, RUN, Run, Status};
use super::{RecordError, hex};
use crate::config::Config;

/// Marks what was read without a comparison.
pub const UNVERIFIED: &str = "Unverified: files were not compared with the digests in run.json";

/// Whether files of a run are compared with their digests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Verification {
    /// A file that differs is an error.
    #[default]
    Required,
    /// Nothing is compared.
    Skipped,
}

impl Verification {
    /// What a flag `--unverified` says.
    pub fn unless(unverified: bool) -> Verification {
        if unverified { Verification::Skipped } else { Verification::Required }
    }

    /// Whether nothing is compared.
    pub fn is_skipped(self) -> bool {
        self == Verification::Skipped
    }
}

/// The digests of a finished run. An unfinished run has none yet, and a run of an earlier version has none of its files.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Digests {
    /// See [`Run::digest`].
    pub run: Option<String>,
    origin: Option<Origin>,
    files: Option<FileSums>,
}

impl Digests {
    /// Reads the digests of the run in a folder; none where nothing is to be compared.
    ///
    /// # Errors
    /// `run.json` is damaged or cannot be read.
    pub fn read(folder: &Path, verification: Verification) -> Result<Digests, RecordError> {
        if verification.is_skipped() {
            return Ok(Digests::default());
        }
        match Run::read(&folder.join(RUN)) {
            Ok(Run { state: Status::Done, digest, origin, files, .. }) => Ok(Digests { run: digest, origin, files }),
            Ok(_) => Ok(Digests::default()),
            Err(RecordError::Read { error, .. }) if error.kind() == ErrorKind::NotFound => Ok(Digests::default()),
            Err(error) => Err(error),
        }
    }

    /// Compares the config that was read from a file.
    ///
    /// # Errors
    /// It is another one.
    pub fn compare_config(&self, path: &Path, config: &Config) -> Result<(), RecordError> {
        same(path, self.origin.as_ref().is_none_or(|origin| *origin == Origin::of(config)))
    }

    /// Compares the metrics that were read from a file, see [`super::metrics::Rows::digest`].
    ///
    /// # Errors
    /// They are other ones.
    pub fn compare_metrics(&self, path: &Path, found: Sha256) -> Result<(), RecordError> {
        same(path, self.files.as_ref().is_none_or(|files| files.metrics == hex(&found.finalize())))
    }

    /// Compares the checksum of policies that were read from a file.
    ///
    /// # Errors
    /// They are other ones.
    pub fn compare_policies(&self, path: &Path, checksum: Option<&str>) -> Result<(), RecordError> {
        same(path, self.files.as_ref().is_none_or(|files| Some(&*files.policies) == checksum))
    }
}

fn same(path: &Path, same: bool) -> Result<(), RecordError> {
    if same { Ok(()) } else { Err(RecordError::Differs { path: path.into() }) }
}

/// Says, once for all of them, which finished runs have no digests of their files; none where all have them.
pub fn without<'a>(folders: impl IntoIterator<Item = &'a Path>) -> Option<String> {
    let lacks =
        |folder: &&Path| Run::read(&folder.join(RUN)).is_ok_and(|run| run.state == Status::Done && run.files.is_none());
    let all: Vec<PathBuf> = folders.into_iter().filter(lacks).map(Path::to_path_buf).collect();
    let first = all.first()?.display();
    let more = if all.len() > 1 { format!(" and {} more", all.len() - 1) } else { String::new() };
    Some(format!(
        "note: {first}{more}: an earlier version made this run, without digests of its files, so these are not verified"
    ))
}
