//! `metrics.csv`: how every trial came on, generation by generation.
//!
//! One line a trial and generation, generation by generation and in each trial by trial. G is in 0..1; `seconds` is the
//! time trained until the line was complete, earlier sessions of a resumed run included. Where the config has stages, a
//! last column `stage` tells of which a generation is, from 0: G is of that stage's POIs. All but `seconds` is the same
//! bits on every backend.

use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::disk::{Disk, Output};
use super::{RecordError, hex};
use crate::config::{Config, MAX_GENERATIONS, MAX_TRIALS};
use crate::file;
use crate::trainer::Row;

/// The first line.
pub const HEADER: &str = "trial,generation,best_g,mean_g,champion_g,seconds";
/// The first line, where a config has stages.
pub const STAGED: &str = "trial,generation,best_g,mean_g,champion_g,seconds,stage";
/// Most bytes in one line.
const MAX_LINE: u64 = 256;

/// How far a file has come, to be found there again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Its first so many.
    pub bytes: u64,
    /// SHA-256 of these bytes.
    pub sha256: String,
}

impl Extent {
    /// The end of a text.
    pub fn after(text: &str) -> Extent {
        Extent { bytes: text.len() as u64, sha256: hex(&Sha256::digest(text)) }
    }
}

/// The lines of a config's file, each with its end.
pub struct Lines {
    /// The first generation of each stage after stage 0, and whether there is a column for it.
    stages: Vec<usize>,
    staged: bool,
}

impl Lines {
    /// How the lines of this config's runs are written.
    pub fn of(config: &Config) -> Lines {
        let stages = config.stages.iter().map(|stage| stage.from).filter(|&from| from > 0).collect();
        Lines { stages, staged: !config.stages.is_empty() }
    }

    /// The first line.
    pub fn header(&self) -> String {
        format!("{}\n", if self.staged { STAGED } else { HEADER })
    }

    /// A row's line; `seconds` is the time trained until it was complete.
    pub fn line(&self, row: &Row, seconds: f64) -> String {
        let stage = self.stages.partition_point(|&from| from <= row.generation);
        let stage = if self.staged { format!(",{stage}") } else { String::new() };
        format!("{},{seconds:.3}{stage}\n", shared(row))
    }
}

/// A file being written.
pub struct Writer {
    output: BufWriter<Output>,
    bytes: u64,
    hash: Sha256,
    lines: Lines,
}

impl Writer {
    /// Starts a file with its header, in the place of any other.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(disk: &Disk, path: &Path, config: &Config) -> io::Result<Writer> {
        let output = BufWriter::new(disk.create(path)?);
        let mut writer = Writer { output, bytes: 0, hash: Sha256::new(), lines: Lines::of(config) };
        writer.write(&writer.lines.header())?;
        writer.output.flush()?;
        Ok(writer)
    }

    /// Goes on from a mark, dropping what was written after it; none where the file no longer is what was marked.
    ///
    /// # Errors
    /// What the system says.
    pub fn resume(disk: &Disk, path: &Path, mark: &Extent, config: &Config) -> io::Result<Option<Writer>> {
        let mut hash = Sha256::new();
        let mut file = match file::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => BufReader::new(file?).take(mark.bytes),
        };
        // A run that ended before its stages came keeps their column.
        let mut first = Vec::new();
        file.by_ref().take(MAX_LINE).read_until(b'\n', &mut first)?;
        hash.update(&first);
        let lines = Lines { staged: first.starts_with(STAGED.as_bytes()), ..Lines::of(config) };
        let mut chunk = [0; 1 << 14];
        loop {
            match file.read(&mut chunk)? {
                0 => break,
                read => hash.update(&chunk[..read]),
            }
        }
        if file.limit() > 0 || hex(&hash.clone().finalize()) != mark.sha256 {
            return Ok(None);
        }
        let output = BufWriter::new(disk.append(path, mark.bytes)?);
        Ok(Some(Writer { output, bytes: mark.bytes, hash, lines }))
    }

    fn write(&mut self, line: &str) -> io::Result<()> {
        self.bytes += line.len() as u64;
        self.hash.update(line);
        self.output.write_all(line.as_bytes())
    }

    /// Adds rows that became complete after so many seconds.
    ///
    /// # Errors
    /// What the system says.
    pub fn add(&mut self, rows: &[Row], seconds: f64) -> io::Result<()> {
        rows.iter().try_for_each(|row| self.write(&self.lines.line(row, seconds)))
    }

    /// Hands all lines to the system, so that others can read them.
    ///
    /// # Errors
    /// What the system says.
    pub fn flush(&mut self) -> io::Result<()> {
        self.output.flush()
    }

    /// Where the file stands, and the file, for whoever has to see that this much of it is on the disk.
    ///
    /// # Errors
    /// What the system says.
    pub fn mark(&mut self) -> io::Result<(Extent, Output)> {
        self.output.flush()?;
        let sha256 = hex(&self.hash.clone().finalize());
        Ok((Extent { bytes: self.bytes, sha256 }, self.output.get_ref().share()?))
    }
}

