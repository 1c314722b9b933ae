//! Rules for which files flotilla may write, replace, rename and delete. All code that writes in one of flotilla's
//! folders uses this module.
//!
//! - No symbolic link below such a folder is followed ([`open_output_folder`], [`Disk::within`]).
//! - A folder of another user is written to only if the user named it as the output folder.
//! - The files of a run (config, metrics, policies, checkpoints, `run.json`) may be replaced if the folder holds a run.
//!   A valid `run.json` or checkpoint shows that ([`holds_run`]).
//! - [`publish`] writes files made from runs (pictures, pages, tables). It first records their SHA-256 in [`LIST`].
//!   Such a file may be replaced or deleted only if its content is still in that list.
//! - Files that the user named are not subject to these rules, except that no link is followed in the folder of a run,
//!   sweep or paper ([`super::folder::around`]).

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::disk::{Disk, Place};
use super::{
    Hashing, RecordError, checkpoint, config_digest, hash_rest, hex, load_config, metrics, policies, read_text,
    tensors, without_checkpoint,
};
use flotilla::config::Config;
use flotilla::file;

/// The config with every key.
pub const CONFIG: &str = "config.toml";
/// Description and state of the run. See [`super::folder::Run`].
pub const RUN: &str = "run.json";
/// Scores of every trial in every generation. See [`super::metrics`].
pub const METRICS: &str = "metrics.csv";
/// Policies that the run learned. See [`super::policies`].
pub const POLICIES: &str = "policies.safetensors";
/// Folder of the [`super::checkpoint`]s.
pub(crate) const CHECKPOINTS: &str = "checkpoints";
/// File that marks a folder as the folder of a paper.
pub const PAPER: &str = "paper.toml";
/// Folder of the runs of a paper.
pub const ARMS: &str = "arms";
/// The sweep as it was run. This file marks a folder as the folder of a sweep.
pub const SWEEP: &str = "sweep.toml";
/// Results of a sweep, one line per trial.
pub const RESULTS: &str = "results.csv";
/// Points of a sweep, one per line.
pub const POINTS: &str = "points.csv";
/// Training curves in the folder of a run.
pub const CURVES: &str = "curves.svg";
/// Replay page in the folder of a run.
pub(crate) const REPLAY: &str = "replay.html";
/// List of the files made from runs. Each line has SHA-256 and name, in the format of `sha256sum`.
pub const LIST: &str = ".flotilla.sha256";
/// Maximum size of `run.json` in bytes.
pub(super) const MAX_RUN_BYTES: u64 = 1 << 16;
/// Maximum number of bytes that are read from [`LIST`], from its end.
const MAX_LIST_BYTES: u64 = 1 << 24;
/// Number of lines above which [`LIST`] is written anew, without the lines of files that no longer exist.
const MAX_LIST_LINES: usize = 500;
/// Number of newest lines that are always kept, because another process may be about to write these files.
const NEW_LINES: usize = 50;

/// Prepares a folder for writing. No symbolic link below it is followed. `named` is true if the user named the folder
/// as the output folder.
pub(crate) fn open_output_folder(disk: &Disk, folder: &Path, named: bool) -> Result<Disk, RecordError> {
    let inside = disk.within(folder).map_err(RecordError::write(folder))?;
    let owners = inside.root().map_or(Ok(None), |root| root.owners()).map_err(RecordError::write(folder))?;
    match owners {
        Some([owner, user]) if !may_write(owner, user, named) => Err(RecordError::OfAnotherUser(folder.into())),
        _ => Ok(inside),
    }
}

/// Creates a folder if it is missing, and prepares it as [`open_output_folder`] does.
///
/// # Errors
/// The folder cannot be created or is the root of the file system, or see [`open_output_folder`].
pub fn create_output_folder(disk: &Disk, folder: &Path, named: bool) -> Result<Disk, RecordError> {
    if fs::canonicalize(folder).is_ok_and(|folder| folder.parent().is_none()) {
        let error = io::Error::new(ErrorKind::InvalidInput, "it is the root of the file system; choose a folder in it");
        return Err(RecordError::write(folder)(error));
    }
    disk.create_folder(folder).map_err(RecordError::write(folder))?;
    open_output_folder(disk, folder, named)
}

