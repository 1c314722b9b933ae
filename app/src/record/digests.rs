//! Comparison of a run's files with the digests in its `run.json`.
//!
//! A digest covers the content that matters for results, not every byte of a file:
//!
//! - the config without `[checkpoint]` and comments,
//! - the metrics without the columns `seconds` and `stage`,
//! - the policies, through the checksum in their file.

use std::io::ErrorKind;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::disk::Place;
use super::folder::{FileSums, METRICS, Origin, POLICIES, RUN, Run, Status};
use super::{RecordError, hex};
use flotilla::config::Config;

/// Warning for output made from files that were not compared.
pub const UNVERIFIED: &str = "Unverified: files were not compared with the digests in run.json";

/// Whether the files of a run are compared with their digests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Verification {
    /// A file with another digest is an error.
    #[default]
    Required,
    /// No file is compared.
    Skipped,
}

impl Verification {
    /// Returns the value for a flag `--unverified`.
    pub fn unless(unverified: bool) -> Verification {
        if unverified { Verification::Skipped } else { Verification::Required }
    }

    /// Reports whether no file is compared.
    pub(crate) fn is_skipped(self) -> bool {
        self == Verification::Skipped
    }
}

/// Digests of a finished run. Unfinished runs have no digests.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Digests {
    /// See [`Run::digest`].
    pub run: Option<String>,
    origin: Option<Origin>,
    files: Option<FileSums>,
}

impl Digests {
    /// Reads the digests of the run in a folder. They are empty if nothing is to be compared.
    pub fn read<'a>(folder: impl Into<Place<'a>>, verification: Verification) -> Result<Digests, RecordError> {
        let folder = folder.into();
        if verification.is_skipped() {
            return Ok(Digests::default());
        }
        match Run::read(folder.at(&folder.path().join(RUN))) {
            Ok(Run { state: Status::Done, digest, origin, files, .. }) => {
                Ok(Digests { run: digest, origin: Some(origin), files })
            }
            Ok(_) => Ok(Digests::default()),
            Err(RecordError::Read { path, error }) if error.kind() == ErrorKind::NotFound => {
                // A folder that lacks either was never a finished run: somebody may have put a config and metrics there.
                for name in [METRICS, POLICIES] {
                    let file = folder.path().join(name);
                    if !folder.at(&file).exists().map_err(RecordError::read(&file))? {
                        return Ok(Digests::default());
                    }
                }
                Err(RecordError::Unrecorded(path))
            }
            Err(error) => Err(error),
        }
    }

    /// Compares a config that was read from a file.
    pub(crate) fn compare_config(&self, path: &Path, config: &Config) -> Result<(), RecordError> {
        same(path, self.origin.as_ref().is_none_or(|origin| *origin == Origin::of(config)))
    }

    /// Compares metrics that were read from a file. See [`super::metrics::Rows::digest`].
    pub(crate) fn compare_metrics(&self, path: &Path, found: Sha256) -> Result<(), RecordError> {
        same(path, self.files.as_ref().is_none_or(|files| files.metrics == hex(&found.finalize())))
    }

    /// Compares the checksum of policies that were read from a file.
    pub(crate) fn compare_policies(&self, path: &Path, checksum: Option<&str>) -> Result<(), RecordError> {
        same(path, self.files.as_ref().is_none_or(|files| Some(&*files.policies) == checksum))
    }
}

fn same(path: &Path, same: bool) -> Result<(), RecordError> {
    if same { Ok(()) } else { Err(RecordError::Differs(path.into())) }
}
