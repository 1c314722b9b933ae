//! Recording of a run that would train as another one did.

use std::path::PathBuf;

use super::{RunError, on_threads};
use crate::record::RecordError;
use crate::record::disk::Disk;
use crate::record::folder::{self, FileSums, Folder, METRICS, Origin, POLICIES, Run, RunSums, Start, StartFrom};
use crate::record::policies;
use flotilla::config::Config;

/// A run with the same training as another run but with another config.
pub struct Twin {
    /// Folder of the other run, which is finished.
    pub of: PathBuf,
    /// Config of the other run.
    pub of_config: Config,
    pub folder: PathBuf,
    pub config: Config,
}

/// Records runs without training them. Each gets the metrics and policies of its twin, under its own config. Runs that
/// are already recorded are not changed.
pub fn record_twins(twins: Vec<Twin>, start: Start, disk: &Disk) -> Result<(), RunError> {
    on_threads(twins, |twin| twin.record(start, disk)).map(drop)
}

impl Twin {
    fn record(self, start: Start, disk: &Disk) -> Result<(), RunError> {
        let Twin { of, of_config, folder, config } = self;
        let run = Run::read(disk.at(&of.join(folder::RUN)))?;
        let (folder, found) = Folder::open(&folder, start, &config, StartFrom::Random, disk.clone())?;
        let existing = found.run.filter(|_| found.finished.is_some());
        if existing.is_some_and(|existing| existing.digest == run.digest) {
            return Ok(());
        }
        let (from, path) = (of.join(METRICS), folder.file(METRICS));
        let copy = folder.disk.replace(&path, |output| std::io::copy(&mut disk.at(&from).open()?, output).map(drop));
        copy.map_err(|error| RecordError::Write { path, error })?;
        let policies = of.join(POLICIES);
        let policies = policies::read_all(disk.at(&policies), &of_config)?;
        let checksum = policies::write(&folder.disk, &folder.file(POLICIES), &config, &policies)?;
        let (_, RunSums { run: digest, metrics }) = folder.digest(&config, &policies)?;
        let files = Some(FileSums { metrics, policies: checksum });
        Ok(folder.write_run(&Run { digest: Some(digest), origin: Origin::of(&config), files, ..run })?)
    }
}