/// Reports whether a user may write in the folder of an owner.
pub fn may_write(owner: u32, user: u32, named: bool) -> bool {
    named || owner == user
}

/// Fields that every version of `run.json` has.
#[derive(Deserialize)]
#[expect(dead_code, reason = "that they are there is what counts")]
struct RunMark {
    version: String,
    state: String,
    seed: u64,
}

/// Reports whether a folder holds a run, shown by a `run.json`, a checkpoint or leftover files of a run of this config.
///
/// # Errors
/// The folder has a file that a run would replace but holds no run, or it cannot be read.
pub(crate) fn holds_run(folder: Place<'_>, config: &Config) -> Result<bool, RecordError> {
    let find = |name: &str| {
        let path = folder.path().join(name);
        let exists = folder.at(&path).exists().map_err(RecordError::read(&path))?;
        Ok::<_, RecordError>(exists.then_some(path))
    };
    let refuse = |path: PathBuf| Err(RecordError::NotOurs(path));
    let run = find(RUN)?;
    if let Some(path) = &run {
        match read_text(folder.at(path), MAX_RUN_BYTES) {
            Ok(text) if serde_json::from_str::<RunMark>(&text).is_ok() => return Ok(true),
            Ok(_) | Err(RecordError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    let checkpoints = folder.path().join(CHECKPOINTS);
    let saved = checkpoint::list(folder.at(&checkpoints))?;
    let paths = || saved.iter().map(|&generation| checkpoint::path(&checkpoints, generation));
    if paths().any(|path| tensors::open(folder.at(&path)).is_ok_and(|file| file.kind().is_some())) {
        return Ok(true);
    }
    let no_folder = find(CHECKPOINTS)?.filter(|path| folder.at(path).list().is_err());
    if let Some(path) = run.or_else(|| paths().next()).or(no_folder) {
        return refuse(path);
    }
    if let Some(path) = find(CONFIG)? {
        // A run may start from a config with the same content.
        match load_config(folder.at(&path)) {
            Ok(existing) if without_checkpoint(&existing) == without_checkpoint(config) => {}
            _ => return refuse(path),
        }
    }
    let mut left = false;
    if let Some(path) = find(METRICS)? {
        if !metrics::begins(folder.at(&path)).map_err(RecordError::read(&path))? {
            return refuse(path);
        }
        left = true;
    }
    if let Some(path) = find(POLICIES)? {
        if policies::digests_in(folder.at(&path)).0 != Some(config_digest(config)) {
            return refuse(path);
        }
        left = true;
    }
    Ok(left)
}

/// Fails if one of the run's own files is a link. Callers check this before they change anything.
pub(crate) fn refuse_links(disk: &Disk, folder: &Path) -> Result<(), RecordError> {
    for path in [RUN, CONFIG, METRICS, POLICIES, CHECKPOINTS].map(|name| folder.join(name)) {
        disk.refuse_link(&path).map_err(RecordError::write(&path))?;
    }
    Ok(())
}

/// Fails if one of the files exists and flotilla did not create it, or its content has changed.
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
            return Err(RecordError::NotOurs(path.into()));
        }
    }
    Ok(())
}

/// Writes a file made from runs, whole or not at all.
///
/// # Errors
/// A file of that name was not created by flotilla or has changed, or the file cannot be written.
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
    // The digest is listed before the file gets its name. A crash in between leaves only an unused line.
    let list = || {
        let line = line(&hex(&hash.borrow().clone().finalize()), path);
        if listed.contains(&line) {
            return Ok(());
        }
        if listed.len() >= MAX_LIST_LINES {
            return shorten_list(disk, folder, &line);
        }
        // A crash may have left an incomplete last line.
        let torn = listed.last().is_some_and(|last| !last.ends_with('\n'));
        disk.extend(&folder.join(LIST), format!("{}{line}", if torn { "\n" } else { "" }).as_bytes())?.sync()
    };
    disk.replace_with(path, None, content, list).map_err(RecordError::write(path))
}

