//! Decides which files may be written, and writes them: the one owner of paths for everything that is not part of a
//! run's own files.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{OnceLock, mpsc};
use std::thread;
use std::time::Duration;

use super::{Error, with_remedy};
use crate::record::disk::{Disk, without_path};
use crate::record::{RecordError, folder, ownership};
use flotilla::escape::PathExt;
use flotilla::file;

/// The file that a picture or a page is written to.
pub enum Destination {
    /// A file that the user named. It is overwritten whatever it contains.
    Named(PathBuf),
    /// A file in a run's folder.
    OfRun(PathBuf),
    /// A file in the current folder, with a name that the user did not choose.
    Here(PathBuf),
}

impl Destination {
    /// Returns the file's path.
    pub fn path(&self) -> &Path {
        match self {
            Destination::Named(path) | Destination::OfRun(path) | Destination::Here(path) => path,
        }
    }

    /// Refuses a file that flotilla did not make, and a folder without write permission. A file that the user named is
    /// not checked; [`check`] does that.
    ///
    /// # Errors
    /// Fails for such a file or folder, and if the folder belongs to another user.
    pub fn check(&self) -> Result<(), RecordError> {
        let path = self.path();
        match self {
            Destination::Named(_) => return Ok(()),
            Destination::OfRun(_) => ownership::check(&self.disk()?, [path])?,
            Destination::Here(_) if path.symlink_metadata().is_err() || ownership::is_drawing(path) => {}
            Destination::Here(_) => return Err(RecordError::NotOurs(path.into())),
        }
        check_folder(file::folder(path)).map_err(RecordError::write(path))
    }

    /// Writes the file completely or not at all.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or for the reasons of [`Destination::check`].
    pub fn write(&self, content: &[u8]) -> Result<(), Error> {
        self.check()?;
        let put = |output: &mut dyn Write| output.write_all(content);
        match self {
            Destination::Named(path) => write_with(path, put),
            Destination::OfRun(path) => Ok(ownership::publish(&self.disk()?, path, put)?),
            Destination::Here(path) => Ok(self.disk()?.replace_shared(path, put).map_err(RecordError::write(path))?),
        }
    }

    /// Returns a disk that is limited to the file's folder.
    fn disk(&self) -> Result<Disk, RecordError> {
        ownership::open_output_folder(
            &Disk::default(),
            file::folder(self.path()),
            matches!(self, Destination::Named(_)),
        )
    }
}

/// Refuses outputs that would overwrite an input, another output, or a file that a run needs. Each output comes with
/// its flag.
///
/// # Errors
/// Fails for such an output, for a folder, and for a file that cannot be written, because of its permissions or because
/// its folder does not exist.
pub fn check(outputs: &[(&str, Option<&Path>)], inputs: &[&Path]) -> Result<(), Error> {
    let mut taken: Vec<_> = inputs.iter().map(|path| (file::resolved(path), "is read from".to_string())).collect();
    for &(flag, path) in outputs {
        let Some(path) = path else { continue };
        // Devices and pipes have no content that could be lost.
        if path.exists() && !path.is_file() && !path.is_dir() {
            continue;
        }
        // This fails now, because the file may only be written after hours of computation.
        if let Err(error) = fs::metadata(file::folder(path)) {
            let error = match error.kind() {
                io::ErrorKind::NotFound => file::no_folder(path),
                _ => error,
            };
            return Err(RecordError::write(path)(error).into());
        }
        if path.is_dir() {
            return Err(RecordError::write(path)(io::ErrorKind::IsADirectory.into()).into());
        }
        disk(path).map_err(RecordError::write(path))?;
        let resolved = file::resolved(path);
        let refused = |why: &str| {
            Err(Error::Usage(with_remedy(
                format!("{flag} {}: this file {why}", path.escaped()),
                "name another to write",
            )))
        };
        if let Some((_, why)) = taken.iter().find(|(other, _)| *other == resolved) {
            return refused(why);
        }
        if let Some(owner) = folder::owner(path) {
            return refused(&format!("is part of the run, sweep or paper in {}", owner.escaped()));
        }
        check_permission(&resolved).map_err(RecordError::write(path))?;
        taken.push((resolved, format!("is written by {flag}")));
    }
    Ok(())
}

/// Fails if a file may not be written or replaced. Links in `path` are already resolved.
fn check_permission(path: &Path) -> io::Result<()> {
    if path.is_file() {
        OpenOptions::new().write(true).open(path)?;
    }
    check_folder(file::folder(path))
}

/// Fails if no file can be created in a folder. Every file is written to a temporary file next to it first.
fn check_folder(folder: &Path) -> io::Result<()> {
    tempfile::tempfile_in(folder).map(drop).map_err(without_path)
}

/// Writes a file as [`write_with`] does.
pub fn write(path: &Path, content: &[u8]) -> Result<(), Error> {
    write_with(path, |output| output.write_all(content))
}

/// Writes a file completely or not at all. A pipe blocks until a reader opens it. In the folder of a run, sweep or
/// paper no link is followed, because other users may write there.
pub fn write_with(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), Error> {
    let opened = report_waiting_later(path);
    let content = |output: &mut dyn Write| {
        drop(opened);
        content(output)
    };
    let written = disk(path).and_then(|disk| disk.write_user_file(path, content));
    Ok(written.map_err(RecordError::write(path))?)
}

/// Writes a file that must not exist yet.
pub fn write_new(path: &Path, content: &[u8]) -> Result<(), Error> {
    let created = OpenOptions::new().write(true).create_new(true).open(path);
    let written = match created {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            Err(io::Error::other("the file exists; choose another --out, or overwrite it with --force"))
        }
        created => created.and_then(|mut file| {
            file.write_all(content).inspect_err(|_| {
                // An incomplete file is worse than none.
                let _ = fs::remove_file(path);
            })
        }),
    };
    Ok(written.map_err(RecordError::write(path))?)
}

/// Returns the disk for a file that the user named, which is not a link in one of flotilla's folders.
fn disk(path: &Path) -> io::Result<Disk> {
    let Some(folder) = folder::around(path) else { return Ok(Disk::default()) };
    let disk = Disk::default().within(folder)?;
    disk.refuse_link(path)?;
    Ok(disk)
}

/// Reports that a pipe has no reader yet, unless the returned sender is dropped within [`REPORT_AFTER`].
fn report_waiting_later(path: &Path) -> mpsc::Sender<()> {
    let (opened, waiting) = mpsc::channel();
    if fs::metadata(path).is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        let path = path.to_path_buf();
        // If no thread can be started, only the message is missing.
        let _ = thread::Builder::new().spawn(move || {
            let silent = waiting.recv_timeout(REPORT_AFTER) == Err(mpsc::RecvTimeoutError::Timeout);
            if silent && let Some(report) = REPORT.get() {
                report(&format!("waiting for a reader of {}", path.escaped()));
            }
        });
    }
    opened
}

/// Reports a pipe without a reader to people, see [`report_waiting`].
static REPORT: OnceLock<fn(&str)> = OnceLock::new();

/// Sets the function that reports to people that a pipe has no reader yet. Only the first call has an effect.
pub fn report_waiting(report: fn(&str)) {
    let _ = REPORT.set(report);
}

/// Time until a pipe without a reader is reported.
const REPORT_AFTER: Duration = Duration::from_secs(1);
