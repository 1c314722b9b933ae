//! Access to the disk for everything that is written. Files are replaced whole or not at all, and tests can make any
//! single operation fail.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, Permissions, TryLockError};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use super::rooted_folder::{FileKind, FolderEntry, OpenAs, RootedFolder, is_file_on_the_way, is_link};
use flotilla::file;

/// Kind of operation on a disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Creates a folder and its missing parents.
    CreateFolder,
    /// Creates a file for writing.
    Create,
    /// Writes some bytes to a file.
    Write,
    /// Flushes a file or a folder to the disk.
    Flush,
    /// Truncates a file to a length.
    Truncate,
    /// Renames a file to its final name.
    Rename,
    /// Removes a file.
    Remove,
}

/// Called before each operation. If it returns an error, the operation fails with that error.
pub(crate) type FaultHook = dyn Fn(Operation, &Path) -> io::Result<()> + Send + Sync;

/// The file system, optionally limited to one folder. Tests can add a hook that makes operations fail.
#[derive(Clone, Default)]
pub struct Disk {
    fault_hook: Option<Arc<FaultHook>>,
    root: Option<Arc<RootedFolder>>,
}

/// A file or a folder to read: at any path, or in the folder that a disk is limited to.
///
/// The files of a run that is being written are read in the second way, because the path of its folder may lead to
/// another folder by now.
#[derive(Clone, Copy)]
pub struct Place<'a> {
    disk: Option<&'a Disk>,
    path: &'a Path,
}

impl<'a, P: AsRef<Path> + ?Sized> From<&'a P> for Place<'a> {
    fn from(path: &'a P) -> Place<'a> {
        Place { disk: None, path: path.as_ref() }
    }
}

impl<'a> Place<'a> {
    pub fn path(&self) -> &'a Path {
        self.path
    }

    /// Returns another place, which is reached in the same way.
    pub(crate) fn at<'b>(&self, path: &'b Path) -> Place<'b>
    where
        'a: 'b,
    {
        Place { disk: self.disk, path }
    }

    /// Opens a plain file for reading.
    ///
    /// # Errors
    /// Returns the system's error. Also fails for a link in a disk's folder.
    pub fn open(&self) -> io::Result<File> {
        self.disk.map_or_else(|| file::open(self.path), |disk| disk.read(self.path))
    }

    /// Reports whether the file or folder exists.
    pub fn exists(&self) -> io::Result<bool> {
        match self.disk.map_or_else(|| file::exists(self.path), |disk| Ok(disk.kind(self.path)?.is_some())) {
            // A path below a file cannot exist.
            Err(error) if error.kind() == io::ErrorKind::NotADirectory => Ok(false),
            exists => exists,
        }
    }

    /// Returns the names in the folder.
    pub(crate) fn list(&self) -> io::Result<Vec<OsString>> {
        match self.disk.and_then(Disk::root) {
            Some(root) => root.list(self.path),
            None => fs::read_dir(self.path)?.map(|entry| Ok(entry?.file_name())).collect(),
        }
    }
}

impl Disk {
    /// Returns a disk whose operations fail if `fault_hook` returns an error. A failed write still writes the first half
    /// of its bytes.
    pub fn failing(fault_hook: impl Fn(Operation, &Path) -> io::Result<()> + Send + Sync + 'static) -> Disk {
        Disk { fault_hook: Some(Arc::new(fault_hook)), root: None }
    }

    /// Returns the same disk limited to a folder, which must exist. No symbolic link below the folder is followed, and
    /// nothing outside of it is written.
    ///
    /// Links in the path of the folder are followed. A disk that is already limited to a parent folder keeps that
    /// limit. In that case, the path is only checked for links.
    ///
    /// # Errors
    /// The folder cannot be opened, or the disk is limited to a parent folder and the path contains a link.
    pub fn within(&self, folder: &Path) -> io::Result<Disk> {
        if let Some(root) = &self.root {
            // All folders of a sweep share one handle, because the number of open files per process is limited.
            root.entry(&folder.join("x"))?;
            return Ok(self.clone());
        }
        Ok(Disk { fault_hook: self.fault_hook.clone(), root: Some(Arc::new(RootedFolder::open(folder)?)) })
    }

