//! Files that a command was told to write.

use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use super::{Error, say};
use crate::escape::PathExt;
use crate::file;
use crate::record::disk::Disk;
use crate::record::{RecordError, folder};

/// Refuses to write over what is read, over another output, or over what a run needs. Each file comes with its flag.
///
/// # Errors
/// An output stands for something else already.
pub fn check(outputs: &[(&str, Option<&Path>)], inputs: &[&Path]) -> Result<(), Error> {
    let mut taken: Vec<_> = inputs.iter().map(|path| (file::resolved(path), "is read from".to_string())).collect();
    for &(flag, path) in outputs {
        let Some(path) = path else { continue };
        // Devices take whatever comes.
        if path.exists() && !path.is_file() && !path.is_dir() {
            continue;
        }
        // Better told before hours of playing than after.
        if let Err(error) = fs::metadata(file::folder(path)) {
            return Err(RecordError::Write { path: path.into(), error }.into());
        }
        if path.is_dir() {
            let error = io::ErrorKind::IsADirectory.into();
            return Err(RecordError::Write { path: path.into(), error }.into());
        }
        let resolved = file::resolved(path);
        let refused =
            |why: &str| Err(Error::Usage(format!("{flag} {}: this file {why}; name another to write", path.escaped())));
        if let Some((_, why)) = taken.iter().find(|(other, _)| *other == resolved) {
            return refused(why);
        }
        if let Some(owner) = folder::owner(path) {
            return refused(&format!("belongs to what is in {}", owner.escaped()));
        }
        taken.push((resolved, format!("is written by {flag}")));
    }
    Ok(())
}

/// Writes a file, whole or not at all. A pipe is waited for until somebody reads from it.
///
/// # Errors
/// It cannot be written.
pub fn write(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), Error> {
    let opened = tell_of_waiting(path);
    let content = |output: &mut dyn Write| {
        drop(opened);
        content(output)
    };
    Ok(Disk::default().deliver(path, content).map_err(|error| RecordError::Write { path: path.into(), error })?)
}

/// Says that a pipe waits for somebody to read from it, unless what this gives is dropped soon, once it is open.
fn tell_of_waiting(path: &Path) -> mpsc::Sender<()> {
    let (opened, waiting) = mpsc::channel();
    if fs::metadata(path).is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        let path = path.to_path_buf();
        // Without a thread nobody is told, which changes nothing else.
        let _ = thread::Builder::new().spawn(move || {
            if waiting.recv_timeout(PATIENCE) == Err(mpsc::RecvTimeoutError::Timeout) {
                say(format_args!("waiting for somebody to read from {}", path.escaped()));
            }
        });
    }
    opened
}

/// Until it is told that somebody is waited for.
const PATIENCE: Duration = Duration::from_secs(1);
