//! Everything that is written goes through here: a file is replaced whole or not at all, and tests can make any
//! single operation fail.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use super::beneath::{FileKind, FolderEntry, Root};
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

/// The file system, or a test's failing one, as a whole or within one folder.
#[derive(Clone, Default)]
pub struct Disk {
    gate: Option<Arc<Gate>>,
    root: Option<Arc<Root>>,
}

impl Disk {
    /// A disk whose operations fail when `gate` says so. A write that fails has written the first half.
    pub fn failing(gate: impl Fn(Operation, &Path) -> io::Result<()> + Send + Sync + 'static) -> Disk {
        Disk { gate: Some(Arc::new(gate)), root: None }
    }

    /// The same disk within a folder, which must exist: below it no symbolic link is followed, and nothing outside of it
    /// is written. Links on the way to the folder are followed, unless the disk is within a folder above it already.
    ///
    /// # Errors
    /// The folder cannot be opened, or is a link in a folder that the disk is within.
    pub fn within(&self, folder: &Path) -> io::Result<Disk> {
        if let Some(root) = &self.root {
            // One handle for all folders of a sweep: a process may have few.
            root.entry(&folder.join("x"))?;
            return Ok(self.clone());
        }
        Ok(Disk { gate: self.gate.clone(), root: Some(Arc::new(Root::open(folder)?)) })
    }

    /// The folder that the disk is within, if it is.
    pub(super) fn root(&self) -> Option<&Root> {
        self.root.as_deref()
    }

    fn pass(&self, operation: Operation, path: &Path) -> io::Result<()> {
        self.gate.as_ref().map_or(Ok(()), |gate| gate(operation, path))
    }

    /// A path's entry: below the disk's folder, or in whatever folder the path names.
    pub(super) fn entry(&self, path: &Path) -> io::Result<FolderEntry> {
        match &self.root {
            Some(root) => root.entry(path),
            None => {
                let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
                let root = Root::open(file::folder(path))?;
                root.entry(&root.path().join(name))
            }
        }
    }

