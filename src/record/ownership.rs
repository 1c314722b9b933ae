//! What flotilla may write, replace, rename and delete: everything that writes in a folder of its own asks here.
//!
//! - Below such a folder no symbolic link is followed ([`enter`], [`Disk::within`]).
//! - A folder that belongs to another user is written in only if the user named it as the place to write.
//! - A run's own files (config, metrics, policies, checkpoints, `run.json`) may be replaced in a folder that holds a run,
//!   which `run.json` or a checkpoint says ([`holds_run`]).
//! - What is made of runs (pictures, pages, tables) is written by [`publish`], which first notes its SHA-256 in [`LIST`].
//!   A file may be replaced or deleted only if it still is what that list says.
//! - A file that the user named is the user's own choice, and does not ask here.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::beneath::{FileKind, is_link};
use super::disk::Disk;
use super::{RecordError, checkpoint, hex, metrics, policies, read_text, tensors, without_checkpoint};
use crate::config::Config;
use crate::file;

/// The config, every key written out.
pub const CONFIG: &str = "config.toml";
/// What the run is and what became of it, see [`super::folder::Run`].
pub const RUN: &str = "run.json";
/// See [`super::metrics`].
pub const METRICS: &str = "metrics.csv";
/// See [`super::policies`].
pub const POLICIES: &str = "policies.safetensors";
/// The folder of [`super::checkpoint`]s.
pub const CHECKPOINTS: &str = "checkpoints";
/// What marks a folder as a paper's, and the folder of its runs.
pub const PAPER: &str = "paper.toml";
/// The folder of a paper's runs.
pub const ARMS: &str = "arms";
/// In a sweep's folder: the sweep as it was run, and its tables.
pub const SWEEP: &str = "sweep.toml";
/// A sweep's rows, one a trial.
pub const RESULTS: &str = "results.csv";
/// A sweep's points, one a line.
pub const POINTS: &str = "points.csv";
/// Pictures and pages of a run in its folder.
pub const CURVES: &str = "curves.svg";
/// See [`CURVES`].
pub const REPLAY: &str = "replay.html";
/// The list of what was made of runs: a line each, SHA-256 and name, as `sha256sum` has it.
pub const LIST: &str = ".flotilla.sha256";
/// Most bytes in `run.json`.
pub(super) const MAX_RUN_BYTES: u64 = 1 << 16;
/// Most bytes in [`LIST`].
const MAX_LIST_BYTES: u64 = 1 << 24;

/// Enters a folder to write in it: below it no symbolic link is followed. `named` is whether the user named the folder as
/// the place to write.
///
/// # Errors
/// It cannot be opened, or belongs to another user and was not named.
pub fn enter(disk: &Disk, folder: &Path, named: bool) -> Result<Disk, RecordError> {
    let inside = disk.within(folder).map_err(RecordError::write(folder))?;
    let owners = inside.root().map_or(Ok(None), |root| root.owners()).map_err(RecordError::write(folder))?;
    match owners {
        Some([owner, user]) if !may_enter(owner, user, named) => {
            Err(RecordError::OfAnotherUser { path: folder.into() })
        }
        _ => Ok(inside),
    }
}

/// Whether a user may write in an owner's folder.
pub fn may_enter(owner: u32, user: u32, named: bool) -> bool {
    named || owner == user
}

/// The facts that every `run.json` of any version has.
#[derive(Deserialize)]
#[expect(dead_code, reason = "that they are there is what counts")]
struct RunMark {
    version: String,
    state: String,
    seed: u64,
}

