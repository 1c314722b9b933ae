//! Event files for TensorBoard: `best_g`, `mean_g` and `champion_g` by generation, with one TensorBoard run per trial.
//!
//! A file is a sequence of TFRecords: length, its checksum, content, its checksum. Each content is a protocol buffer
//! `Event`. This module encodes by hand only the few fields that scalars need. Values are f64, as in `metrics.csv`.

use std::fs;
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crc::{CRC_32_ISCSI, Crc};

use crate::record::disk::Disk;
use crate::record::metrics;
use crate::record::rooted_folder::FileKind;
use flotilla::host::{self, Instant};
use flotilla::trainer::Row;

/// Number of buffered bytes of a trial above which they are flushed.
const MAX_BUFFERED_BYTES: usize = 1 << 16;
/// Interval between flushes.
const FLUSH: Duration = Duration::from_secs(2);
/// The part of a file name by which TensorBoard recognises event files.
const MARK: &str = "tfevents";
/// The suffix of files that this module writes.
const OURS: &str = ".flotilla";
/// The checksum of TFRecords.
static CHECKSUM: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// The event files of one run.
pub(crate) struct Events {
    disk: Disk,
    /// One file per trial.
    files: Vec<PathBuf>,
    /// Buffered bytes that are not in the files yet, `[trials]`.
    new: Vec<Vec<u8>>,
    flushed: Instant,
}

impl Events {
    /// Creates event files in `folder/trial-N`, one folder per trial, with all rows of `metrics` so far.
    ///
    /// The new files replace those of earlier sessions. `disk` is limited to the run's folder.
    ///
    /// # Errors
    /// The files cannot be written.
    pub fn create(disk: &Disk, folder: &Path, trials: usize, metrics: &Path) -> io::Result<Events> {
        let digits = trials.saturating_sub(1).to_string().len();
        let mut files = Vec::with_capacity(trials);
        Events::clear(disk, folder)?;
        for trial in 0..trials {
            let folder = folder.join(format!("trial-{trial:0digits$}"));
            disk.create_folder(&folder)?;
            files.push(new_file(disk, &folder, now() as u64)?);
        }
        let first = record(&event(now(), 0, &Content::Version));
        let mut events = Events { disk: disk.clone(), files, new: vec![first; trials], flushed: Instant::now() };
        let rows = || metrics::open(metrics).map_err(io::Error::other).map(|rows| rows.map_while(Result::ok));
        // Rows get the times at which they became complete, as if all sessions had been a single one.
        let start = now() - rows()?.last().map_or(0.0, |(_, seconds)| seconds);
        for (row, seconds) in rows()? {
            events.add_at(&row, start + seconds);
            if events.new.get(row.trial).is_some_and(|new| new.len() > MAX_BUFFERED_BYTES) {
                events.flush()?;
            }
        }
        events.flush()?;
        Ok(events)
    }

    /// Removes a run's event files and nothing else. It recognises them by name and by content.
    ///
    /// # Errors
    /// A file cannot be removed.
    pub(crate) fn clear(disk: &Disk, folder: &Path) -> io::Result<()> {
        for trial in names(folder)?.into_iter().filter(|trial| named(trial, "trial-", "")) {
            // Links are skipped, so that nothing outside the run is removed.
            if !fs::symlink_metadata(&trial)?.is_dir() {
                continue;
            }
            for path in names(&trial)?.into_iter().filter(|path| named(path, &format!("events.out.{MARK}."), OURS)) {
                if disk.kind(&path)? == Some(FileKind::File) && begins(disk, &path)? {
                    disk.remove(&path)?;
                }
            }
        }
        Ok(())
    }

    fn add_at(&mut self, row: &Row, time: f64) {
        if let Some(new) = self.new.get_mut(row.trial) {
            new.extend(record(&event(time, row.generation as u64, &Content::Row(row))));
        }
    }

    /// Adds complete rows. They are written at intervals.
    ///
    /// # Errors
    /// The files cannot be written.
    pub fn add(&mut self, rows: &[Row]) -> io::Result<()> {
        rows.iter().for_each(|row| self.add_at(row, now()));
        if self.flushed.elapsed() >= FLUSH { self.flush() } else { Ok(()) }
    }

    /// Writes all buffered rows.
    ///
    /// # Errors
    /// The files cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        for (file, new) in self.files.iter().zip(&mut self.new).filter(|(_, new)| !new.is_empty()) {
            // Files are opened for each flush, because there may be more trials than a process may have open files.
            self.disk.extend(file, new)?;
            new.clear();
        }
        self.flushed = Instant::now();
        Ok(())
    }
}