    /// Returns the folder that the disk is limited to, if any.
    pub(super) fn root(&self) -> Option<&RootedFolder> {
        self.root.as_deref()
    }

    /// Reports whether the path of the folder that the disk is limited to no longer leads there.
    pub fn has_moved(&self) -> bool {
        self.root().is_some_and(RootedFolder::has_moved)
    }

    pub fn at<'a>(&'a self, path: &'a Path) -> Place<'a> {
        Place { disk: Some(self).filter(|disk| disk.root.is_some()), path }
    }

    fn check(&self, operation: Operation, path: &Path) -> io::Result<()> {
        self.fault_hook.as_ref().map_or(Ok(()), |fault_hook| fault_hook(operation, path))
    }

    /// Returns the entry of a path. Without a root folder, the path may be in any folder.
    pub(super) fn entry(&self, path: &Path) -> io::Result<FolderEntry> {
        match &self.root {
            Some(root) => root.entry(path),
            None => {
                let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
                let root = RootedFolder::open(file::folder(path))?;
                root.entry(&root.path().join(name))
            }
        }
    }

    /// Returns the type of the entry at a path, or `None` if there is none. Links are not followed.
    pub fn kind(&self, path: &Path) -> io::Result<Option<FileKind>> {
        match self.entry(path) {
            Ok(entry) => entry.kind(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Fails if the entry at a path is a link.
    pub(crate) fn refuse_link(&self, path: &Path) -> io::Result<()> {
        if self.kind(path)? == Some(FileKind::Link) { Err(is_link(path)) } else { Ok(()) }
    }

    /// Creates a folder and its missing parents.
    pub fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.check(Operation::CreateFolder, path)?;
        if let Some(root) = &self.root {
            return root.create_folder(path);
        }
        fs::create_dir_all(path).map_err(|error| match error.kind() {
            kind @ (io::ErrorKind::AlreadyExists | io::ErrorKind::NotADirectory) => is_file_on_the_way(kind),
            _ => error,
        })
    }

    /// Creates a file and replaces any plain file at its path. A link is an error.
    pub fn create(&self, path: &Path) -> io::Result<Output> {
        self.remove(path)?;
        self.create_new(path)
    }

    /// Creates a file. Fails if the name is taken.
    pub(crate) fn create_new(&self, path: &Path) -> io::Result<Output> {
        self.check(Operation::Create, path)?;
        let file = self.entry(path)?.open(OpenAs::New)?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// Opens an existing file, truncates it to `length` bytes and continues writing from there. A link is an error.
    pub fn append(&self, path: &Path, length: u64) -> io::Result<Output> {
        let mut file = self.unshared(path, OpenAs::Write)?;
        self.check(Operation::Truncate, path)?;
        file.set_len(length)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Output { disk: self.clone(), path: path.into(), file })
    }

    /// Appends bytes to a file, which is created if it is missing. Returns the file, so that the caller can flush it.
    pub fn extend(&self, path: &Path, bytes: &[u8]) -> io::Result<Output> {
        self.check(Operation::Create, path)?;
        let file = self.unshared(path, OpenAs::Append)?;
        let mut output = Output { disk: self.clone(), path: path.into(), file };
        output.write_all(bytes)?;
        Ok(output)
    }

    /// Opens a file to change it. A file with other names is copied first, because a backup may consist of hard links.
    fn unshared(&self, path: &Path, how: OpenAs) -> io::Result<File> {
        let entry = self.entry(path)?;
        let file = entry.open(how)?;
        if entry.links(&file)? <= 1 {
            return Ok(file);
        }
        let mut content = self.read(path)?;
        self.replace_shared(path, |output| io::copy(&mut content, output).map(drop))?;
        self.entry(path)?.open(how)
    }

    /// Replaces the content of a file. After a crash at any moment, the file has either all of the old content or all
    /// of the new. The new content is certain after [`Disk::sync_folder`], which is called once for all files of a
    /// folder. Only one process at a time may replace a file.
    pub fn replace(&self, path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        // A killed process may have left a temporary file, which is replaced.
        let open = |temporary: &Path| self.create(temporary);
        self.replace_by(path, temporary(path), open, content, || Ok(()))
    }

    /// Replaces a file like [`Disk::replace`], but several processes may do so at the same time.
    ///
    /// On Linux the new content has no name until it is complete, so that nothing is left of an interrupted process.
    pub(crate) fn replace_shared(
        &self,
        path: &Path,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> io::Result<()> {
        self.replace_with(path, None, content, || Ok(()))
    }

    /// Replaces a file like [`Disk::replace_shared`]. `permissions` replaces those that new files have. `before` is
    /// called after the new content is on the disk and before the file gets its name.
    pub(crate) fn replace_with(
        &self,
        path: &Path,
        permissions: Option<Permissions>,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        before: impl FnOnce() -> io::Result<()>,
    ) -> io::Result<()> {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        for _ in 0..1000 {
            let number = NEXT.fetch_add(1, Relaxed);
            let temporary = path.with_file_name(format!("{PREFIX}{}-{number}.tmp", std::process::id()));
            // A process on another machine may have the same id.
            if self.kind(&temporary)?.is_some() {
                continue;
            }
            let entry = self.entry(&temporary)?;
            let unnamed = entry.create_unnamed();
            let is_unnamed = unnamed.is_some();
            let output = match unnamed {
                Some(file) => {
                    self.check(Operation::Create, &temporary)?;
                    Output { disk: self.clone(), path: temporary.clone(), file }
                }
                None => match self.create_new(&temporary) {
                    Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
                    created => created?,
                },
            };
            if let Some(permissions) = permissions {
                output.file.set_permissions(permissions)?;
            }
            let file = output.share()?.file;
            let name = || {
                before()?;
                if is_unnamed { entry.link(&file) } else { Ok(()) }
            };
            return self.replace_by(path, temporary, |_| Ok(output), content, name);
        }
        Err(io::ErrorKind::AlreadyExists.into())
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
            // The first error is the one to report, so a failed removal is ignored.
            let _ = self.remove(&temporary);
        })
    }

    /// Writes a file that the user named, whole or not at all. A link to a file is followed, except on a disk that is
    /// limited to a folder. A device or a pipe, such as `/dev/stdout`, is written to directly.
    pub(crate) fn write_user_file(
        &self,
        path: &Path,
        content: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> io::Result<()> {
        if self.root.is_some() && self.kind(path)? != Some(FileKind::Other) {
            if self.kind(path)?.is_some() {
                // A link must not be replaced, nor a file without write permission.
                self.entry(path)?.open(OpenAs::Write)?;
            }
            return self.replace_shared(path, content);
        }
        let existing = fs::metadata(path);
        if existing.as_ref().is_ok_and(|existing| !existing.is_file() && !existing.is_dir()) {
            let mut output = BufWriter::new(OpenOptions::new().write(true).open(path)?);
            content(&mut output)?;
            return output.flush();
        }
        if existing.is_ok() {
            // A file without write permission must not be replaced.
            OpenOptions::new().write(true).open(path)?;
        }
        let path = &file::resolved(path);
        if !file::folder(path).is_dir() {
            return Err(file::no_folder(path));
        }
        let permissions = existing.ok().filter(|_| cfg!(unix)).map(|existing| existing.permissions());
        self.replace_with(path, permissions, content, || Ok(()))
    }

    pub(crate) fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.check(Operation::Rename, to)?;
        self.entry(from)?.rename(&self.entry(to)?)
    }

    /// Removes a file if it exists.
    pub fn remove(&self, path: &Path) -> io::Result<()> {
        if self.kind(path)?.is_none() {
            return Ok(());
        }
        self.check(Operation::Remove, path)?;
        self.entry(path)?.remove()
    }

    /// Opens a plain file for reading. A link is an error.
    pub fn read(&self, path: &Path) -> io::Result<File> {
        self.entry(path)?.open(OpenAs::Read)
    }

    /// Opens and locks a file, which is created if it is missing. The lock lasts while the file is open. Returns `None` if
    /// the file system has no locks.
    ///
    /// # Errors
    /// Another process holds the lock (`WouldBlock`), the entry is not a plain file, or the system returns an error.
    pub(crate) fn lock(&self, path: &Path) -> io::Result<Option<File>> {
        self.check(Operation::Create, path)?;
        for attempt in 0.. {
            let file = self.entry(path)?.open(OpenAs::Append)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(io::ErrorKind::WouldBlock.into()),
                Err(TryLockError::Error(error)) if has_no_locks(&error) => return Ok(None),
                Err(TryLockError::Error(error)) => return Err(error),
            }
            match self.entry(path)?.links(&file)? {
                1 => return Ok(Some(file)),
                // Another process replaced the file before it was locked here. Some file systems number files anew.
                0 if attempt < 100 => {}
                0 => return Ok(Some(file)),
                // The file is also the lock of a copy that was made with hard links. While it is locked, no process
                // uses it.
                _ => match self.create(path) {
                    Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
                    _ => {}
                },
            }
        }
        unreachable!("there are more numbers than attempts")
    }