/// Whether a folder holds a run, by its `run.json` or a checkpoint, or what is left of one of this config.
///
/// # Errors
/// It holds no run, but a file that one would replace; or it cannot be looked into.
pub fn holds_run(folder: &Path, config: &Config) -> Result<bool, RecordError> {
    let there = |name: &str| {
        let path = folder.join(name);
        let there = file::exists(&path).map_err(RecordError::read(&path))?;
        Ok::<_, RecordError>(there.then_some(path))
    };
    let refuse = |path: PathBuf| Err(RecordError::NotOurs { path });
    let run = there(RUN)?;
    if let Some(path) = &run {
        match read_text(path, MAX_RUN_BYTES) {
            Ok(text) if serde_json::from_str::<RunMark>(&text).is_ok() => return Ok(true),
            Ok(_) | Err(RecordError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    let checkpoints = folder.join(CHECKPOINTS);
    let saved = checkpoint::list(&checkpoints)?;
    let paths = || saved.iter().map(|&generation| checkpoint::path(&checkpoints, generation));
    if paths().any(|path| tensors::open(&path).is_ok_and(|file| file.kind().is_some())) {
        return Ok(true);
    }
    let no_folder = there(CHECKPOINTS)?.filter(|path| !path.is_dir());
    if let Some(path) = run.or_else(|| paths().next()).or(no_folder) {
        return refuse(path);
    }
    if let Some(path) = there(CONFIG)? {
        // One that says the same is what a run may start from.
        match Config::load(&path) {
            Ok(there) if without_checkpoint(&there) == without_checkpoint(config) => {}
            _ => return refuse(path),
        }
    }
    let mut left = false;
    if let Some(path) = there(METRICS)? {
        if !metrics::begins(&path).map_err(RecordError::read(&path))? {
            return refuse(path);
        }
        left = true;
    }
    if let Some(path) = there(POLICIES)? {
        if !policies::are_of(&path, config) {
            return refuse(path);
        }
        left = true;
    }
    Ok(left)
}

/// Refuses a run's folder in which one of the run's own names is a link, before anything in it is touched.
///
/// # Errors
/// The first such name; or the folder cannot be looked into.
pub fn refuse_links(disk: &Disk, folder: &Path) -> Result<(), RecordError> {
    for path in [RUN, CONFIG, METRICS, POLICIES, CHECKPOINTS].map(|name| folder.join(name)) {
        if disk.kind(&path).map_err(RecordError::write(&path))? == Some(FileKind::Link) {
            return Err(RecordError::write(&path)(is_link(&path)));
        }
    }
    Ok(())
}

/// Refuses to write what is made of runs where a file of that name was not made by flotilla, or not left as it was.
///
/// # Errors
/// The first such file; or a folder cannot be looked into.
pub fn check<P: AsRef<Path>>(disk: &Disk, paths: impl IntoIterator<Item = P>) -> Result<(), RecordError> {
    let mut lists = BTreeMap::new();
    for path in paths {
        let path = path.as_ref();
        let Some(digest) = digest(disk, path)? else { continue };
        let folder = file::folder(path);
        if !lists.contains_key(folder) {
            lists.insert(folder.to_path_buf(), listed(disk, folder)?);
        }
        if !lists[folder].contains(&line(&digest, path)) {
            return Err(RecordError::NotOurs { path: path.into() });
        }
    }
    Ok(())
}

/// Writes a file that is made of runs, whole or not at all.
///
/// # Errors
/// A file of that name was not made by flotilla, or not left as it was; or the file cannot be written.
pub fn publish(
    disk: &Disk,
    path: &Path,
    content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), RecordError> {
    check(disk, [path])?;
    let folder = file::folder(path);
    let listed = listed(disk, folder)?;
    let hash = std::cell::RefCell::new(Sha256::new());
    let content = |output: &mut dyn Write| content(&mut Hashing { output, hash: &mut hash.borrow_mut() });
    // Listed before it is there: a crash in between leaves a line too many, which harms nobody.
    let list = || {
        let line = line(&hex(&hash.borrow().clone().finalize()), path);
        if listed.contains(&line) {
            return Ok(());
        }
        // A crash may have cut the last line short.
        let torn = listed.last().is_some_and(|last| !last.ends_with('\n'));
        disk.extend(&folder.join(LIST), format!("{}{line}", if torn { "\n" } else { "" }).as_bytes())?.sync()
    };
    disk.replace_shared(path, content, list).map_err(RecordError::write(path))
}

/// Deletes a file that is made of runs; one that flotilla did not make, or that was changed, stays.
///
/// # Errors
/// It cannot be deleted, or looked at.
pub fn withdraw(disk: &Disk, path: &Path) -> Result<(), RecordError> {
    match check(disk, [path]) {
        Ok(()) => disk.remove(path).map_err(RecordError::write(path)),
        Err(RecordError::NotOurs { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Whether flotilla drew a picture, by what it holds: an SVG or a PNG.
pub fn is_drawing(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = file::open(path).and_then(|file| file.take(1 << 12).read_to_end(&mut start));
    let holds = |piece: &[u8]| start.windows(piece.len()).any(|window| window == piece);
    let svg =
        start.starts_with(b"<svg xmlns=") && holds(b" role=\"img\" aria-labelledby=\"title description\">\n<title");
    read.is_ok() && (svg || start.starts_with(b"\x89PNG") && holds(SOFTWARE))
}

/// The text chunk of a PNG that says what drew it.
const SOFTWARE: &[u8] = b"tEXtSoftware\0flotilla";

/// A line of [`LIST`].
fn line(digest: &str, path: &Path) -> String {
    format!("{digest}  {}\n", path.file_name().unwrap_or_default().to_string_lossy())
}

/// The lines of a folder's [`LIST`].
fn listed(disk: &Disk, folder: &Path) -> Result<Vec<String>, RecordError> {
    let path = folder.join(LIST);
    let list = match disk.read(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(vec![]),
        list => BufReader::new(list.map_err(RecordError::read(&path))?),
    };
    let mut list = list.take(MAX_LIST_BYTES);
    let (mut lines, mut line) = (Vec::new(), Vec::new());
    while list.read_until(b'\n', &mut line).map_err(RecordError::read(&path))? > 0 {
        lines.push(String::from_utf8_lossy(&line).into_owned());
        line.clear();
    }
    Ok(lines)
}

/// SHA-256 of a file, if it is there.
fn digest(disk: &Disk, path: &Path) -> Result<Option<String>, RecordError> {
    if disk.kind(path).map_err(RecordError::write(path))?.is_none() {
        return Ok(None);
    }
    // A link, a folder or a pipe could not be written either.
    let mut there = disk.read(path).map_err(RecordError::write(path))?;
    let mut hash = Sha256::new();
    let mut chunk = vec![0; 1 << 16];
    loop {
        match there.read(&mut chunk).map_err(RecordError::read(path))? {
            0 => return Ok(Some(hex(&hash.finalize()))),
            read => hash.update(&chunk[..read]),
        }
    }
}

/// Takes all that is written into a digest.
struct Hashing<'a> {
    output: &'a mut dyn Write,
    hash: &'a mut Sha256,
}

impl Write for Hashing<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.output.write(bytes)?;
        self.hash.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.output.flush()
    }
}
