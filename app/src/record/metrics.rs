//! `metrics.csv`: the scores of every trial in every generation.
//!
//! The file has one line per trial and generation, sorted by generation and then by trial. G is in 0..1. `seconds` is
//! the training time until the line was complete, including earlier sessions of a resumed run.
//!
//! If the config has test episodes, a column `test_g` precedes `seconds`. If it has stages, a last column `stage` gives
//! the stage of the generation, from 0. G then refers to the POIs of that stage. All columns except `seconds` have the
//! same bits on every backend.

use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::disk::{Disk, Output, Place};
use super::{RecordError, hash_rest, hex};
use flotilla::config::{Config, MAX_GENERATIONS, MAX_TRIALS};
use flotilla::trainer::Row;
pub use flotilla::trainer::digest::digest;
use flotilla::trainer::digest::{columns, line as shared};

/// Header of the file, without test episodes and stages.
pub const HEADER: &str = "trial,generation,best_g,mean_g,champion_g,seconds";
/// Maximum number of bytes per line.
const MAX_LINE: u64 = 256;

/// Length and hash of a file at some moment. A resumed run uses them to find that place again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256 of these bytes.
    pub sha256: String,
}

impl Extent {
    /// Returns the extent of a whole text.
    pub fn after(text: &str) -> Extent {
        Extent { bytes: text.len() as u64, sha256: hex(&Sha256::digest(text)) }
    }
}

/// The optional columns of a file.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Optional {
    /// Whether there is a column `test_g`.
    tested: bool,
    /// Whether there is a column `stage`.
    staged: bool,
}

impl Optional {
    fn of(config: &Config) -> Optional {
        Optional { tested: config.learning.test_episodes > 0, staged: !config.stages.is_empty() }
    }

    fn header(self) -> String {
        let Optional { tested, staged } = self;
        format!("{},seconds{}", columns(tested), if staged { ",stage" } else { "" })
    }

    /// Returns the columns of a file with this header.
    fn of_header(header: &str) -> Option<Optional> {
        let all = [false, true].map(|tested| [false, true].map(|staged| Optional { tested, staged }));
        all.into_iter().flatten().find(|optional| optional.header() == header)
    }
}

/// Formatter for the lines of a config's file. Each line includes its line break.
pub struct Lines {
    /// First generation of each stage after stage 0.
    stages: Vec<usize>,
    optional: Optional,
}

impl Lines {
    /// Creates the formatter for runs of this config.
    pub fn of(config: &Config) -> Lines {
        let stages = config.stages.iter().map(|stage| stage.from).filter(|&from| from > 0).collect();
        Lines { stages, optional: Optional::of(config) }
    }

    pub fn header(&self) -> String {
        self.optional.header() + "\n"
    }

    /// Returns the line of a row. `seconds` is the training time until the row was complete.
    pub fn line(&self, row: &Row, seconds: f64) -> String {
        let stage = self.stages.partition_point(|&from| from <= row.generation);
        let stage = if self.optional.staged { format!(",{stage}") } else { String::new() };
        format!("{},{seconds:.3}{stage}\n", shared(row))
    }
}

/// A metrics file that is being written.
pub struct Writer {
    output: BufWriter<Output>,
    bytes: u64,
    hash: Sha256,
    lines: Lines,
}

impl Writer {
    /// Creates a file with its header and replaces any other file.
    pub fn create(disk: &Disk, path: &Path, config: &Config) -> io::Result<Writer> {
        let output = BufWriter::new(disk.create(path)?);
        let mut writer = Writer { output, bytes: 0, hash: Sha256::new(), lines: Lines::of(config) };
        writer.write(&writer.lines.header())?;
        writer.output.flush()?;
        Ok(writer)
    }

    /// Continues a file at a mark and drops everything after it. Returns `None` if the file is missing or its content
    /// up to the mark has changed.
    pub fn resume(disk: &Disk, path: &Path, mark: &Extent, config: &Config) -> io::Result<Option<Writer>> {
        let Some(hash) = before(disk.at(path), mark)? else { return Ok(None) };
        let output = BufWriter::new(disk.append(path, mark.bytes)?);
        Ok(Some(Writer { output, bytes: mark.bytes, hash, lines: Lines::of(config) }))
    }