    /// Flushes the names in a folder to the disk, if the system can.
    pub fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.check(Operation::Flush, path)?;
        self.entry(&path.join("x"))?.sync_folder()
    }
}

/// Reports whether the file system does not support locks. NFS without its lock service returns `ENOLCK`.
fn has_no_locks(error: &io::Error) -> bool {
    const ENOLCK: i32 = if cfg!(target_os = "linux") { 37 } else { 77 };
    error.kind() == io::ErrorKind::Unsupported || cfg!(unix) && error.raw_os_error() == Some(ENOLCK)
}

/// Removes the path of a temporary file from an error, because the user does not know that file.
pub(crate) fn without_path(error: io::Error) -> io::Error {
    if error.get_ref().is_some() { error.kind().into() } else { error }
}

/// Prefix of the names of temporary files, which only flotilla creates.
const PREFIX: &str = ".flotilla-";

/// Returns the path of the temporary file in which the new content of a file is written.
pub(crate) fn temporary(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default();
    let name = [PREFIX.as_ref(), name, ".tmp".as_ref()].into_iter().collect::<std::ffi::OsString>();
    path.with_file_name(name)
}

/// Returns the name of the file to which a [`temporary`] path belongs, or `None` for other paths.
pub(crate) fn of_temporary(path: &Path) -> Option<&str> {
    path.file_name()?.to_str()?.strip_prefix(PREFIX)?.strip_suffix(".tmp")
}

/// A file that is being written.
pub struct Output {
    disk: Disk,
    path: PathBuf,
    file: File,
}

impl Output {
    /// Waits until all written bytes are on the disk.
    pub fn sync(&self) -> io::Result<()> {
        self.disk.check(Operation::Flush, &self.path)?;
        self.file.sync_all()
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns a second handle of the same file, so that another thread can flush it.
    pub fn share(&self) -> io::Result<Output> {
        Ok(Output { disk: self.disk.clone(), path: self.path.clone(), file: self.file.try_clone()? })
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Err(error) = self.disk.check(Operation::Write, &self.path) {
            self.file.write_all(&bytes[..bytes.len() / 2])?;
            return Err(error);
        }
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
