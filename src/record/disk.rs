//! Everything that is written goes through here: a file is replaced whole or not at all, and tests can make any
//! single operation fail.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::file;

/// One thing done to a disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// A folder, and those above it.
    CreateFolder,
    /// A file, to be written.
    Create,
    /// Some bytes to a file.
    Write,
    /// A file's or a folder's contents to the disk.
    Flush,
    /// A file cut to a length.
    Truncate,
    /// A file to its final name.
    Rename,
    /// A file or a folder.
    Remove,
}

/// Asked before each operation; its error becomes the operation's.
pub type Gate = dyn Fn(Operation, &Path) -> io::Result<()> + Send + Sync;

/// The file system, or a test's failing one.
#[derive(Clone, Default)]
pub struct Disk {
    gate: Option<Arc<Gate>>,
}

impl Disk {
    /// A disk whose operations fail when `gate` says so. A write that fails has written the first half.
    pub fn failing(gate: impl Fn(Operation, &Path) -> io::Result<()> + Send + Sync + 'static) -> Disk {
        Disk { gate: Some(Arc::new(gate)) }
    }

    fn pass(&self, operation: Operation, path: &Path) -> io::Result<()> {
        self.gate.as_ref().map_or(Ok(()), |gate| gate(operation, path))
    }

    /// Creates a folder and those above it.
    ///
    /// # Errors
    /// What the system says.
    pub fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.pass(Operation::CreateFolder, path)?;
        fs::create_dir_all(path).map_err(|error| match error.kind() {
            kind @ (io::ErrorKind::AlreadyExists | io::ErrorKind::NotADirectory) => {
                io::Error::new(kind, "a file stands where a folder is needed; choose another name")
            }
            _ => error,
        })
    }

    /// A new file in the place of any other; a link that stands there is replaced, never followed.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(&self, path: &Path) -> io::Result<Output> {
        self.remove(path)?;
        self.pass(Operation::Create, path)?;
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// The file as it is up to `length` bytes, to be written on from there; a link to another file is refused.
    ///
    /// # Errors
    /// What the system says.
    pub fn append(&self, path: &Path, length: u64) -> io::Result<Output> {
        if !fs::symlink_metadata(path)?.is_file() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is no plain file"));
        }
        let mut file = OpenOptions::new().write(true).open(path)?;
        self.pass(Operation::Truncate, path)?;
        file.set_len(length)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// Gives a file new content: after a crash at any moment it has either all of the old or all of the new.
    ///
    /// # Errors
    /// What the system says.
    pub fn replace(&self, path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        let temporary = temporary(path);
        let write = || {
            let mut output = BufWriter::with_capacity(1 << 20, self.create(&temporary)?);
            content(&mut output)?;
            output.into_inner().map_err(|error| error.into_error())?.sync()?;
            self.rename(&temporary, path)
        };
        write().inspect_err(|_| {
            // Whatever is left is cleared away with the next attempt.
            let _ = self.remove(&temporary);
        })
    }

    /// Writes a file that the user named, whole or not at all; a link to a file is followed. What is no file (a device,
    /// a pipe, `/dev/stdout`) is written to as it stands.
    ///
    /// # Errors
    /// What the system says.
    pub fn deliver(&self, path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        let there = fs::metadata(path);
        if there.as_ref().is_ok_and(|there| !there.is_file() && !there.is_dir()) {
            let mut output = BufWriter::new(OpenOptions::new().write(true).open(path)?);
            content(&mut output)?;
            return output.flush();
        }
        if there.is_ok() {
            // A file that may not be written is not replaced either.
            OpenOptions::new().write(true).open(path)?;
        }
        let path = &file::resolved(path);
        if !file::folder(path).is_dir() {
            return Err(io::Error::new(io::ErrorKind::NotFound, "there is no such folder; make it first"));
        }
        self.pass(Operation::Create, path)?;
        // A name that nobody has: beside the user's own files none can be taken for a leftover.
        let mut builder = tempfile::Builder::new();
        #[cfg(unix)]
        builder.permissions(match &there {
            Ok(there) => there.permissions(),
            Err(_) => std::os::unix::fs::PermissionsExt::from_mode(0o666),
        });
        let temporary = builder.prefix(".flotilla-").suffix(".tmp").tempfile_in(file::folder(path));
        let temporary = temporary.map_err(without_path)?;
        let mut output = BufWriter::with_capacity(1 << 20, temporary.as_file());
        content(&mut output)?;
        output.into_inner().map_err(|error| error.into_error())?.sync_all()?;
        self.pass(Operation::Rename, path)?;
        temporary.persist(path).map_err(|error| error.error)?;
        self.sync_folder(file::folder(path))
    }

    /// Renames within a folder, for good.
    ///
    /// # Errors
    /// What the system says.
    pub fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.pass(Operation::Rename, to)?;
        fs::rename(from, to)?;
        self.sync_folder(file::folder(to))
    }

    /// Removes a file, if it is there.
    ///
    /// # Errors
    /// What the system says.
    pub fn remove(&self, path: &Path) -> io::Result<()> {
        if fs::symlink_metadata(path).is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
            return Ok(());
        }
        self.pass(Operation::Remove, path)?;
        fs::remove_file(path)
    }

    /// Makes the names in a folder last, where the system can.
    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.pass(Operation::Flush, path)?;
        #[cfg(unix)]
        match File::open(path)?.sync_all() {
            // Some network file systems cannot.
            Err(error) if !matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => {
                return Err(error);
            }
            _ => {}
        }
        Ok(())
    }
}

/// An error of a temporary file without its path, which is nobody's business.
pub fn without_path(error: io::Error) -> io::Error {
    if error.get_ref().is_some() { error.kind().into() } else { error }
}

/// Where a file's next content is written until it is whole.
pub fn temporary(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".tmp");
    name.into()
}

/// A file being written.
pub struct Output {
    disk: Disk,
    path: PathBuf,
    file: File,
}

impl Output {
    /// Waits until all that was written is on the disk.
    ///
    /// # Errors
    /// What the system says.
    pub fn sync(&self) -> io::Result<()> {
        self.disk.pass(Operation::Flush, &self.path)?;
        self.file.sync_all()
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The same file, to flush it from another thread.
    ///
    /// # Errors
    /// What the system says.
    pub fn share(&self) -> io::Result<Output> {
        Ok(Output { disk: self.disk.clone(), path: self.path.clone(), file: self.file.try_clone()? })
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Err(error) = self.disk.pass(Operation::Write, &self.path) {
            self.file.write_all(&bytes[..bytes.len() / 2])?;
            return Err(error);
        }
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