    fn write(&mut self, line: &str) -> io::Result<()> {
        self.bytes += line.len() as u64;
        self.hash.update(line);
        self.output.write_all(line.as_bytes())
    }

    /// Adds rows that became complete after `seconds` of training.
    pub fn add(&mut self, rows: &[Row], seconds: f64) -> io::Result<()> {
        rows.iter().try_for_each(|row| self.write(&self.lines.line(row, seconds)))
    }

    /// Passes all lines to the system, so that other processes can read them.
    pub fn flush(&mut self) -> io::Result<()> {
        self.output.flush()
    }

    /// Returns the current extent, and the file, so that the caller can flush this part to the disk.
    pub fn mark(&mut self) -> io::Result<(Extent, Output)> {
        self.output.flush()?;
        let sha256 = hex(&self.hash.clone().finalize());
        Ok((Extent { bytes: self.bytes, sha256 }, self.output.get_ref().share()?))
    }
}

/// Returns the hash of a file's content up to a mark, or `None` if the file is missing or has other content.
fn before(place: Place<'_>, mark: &Extent) -> io::Result<Option<Sha256>> {
    let mut file = match place.open() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => BufReader::new(file?).take(mark.bytes),
    };
    let mut hash = Sha256::new();
    hash_rest(&mut file, &mut hash)?;
    let same = file.limit() == 0 && hex(&hash.clone().finalize()) == mark.sha256;
    Ok(same.then_some(hash))
}

/// Reports whether a file has had the given extent.
pub(crate) fn has_extent<'a>(place: impl Into<Place<'a>>, mark: &Extent) -> bool {
    before(place.into(), mark).is_ok_and(|found| found.is_some())
}

/// Reports whether a file starts like a metrics file. The header may be incomplete.
pub(crate) fn begins(place: Place<'_>) -> io::Result<bool> {
    let mut start = Vec::new();
    place.open()?.take("trial,generation,".len() as u64).read_to_end(&mut start)?;
    Ok(HEADER.as_bytes().starts_with(&start))
}

/// Reason why the rows of a file are rejected.
#[derive(Debug, thiserror::Error)]
pub enum RowsError {
    /// An incomplete or overlong line, such as the last line of a file that is still being written.
    #[error("line {0} is cut short or longer than {MAX_LINE} bytes")]
    CutShort(usize),
    /// A line that is not a row, or a row in the wrong place.
    #[error("line {line} is not {what}")]
    Wrong {
        /// Line number, from 1.
        line: usize,
        /// The columns that the line should contain.
        what: String,
    },
    /// The system returned an error.
    #[error("cannot be read: {0}")]
    Read(#[from] io::Error),
}

/// Iterator over the rows of a file, each with its seconds. It stops at the first error.
pub struct Rows<R> {
    source: R,
    line: usize,
    done: bool,
    optional: Optional,
    /// SHA-256 of all lines without their seconds and stages.
    hash: Sha256,
}

impl<R: BufRead> Rows<R> {
    /// Reads the header of a metrics file.
    pub fn new(source: R) -> Result<Rows<R>, RowsError> {
        let optional = Optional { tested: false, staged: false };
        let mut rows = Rows { source, line: 0, done: false, optional, hash: Sha256::new() };
        let optional = match rows.line() {
            Ok(header) => header.and_then(|header| Optional::of_header(&header)),
            Err(error @ RowsError::Read(_)) => return Err(error),
            Err(_) => None,
        };
        let what = format!("{HEADER}, with columns test_g and stage if the config asks for them");
        let optional = optional.ok_or(RowsError::Wrong { line: 1, what })?;
        // The digest must not depend on the column `stage`, so the header without it is hashed.
        let hash = Sha256::new_with_prefix(columns(optional.tested)).chain_update("\n");
        Ok(Rows { optional, hash, ..rows })
    }

