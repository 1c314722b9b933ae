//! Writing of a finished run that was trained in memory, with the same files as a run that was trained in a folder.

use std::io::{self, Write};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::checkpoint::{self, Checkpoint};
use super::folder::{CHECKPOINTS, CONFIG, FileSums, Folder, METRICS, POLICIES, RUN, Run, Status};
use super::metrics::{self, Extent, Lines};
use super::{RecordError, config_digest, hex, ownership, policies};
use flotilla::config::Config;
use flotilla::trainer::{Ending, Row, Snapshot};

/// The place that the files of a run are written to: a folder or an archive.
pub trait Storage {
    /// Writes a file, whole or not at all. `name` is its path in the run's folder, with `/` as separator.
    fn put(&mut self, name: &str, content: Content<'_>) -> Result<(), RecordError>;

    /// Writes a picture of the run, and lists it as made by flotilla. It is the last file of the run.
    fn publish(&mut self, name: &str, content: &[u8]) -> Result<(), RecordError> {
        self.put(name, &mut |output| output.write_all(content))?;
        let line = ownership::line(&hex(&Sha256::digest(content)), Path::new(name));
        self.put(ownership::LIST, &mut |output| output.write_all(line.as_bytes()))
    }
}

/// Writes the content of a file.
pub type Content<'a> = &'a mut dyn FnMut(&mut dyn Write) -> io::Result<()>;

impl Storage for Folder {
    fn put(&mut self, name: &str, content: Content<'_>) -> Result<(), RecordError> {
        let path = self.file(name);
        self.disk.replace(&path, |output| content(output)).map_err(RecordError::write(&path))
    }

    fn publish(&mut self, name: &str, content: &[u8]) -> Result<(), RecordError> {
        ownership::publish_bytes(&self.disk, &self.file(name), content)?;
        let checkpoints = self.file(CHECKPOINTS);
        self.disk.sync_folder(&checkpoints).map_err(RecordError::write(&checkpoints))?;
        self.sync()
    }
}

/// A finished run in memory.
pub struct Finished<'a> {
    pub config: &'a Config,
    /// All rows by generation and trial, each with the seconds of training until it was complete.
    pub rows: &'a [(Row, f64)],
    /// The policies of each trial, best first.
    pub policies: &'a [&'a [f32]],
    /// The state after the last generation. Without it, an extended run trains again from generation 0.
    pub ending: Option<Ending>,
    /// The machine and the origin of the run.
    pub run: Run,
}

impl Finished<'_> {
    /// Writes all files, `run.json` last. Returns the run's digest.
    pub fn write(self, storage: &mut dyn Storage) -> Result<String, RecordError> {
        let Finished { config, rows, policies, ending, run } = self;
        let last = config.learning.generations;
        let (lines, mut extent) = (Lines::of(config), None);
        let mut text = lines.header();
        for (row, seconds) in rows {
            if row.generation == last && extent.is_none() {
                extent = Some(Extent::after(&text));
            }
            text += &lines.line(row, *seconds);
        }
        let seconds = rows.last().map_or(0.0, |&(_, seconds)| seconds);
        let plain = || rows.iter().map(|&(row, _)| row);
        let digest = hex(&metrics::digest(plain(), policies));
        let metrics = hex(&metrics::digest(plain(), &[] as &[&[f32]]));
        let mut checksum = String::new();
        storage.put(CONFIG, &mut |output| output.write_all(config.to_toml().as_bytes()))?;
        storage.put(METRICS, &mut |output| output.write_all(text.as_bytes()))?;
        storage.put(POLICIES, &mut |output| policies::put(output, config, policies).map(|sum| checksum = sum))?;
        if let Some(Ending { weights, fitness }) = ending {
            let pending = rows.iter().filter(|(row, _)| row.generation == last).map(|&(row, _)| Some(row)).collect();
            let snapshot = Snapshot { generation: last + 1, last, weights, fitness, pending };
            let metrics = extent.unwrap_or_else(|| Extent::after(&text));
            let (config_digest, init) = (config_digest(config), run.init.clone());
            let checkpoint = Checkpoint { config: config_digest, init, seconds, metrics, snapshot };
            let path = checkpoint::path(Path::new(CHECKPOINTS), last + 1).to_string_lossy().replace('\\', "/");
            storage.put(&path, &mut |output| checkpoint.put(output, config))?;
        }
        let run = Run {
            state: Status::Done,
            seconds,
            generations: last + 1,
            digest: Some(digest.clone()),
            files: Some(FileSums { metrics, policies: checksum }),
            ..run
        };
        storage.put(RUN, &mut |output| output.write_all(run.to_json().as_bytes()))?;
        Ok(digest)
    }
}

/// Reads the state of a finished run after its last generation. Returns `None` if its last checkpoint is missing or
/// cannot be used.
pub(crate) fn read_ending(folder: &Path, config: &Config) -> Option<Ending> {
    let path = checkpoint::path(&folder.join(CHECKPOINTS), config.learning.generations + 1);
    let found = Checkpoint::read(flotilla::file::open(&path).ok()?, config).ok()?;
    let is_of = found.is_of(config);
    let Snapshot { generation, last, weights, fitness, .. } = found.snapshot;
    let whole = weights.is_empty() == config.learning.extends_from_policies();
    let fits = is_of && whole && last + 1 == generation && last == config.learning.generations;
    fits.then_some(Ending { weights, fitness })
}
