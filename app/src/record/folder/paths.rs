//! Recognition and numbering of folders.

use std::fs;
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

use super::{ARMS, CHECKPOINTS, CONFIG, LOCK, METRICS, PAPER, POINTS, POLICIES, RESULTS, RUN, Run, SWEEP};
use crate::record::RecordError;
use crate::record::ownership::LIST;
use flotilla::file;

/// Reports whether a folder contains any file of a run.
pub fn holds_run(path: &Path) -> Result<bool, RecordError> {
    for name in [CONFIG, RUN, METRICS, POLICIES, CHECKPOINTS] {
        let name = path.join(name);
        if file::exists(&name).map_err(RecordError::read(&name))? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Returns "a paper" or "a sweep" if the folder contains the runs of one.
pub fn collection(path: &Path) -> Option<&'static str> {
    let all = [(PAPER, "a paper"), (SWEEP, "a sweep")];
    all.into_iter().find(|(name, _)| path.join(name).exists()).map(|(_, what)| what)
}

/// Reports whether a folder contains one of these names.
fn has(folder: &Path, names: &[&str]) -> bool {
    names.iter().any(|name| folder.join(name).exists())
}

fn is_run(folder: &Path) -> bool {
    has(folder, &[CONFIG]) && has(folder, &[RUN, METRICS, CHECKPOINTS])
}

/// Returns the folder of the run, sweep or paper that needs a file. Pictures and pages are not needed.
pub fn owner(path: &Path) -> Option<PathBuf> {
    let path = file::resolved(path);
    let (folder, name) = (file::folder(&path), path.file_name()?.to_str()?);
    if folder.ends_with(CHECKPOINTS) && is_run(file::folder(folder)) {
        return Some(file::folder(folder).into());
    }
    let is_needed = match name {
        CONFIG | RUN | METRICS | POLICIES | LOCK => is_run(folder),
        LIST => is_run(folder) || has(folder, &[SWEEP, ARMS]),
        SWEEP | RESULTS | POINTS => has(folder, &[SWEEP]),
        PAPER => has(folder, &[ARMS]),
        _ => false,
    };
    is_needed.then(|| folder.into())
}

/// Returns the outermost folder of a run, sweep or paper that a path lies in, as the path names it.
pub fn around(path: &Path) -> Option<&Path> {
    let is_ours = |folder: &Path| {
        is_run(folder)
            || has(folder, &[SWEEP]) && has(folder, &["points"])
            || has(folder, &[PAPER]) && has(folder, &[ARMS])
    };
    let descends = |folder: &&Path| {
        let below = path.strip_prefix(folder).unwrap_or(path);
        below.components().all(|part| matches!(part, Component::Normal(_)))
    };
    let folders =
        path.ancestors().skip(1).map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder });
    folders.filter(descends).filter(|folder| is_ours(folder)).last()
}

/// Creates the next folder after the last existing one of `stem`, `stem-2`, `stem-3`, … and returns its path.
pub fn next_free(parent: &Path, stem: &str) -> Result<PathBuf, RecordError> {
    fs::create_dir_all(parent).map_err(RecordError::write(parent))?;
    let mut number = numbers(parent, stem).max().unwrap_or(0) + 1;
    loop {
        let path = numbered(parent, stem, number);
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(RecordError::write(&path)(error)),
        }
    }
}

/// Returns the last existing path of `stem`, `stem-2`, …, or `stem` if none exists. Runs with another name are left out.
pub fn latest(parent: &Path, stem: &str) -> PathBuf {
    let own = numbers(parent, stem).filter(|&number| other_name(&numbered(parent, stem, number), stem).is_none());
    numbered(parent, stem, own.max().unwrap_or(1))
}

/// Returns the name of the run in a folder if it has another name: `x-2` may be the second run of `x`.
pub fn other_name(folder: &Path, name: &str) -> Option<String> {
    Run::read(&folder.join(RUN)).ok()?.name.filter(|other| other != name)
}

/// Returns the numbers of the existing folders.
fn numbers(parent: &Path, stem: &str) -> impl Iterator<Item = usize> {
    let number = move |name: &str| match name.strip_prefix(stem)? {
        "" => Some(1),
        rest => rest.strip_prefix('-')?.parse().ok().filter(|&number| name == format!("{stem}-{number}") && number > 1),
    };
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    entries.filter_map(move |entry| number(entry.file_name().to_str()?))
}

fn numbered(parent: &Path, stem: &str, number: usize) -> PathBuf {
    parent.join(if number == 1 { stem.to_string() } else { format!("{stem}-{number}") })
}