/// Creates a trial's event file, named after the current time in seconds. If the name is taken, tries the following
/// seconds.
fn new_file(disk: &Disk, folder: &Path, mut seconds: u64) -> io::Result<PathBuf> {
    loop {
        let path = folder.join(format!("events.out.{MARK}.{seconds:010}{OURS}"));
        match disk.create_new(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => seconds += 1,
            created => return created.map(|_| path),
        }
    }
}

/// Returns the paths in a folder; none if it does not exist.
fn names(folder: &Path) -> io::Result<Vec<PathBuf>> {
    match fs::read_dir(folder) {
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(vec![]),
        entries => entries?.map(|entry| Ok(entry?.path())).collect(),
    }
}

/// Reports whether a path's name consists of a prefix, a number and a suffix.
fn named(path: &Path, before: &str, after: &str) -> bool {
    let name = path.file_name().and_then(|name| name.to_str());
    let number = name.and_then(|name| name.strip_prefix(before)?.strip_suffix(after));
    number.is_some_and(|number| !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Reports whether a file is empty or begins with the first event that this module writes.
fn begins(disk: &Disk, path: &Path) -> io::Result<bool> {
    let first = record(&event(0.0, 0, &Content::Version));
    let mut start = Vec::new();
    disk.read(path)?.take(first.len() as u64).read_to_end(&mut start)?;
    // Compare all bytes except the time and the last checksum.
    let same = |range: std::ops::Range<usize>| start.get(range.clone()).is_none_or(|bytes| *bytes == first[range]);
    Ok(start.is_empty() || start.len() == first.len() && same(0..13) && same(21..first.len() - 4))
}

/// Returns the seconds since 1970.
fn now() -> f64 {
    host::since_1970().as_secs_f64()
}

enum Content<'a> {
    /// The first event of a file.
    Version,
    Row(&'a Row),
}

/// Encodes an `Event`.
fn event(wall_time: f64, step: u64, content: &Content<'_>) -> Vec<u8> {
    let mut event = Message::default();
    event.double(1, wall_time);
    event.varint(2, step);
    match content {
        Content::Version => event.bytes(3, b"brain.Event:2"),
        Content::Row(row) => {
            let mut summary = Message::default();
            for (tag, value) in [("best_g", row.best_g), ("mean_g", row.mean_g), ("champion_g", row.champion_g)] {
                summary.bytes(1, &scalar(tag, value));
            }
            event.bytes(5, &summary.0);
        }
    }
    event.0
}

/// Encodes a `Summary.Value` for the scalars plugin: a tensor without dimensions.
fn scalar(tag: &str, value: f64) -> Vec<u8> {
    const DOUBLE: u64 = 2;
    const SCALAR: u64 = 1;
    let (mut plugin, mut metadata, mut tensor, mut scalar) =
        (Message::default(), Message::default(), Message::default(), Message::default());
    plugin.bytes(1, b"scalars");
    metadata.bytes(1, &plugin.0);
    metadata.varint(4, SCALAR);
    tensor.varint(1, DOUBLE);
    tensor.bytes(2, &[]);
    tensor.bytes(6, &value.to_le_bytes());
    scalar.bytes(1, tag.as_bytes());
    scalar.bytes(8, &tensor.0);
    scalar.bytes(9, &metadata.0);
    scalar.0
}

/// An encoder of protocol buffers.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn number(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn varint(&mut self, field: u64, value: u64) {
        self.number(field << 3);
        self.number(value);
    }

    fn double(&mut self, field: u64, value: f64) {
        self.number(field << 3 | 1);
        self.0.extend(value.to_le_bytes());
    }

    fn bytes(&mut self, field: u64, bytes: &[u8]) {
        self.number(field << 3 | 2);
        self.number(bytes.len() as u64);
        self.0.extend(bytes);
    }
}

/// Encodes a TFRecord.
fn record(content: &[u8]) -> Vec<u8> {
    let length = (content.len() as u64).to_le_bytes();
    let parts: [&[u8]; 4] = [&length, &masked_checksum(&length), content, &masked_checksum(content)];
    parts.concat()
}

/// Returns a CRC-32C that is rotated and shifted, as TFRecord requires, so that checksums of checksums stay strong.
fn masked_checksum(bytes: &[u8]) -> [u8; 4] {
    CHECKSUM.checksum(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}