/// A row's line without its seconds, which is the same bits on every backend.
fn shared(row: &Row) -> String {
    let Row { trial, generation, best_g, mean_g, champion_g, .. } = row;
    format!("{trial},{generation},{best_g},{mean_g},{champion_g}")
}

/// Whether a file begins as one of these, as far as it goes: its first line may be torn.
///
/// # Errors
/// What the system says.
pub fn begins(path: &Path) -> io::Result<bool> {
    let mut start = Vec::new();
    file::open(path)?.take("trial,generation,".len() as u64).read_to_end(&mut start)?;
    Ok(HEADER.as_bytes().starts_with(&start))
}

/// SHA-256 over rows as in a file, without their seconds, and then over policies: a run's digest.
pub fn digest(rows: impl Iterator<Item = Row>, policies: &[impl AsRef<[f32]>]) -> [u8; 32] {
    let mut hash = Sha256::new();
    for line in std::iter::once(without_last(HEADER).to_string()).chain(rows.map(|row| shared(&row))) {
        hash.update(line);
        hash.update("\n");
    }
    policies.iter().for_each(|weights| hash.update(bytemuck::cast_slice::<f32, u8>(weights.as_ref())));
    hash.finalize().into()
}

/// What is wrong with a file's rows.
#[derive(Debug, thiserror::Error)]
pub enum RowsError {
    /// As the last line of a file that is still being written.
    #[error("line {0} is cut short or longer than {MAX_LINE} bytes")]
    CutShort(usize),
    /// A line that is no row, or a row out of its place.
    #[error("line {line} is not {what}")]
    Wrong {
        /// From 1.
        line: usize,
        /// What should stand there.
        what: String,
    },
    /// The system's words.
    #[error("cannot be read: {0}")]
    Read(#[from] io::Error),
}

/// The rows of a file one by one, with the seconds of each; stops at the first that is wrong.
pub struct Rows<R> {
    source: R,
    line: usize,
    done: bool,
    /// Whether lines have a stage after the seconds.
    staged: bool,
    /// SHA-256 of every line without its seconds and its stage.
    hash: Sha256,
}

impl<R: BufRead> Rows<R> {
    /// # Errors
    /// The first line is not the header.
    pub fn new(source: R) -> Result<Rows<R>, RowsError> {
        let mut rows = Rows { source, line: 0, done: false, staged: false, hash: Sha256::new() };
        match rows.line() {
            Ok(Some(header)) if header == HEADER => Ok(rows),
            Ok(Some(header)) if header == STAGED => {
                // The first line's part, too, is that of any other file.
                let mut hash = Sha256::new();
                hash.update(without_last(HEADER));
                hash.update("\n");
                Ok(Rows { staged: true, hash, ..rows })
            }
            Err(error @ RowsError::Read(_)) => Err(error),
            _ => Err(RowsError::Wrong { line: 1, what: HEADER.into() }),
        }
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
        self.hash.update(without_last(if self.staged { without_last(&line) } else { &line }));
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
                arm: 0,
                trial: field()?.parse().ok().filter(|&trial| trial < MAX_TRIALS)?,
                generation: field()?.parse().ok().filter(|&generation| generation <= MAX_GENERATIONS)?,
                best_g: share(field()?)?,
                mean_g: share(field()?)?,
                champion_g: share(field()?)?,
            };
            let seconds = field()?.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0)?;
            let whole = !self.staged || field()?.parse::<usize>().is_ok();
            (whole && fields.next().is_none()).then_some((row, seconds))
        };
        let header = if self.staged { STAGED } else { HEADER };
        parse().map(Some).ok_or_else(|| self.wrong(format!("{header} with every G in 0..1")))
    }

    /// SHA-256 over all that was read, without the seconds.
    pub fn digest(self) -> Sha256 {
        self.hash
    }
}

/// A line without its last field.
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

/// Opens a run's metrics.
///
/// # Errors
/// No such file, or another first line.
pub fn open(path: &Path) -> Result<Rows<BufReader<File>>, RecordError> {
    let file = file::open(path).map_err(RecordError::read(path))?;
    Rows::new(BufReader::new(file)).map_err(|reason| RecordError::damaged(path, reason))
}