    /// What has a path's name, if anything; a link is not followed.
    ///
    /// # Errors
    /// What the system says.
    pub fn kind(&self, path: &Path) -> io::Result<Option<FileKind>> {
        match self.entry(path) {
            Ok(entry) => entry.kind(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Creates a folder and those above it.
    ///
    /// # Errors
    /// What the system says.
    pub fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.pass(Operation::CreateFolder, path)?;
        if let Some(root) = &self.root {
            return root.create_folder(path);
        }
        fs::create_dir_all(path).map_err(|error| match error.kind() {
            kind @ (io::ErrorKind::AlreadyExists | io::ErrorKind::NotADirectory) => {
                io::Error::new(kind, "a file stands where a folder is needed; choose another name")
            }
            _ => error,
        })
    }

    /// A new file in the place of any other; a link that stands there is refused.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(&self, path: &Path) -> io::Result<Output> {
        self.remove(path)?;
        self.create_new(path)
    }

    /// A new file, where nothing is yet.
    ///
    /// # Errors
    /// What the system says.
    pub fn create_new(&self, path: &Path) -> io::Result<Output> {
        self.pass(Operation::Create, path)?;
        let file = self.entry(path)?.create_new()?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// The file as it is up to `length` bytes, to be written on from there; a link to another file is refused.
    ///
    /// # Errors
    /// What the system says.
    pub fn append(&self, path: &Path, length: u64) -> io::Result<Output> {
        let mut file = self.entry(path)?.write()?;
        self.pass(Operation::Truncate, path)?;
        file.set_len(length)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// Adds bytes to the end of a file, which is created if it is not there; gives the file, to bring it to the disk.
    ///
    /// # Errors
    /// What the system says.
    pub fn extend(&self, path: &Path, bytes: &[u8]) -> io::Result<Output> {
        self.pass(Operation::Create, path)?;
        let file = self.entry(path)?.extend()?;
        let mut output = Output { disk: self.clone(), path: path.into(), file };
        output.write_all(bytes)?;
        Ok(output)
    }

    /// Gives a file new content: after a crash at any moment it has either all of the old or all of the new. Only one
    /// process at a time may do so.
    ///
    /// # Errors
    /// What the system says.
    pub fn replace(&self, path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        // What a process left that was killed is in the way of none.
        let open = |temporary: &Path| self.create(temporary);
        self.replace_by(path, temporary(path), open, content, || Ok(()))
    }

    /// [`Disk::replace`] where others may do so at the same moment; `before` is called once the new content is on the
    /// disk, before it gets its name.
    ///
    /// # Errors
    /// What the system or `before` says.
    pub fn replace_shared(
        &self,
        path: &Path,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        before: impl FnOnce() -> io::Result<()>,
    ) -> io::Result<()> {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let mut taken = None;
        for _ in 0..1000 {
            let number = NEXT.fetch_add(1, Relaxed);
            let temporary = path.with_file_name(format!("{PREFIX}{}-{number}-{name}.tmp", std::process::id()));
            match self.create_new(&temporary) {
                // Another machine may have a process of the same number.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
                Err(error) => return Err(error),
                Ok(output) => taken = Some((temporary, output)),
            }
            break;
        }
        let (temporary, output) = taken.ok_or(io::ErrorKind::AlreadyExists)?;
        self.replace_by(path, temporary, |_| Ok(output), content, before)
    }

    fn replace_by(
        &self,
        path: &Path,
        temporary: PathBuf,
        open: impl FnOnce(&Path) -> io::Result<Output>,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        before: impl FnOnce() -> io::Result<()>,
    ) -> io::Result<()> {
        let write = || {
            let mut output = BufWriter::with_capacity(1 << 20, open(&temporary)?);
            content(&mut output)?;
            output.into_inner().map_err(|error| error.into_error())?.sync()?;
            before()?;
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
        let target = self.entry(to)?;
        self.entry(from)?.rename(&target)?;
        self.pass(Operation::Flush, file::folder(to))?;
        target.sync_folder()
    }

    /// Removes a file, if it is there.
    ///
    /// # Errors
    /// It is a link or a folder, or what the system says.
    pub fn remove(&self, path: &Path) -> io::Result<()> {
        if self.kind(path)?.is_none() {
            return Ok(());
        }
        self.pass(Operation::Remove, path)?;
        self.entry(path)?.remove()
    }

    /// Opens a plain file to read it; a link is refused.
    ///
    /// # Errors
    /// What the system says.
    pub fn read(&self, path: &Path) -> io::Result<File> {
        self.entry(path)?.read()
    }

    /// Opens a file that stands for a lock, creating it if it is not there.
    ///
    /// # Errors
    /// It is a link or a folder, or what the system says.
    pub fn open_lock(&self, path: &Path) -> io::Result<File> {
        self.entry(path)?.extend()
    }

    /// Makes the names in a folder last, where the system can.
    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.pass(Operation::Flush, path)?;
        Root::open(path)?.entry(&path.join("x"))?.sync_folder()
    }
}

/// An error of a temporary file without its path, which is nobody's business.
pub fn without_path(error: io::Error) -> io::Error {
    if error.get_ref().is_some() { error.kind().into() } else { error }
}

/// What the names of files begin with that have no content to be kept: only flotilla makes them.
const PREFIX: &str = ".flotilla-";

/// Where a file's next content is written until it is whole.
pub fn temporary(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default();
    let name = [PREFIX.as_ref(), name, ".tmp".as_ref()].into_iter().collect::<std::ffi::OsString>();
    path.with_file_name(name)
}

/// The name of the file whose [`temporary`] a path is, if it is one.
pub fn of_temporary(path: &Path) -> Option<&str> {
    path.file_name()?.to_str()?.strip_prefix(PREFIX)?.strip_suffix(".tmp")
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
