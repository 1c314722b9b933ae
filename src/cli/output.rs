//! Files that a command was told to write.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use super::{Error, say};
use crate::escape::PathExt;
use crate::file;
use crate::record::disk::Disk;
use crate::record::{RecordError, folder, ownership};

/// Where a picture or a page goes.
pub enum Destination {
    /// The user named the file, whatever it is.
    Named(PathBuf),
    /// A file of a run's folder.
    OfRun(PathBuf),
    /// A file of the present folder, by a name that the user did not choose.
    Here(PathBuf),
}

impl Destination {
    /// The file.
    pub fn path(&self) -> &Path {
        match self {
            Destination::Named(path) | Destination::OfRun(path) | Destination::Here(path) => path,
        }
    }

    /// Refuses a file that flotilla did not make, unless the user named it.
    ///
    /// # Errors
    /// It is such, or the folder belongs to another user.
    pub fn check(&self) -> Result<(), RecordError> {
        match self {
            Destination::Named(_) => Ok(()),
            Destination::OfRun(path) => ownership::check(&self.disk()?, [path]),
            Destination::Here(path) if path.symlink_metadata().is_err() || ownership::is_drawing(path) => Ok(()),
            Destination::Here(path) => Err(RecordError::NotOurs { path: path.clone() }),
        }
    }

    /// Writes the file, whole or not at all.
    ///
    /// # Errors
    /// It cannot be written, or [`Destination::check`].
    pub fn write(&self, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), Error> {
        self.check()?;
        match self {
            Destination::Named(path) => write(path, content),
            Destination::OfRun(path) => Ok(ownership::publish(&self.disk()?, path, content)?),
            Destination::Here(path) => {
                let written = self.disk()?.replace_shared(path, content, || Ok(()));
                Ok(written.map_err(|error| RecordError::Write { path: path.clone(), error })?)
            }
        }
    }

    /// The disk within the file's folder, which no flag names.
    fn disk(&self) -> Result<Disk, RecordError> {
        ownership::enter(&Disk::default(), file::folder(self.path()), matches!(self, Destination::Named(_)))
    }
}

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