    fn line(&mut self) -> Result<Option<String>, RowsError> {
        self.line += 1;
        let mut line = Vec::new();
        if (&mut self.source).take(MAX_LINE).read_until(b'\n', &mut line)? == 0 {
            return Ok(None);
        }
        if line.pop() != Some(b'\n') {
            return Err(RowsError::CutShort(self.line));
        }
        let line = String::from_utf8(line).map_err(|_| self.wrong("UTF-8 text"))?;
        self.hash.update(without_last(if self.optional.staged { without_last(&line) } else { &line }));
        self.hash.update("\n");
        Ok(Some(line))
    }

    fn wrong(&self, what: impl Into<String>) -> RowsError {
        RowsError::Wrong { line: self.line, what: what.into() }
    }

    fn row(&mut self) -> Result<Option<(Row, f64)>, RowsError> {
        let Some(line) = self.line()? else { return Ok(None) };
        let parse = || {
            let mut fields = line.split(',');
            let mut field = || fields.next();
            let row = Row {
                experiment: 0,
                trial: field()?.parse().ok().filter(|&trial| trial < MAX_TRIALS)?,
                generation: field()?.parse().ok().filter(|&generation| generation <= MAX_GENERATIONS)?,
                best_g: share(field()?)?,
                mean_g: share(field()?)?,
                champion_g: share(field()?)?,
                test_g: if self.optional.tested { Some(share(field()?)?) } else { None },
            };
            let seconds = field()?.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0)?;
            let whole = !self.optional.staged || field()?.parse::<usize>().is_ok();
            (whole && fields.next().is_none()).then_some((row, seconds))
        };
        parse().map(Some).ok_or_else(|| self.wrong(format!("{} with every G in 0..1", self.optional.header())))
    }

    /// Returns the SHA-256 of all lines that were read, without seconds and stages.
    pub fn digest(self) -> Sha256 {
        self.hash
    }
}

/// Returns a line without its last field.
fn without_last(line: &str) -> &str {
    line.rsplit_once(',').map_or("", |(before, _)| before)
}

fn share(text: &str) -> Option<f64> {
    text.parse().ok().filter(|share| (0.0..=1.0).contains(share))
}

impl<R: BufRead> Iterator for Rows<R> {
    type Item = Result<(Row, f64), RowsError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let row = self.row().transpose();
        self.done = !matches!(row, Some(Ok(_)));
        row
    }
}

pub fn open<'a>(place: impl Into<Place<'a>>) -> Result<Rows<BufReader<File>>, RecordError> {
    let place = place.into();
    let file = place.open().map_err(RecordError::read(place.path()))?;
    Rows::new(BufReader::new(file)).map_err(|reason| RecordError::damaged(place.path(), reason))
}

/// The result of reading a file of metrics.
pub(crate) struct Extracted {
    pub rows: usize,
    /// Whether an incomplete line follows them. It belongs to a run that is still training or was killed.
    pub is_torn: bool,
    /// SHA-256 of the rows without their seconds and stages.
    pub digest: Sha256,
}

/// Calls `each` with every complete row of a run's metrics. The rows of each trial must be in order, from generation 0.
pub(crate) fn visit(place: Place<'_>, config: &Config, mut each: impl FnMut(&Row)) -> Result<Extracted, RecordError> {
    let path = place.path();
    let mut rows = open(place)?;
    let (mut count, mut is_torn, mut next) = (0, false, vec![0; config.learning.trials]);
    for row in &mut rows {
        let row = match row {
            Ok((row, _)) => row,
            Err(RowsError::CutShort(_)) => {
                is_torn = true;
                break;
            }
            Err(RowsError::Read(error)) => return Err(RecordError::read(path)(error)),
            Err(wrong) => return Err(RecordError::damaged(path, wrong)),
        };
        let Row { trial, generation, .. } = row;
        count += 1;
        if trial >= next.len() || generation > config.learning.generations {
            let line = count + 1;
            let text = format!(
                "line {line} is trial {trial}, generation {generation}, which the run's config.toml does not have"
            );
            return Err(RecordError::damaged(path, text));
        }
        if generation != next[trial] {
            let text = format!(
                "trial {trial} of generation {generation} is out of order; it must have one row per trial and generation, \
                 in order"
            );
            return Err(RecordError::damaged(path, text));
        }
        next[trial] += 1;
        each(&row);
    }
    Ok(Extracted { rows: count, is_torn, digest: rows.digest() })
}