/// Writes a file made from runs like [`publish`].
pub fn publish_bytes(disk: &Disk, path: &Path, content: &[u8]) -> Result<(), RecordError> {
    publish(disk, path, |output| output.write_all(content))
}

/// Deletes a file made from runs. A file that flotilla did not create, or that has changed, is kept.
pub fn remove_published(disk: &Disk, path: &Path) -> Result<(), RecordError> {
    match check(disk, [path]) {
        Ok(()) => disk.remove(path).map_err(RecordError::write(path)),
        Err(RecordError::NotOurs { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Reports whether the content of a file is an SVG or PNG that flotilla drew.
pub(crate) fn is_drawing(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = file::open(path).and_then(|file| file.take(1 << 12).read_to_end(&mut start));
    let holds = |piece: &[u8]| start.windows(piece.len()).any(|window| window == piece);
    let svg =
        start.starts_with(b"<svg xmlns=") && holds(b" role=\"img\" aria-labelledby=\"title description\">\n<title");
    read.is_ok() && (svg || start.starts_with(b"\x89PNG") && holds(SOFTWARE))
}

/// PNG text chunk that names flotilla as the software.
const SOFTWARE: &[u8] = b"tEXtSoftware\0flotilla";

/// Returns the line of a file in [`LIST`].
pub(super) fn line(digest: &str, path: &Path) -> String {
    format!("{digest}  {}\n", path.file_name().unwrap_or_default().to_string_lossy())
}

/// Writes the [`LIST`] of a folder anew, with one more line and without those that no file has any more.
fn shorten_list(disk: &Disk, folder: &Path, new: &str) -> io::Result<()> {
    let lines = listed(disk, folder).map_err(io::Error::other)?;
    let (mut current, mut kept) = (BTreeMap::new(), Vec::new());
    for (index, text) in lines.iter().enumerate() {
        let Some((_, name)) = text.trim_end().split_once("  ") else { continue };
        let is_current = current.entry(name).or_insert_with(|| {
            let path = folder.join(name);
            digest(disk, &path).ok().flatten().map(|digest| line(&digest, &path))
        });
        if is_current.as_ref() == Some(text) || index + NEW_LINES >= lines.len() {
            kept.push(&**text);
        }
    }
    disk.replace_shared(&folder.join(LIST), |output| {
        kept.into_iter().chain([new]).try_for_each(|line| output.write_all(line.as_bytes()))
    })
}

/// Reads the lines of the [`LIST`] in a folder.
fn listed(disk: &Disk, folder: &Path) -> Result<Vec<String>, RecordError> {
    let path = folder.join(LIST);
    let list = match disk.read(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(vec![]),
        list => list.map_err(RecordError::read(&path))?,
    };
    let bytes = list.metadata().map_err(RecordError::read(&path))?.len();
    let mut list = BufReader::new(list);
    list.seek(SeekFrom::Start(bytes.saturating_sub(MAX_LIST_BYTES))).map_err(RecordError::read(&path))?;
    let mut list = list.take(MAX_LIST_BYTES);
    let (mut lines, mut line) = (Vec::new(), Vec::new());
    while list.read_until(b'\n', &mut line).map_err(RecordError::read(&path))? > 0 {
        lines.push(String::from_utf8_lossy(&line).into_owned());
        line.clear();
    }
    Ok(lines)
}

/// Returns the SHA-256 of a file, or `None` if it does not exist.
fn digest(disk: &Disk, path: &Path) -> Result<Option<String>, RecordError> {
    if disk.kind(path).map_err(RecordError::write(path))?.is_none() {
        return Ok(None);
    }
    // A link, a folder or a pipe is an error, because it could not be replaced either.
    let mut file = disk.read(path).map_err(RecordError::write(path))?;
    let mut hash = Sha256::new();
    hash_rest(&mut file, &mut hash).map_err(RecordError::read(path))?;
    Ok(Some(hex(&hash.finalize())))
}
