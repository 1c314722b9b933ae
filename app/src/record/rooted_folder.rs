//! Access to a folder and the entries below it, name by name from an open handle, so that no symbolic link is followed.
//!
//! Only the path to the folder itself may contain links, because the user gave that path. Systems other than Unix have
//! no such handles, so every name is checked before it is used.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::{Component, Path, PathBuf};

/// A folder that is kept open.
pub struct RootedFolder {
    path: PathBuf,
    handle: Handle,
}

/// Type of the entry at a path. Links are not followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// A plain file.
    File,
    Folder,
    /// A symbolic link, whatever its target.
    Link,
    /// A pipe, a socket or a device.
    Other,
}

/// A name in an open folder. No file needs to exist under that name.
pub(crate) struct FolderEntry {
    parent: Handle,
    #[cfg_attr(not(unix), allow(dead_code, reason = "systems without handles use the path"))]
    name: OsString,
    path: PathBuf,
}

impl RootedFolder {
    /// Opens a folder. Links in its path are followed.
    pub fn open(path: &Path) -> io::Result<RootedFolder> {
        Ok(RootedFolder { path: path.into(), handle: system::open(path)? })
    }

    /// Returns the path of the folder as it was given.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the entry of a path, which must begin with the path of this folder. Fails if a folder on the way is a link
    /// or is missing.
    pub(crate) fn entry(&self, path: &Path) -> io::Result<FolderEntry> {
        self.walk(path, |_| Ok(()))
    }

    /// Creates a folder and its missing parents, starting from this folder.
    pub(crate) fn create_folder(&self, path: &Path) -> io::Result<()> {
        let create = |folder: &FolderEntry| match system::create_folder(folder) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => Err(error),
            _ => Ok(()),
        };
        self.walk(&path.join("x"), create).map(drop)
    }

    /// Returns the entry of a path. Calls `prepare` with every folder on the way before it is opened.
    fn walk(&self, path: &Path, prepare: impl Fn(&FolderEntry) -> io::Result<()>) -> io::Result<FolderEntry> {
        let (folders, name) = self.names(path)?;
        let mut parent = system::copy(&self.handle)?;
        let mut at = self.path.clone();
        for folder in folders {
            at.push(folder);
            let folder = FolderEntry { parent, name: folder.into(), path: at.clone() };
            prepare(&folder)?;
            parent = system::step(&folder)?;
        }
        Ok(FolderEntry { parent, name: name.into(), path: path.into() })
    }

    /// Returns the names in a folder, which is this one or below it.
    pub(crate) fn list(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        system::list(&self.entry(&folder.join("x"))?, folder)
    }

    /// Splits a path below this folder into the folders on the way and the last name.
    fn names<'a>(&self, path: &'a Path) -> io::Result<(Vec<&'a OsStr>, &'a OsStr)> {
        let elsewhere = || {
            let text = format!("it is outside {}, and this is written only inside", self.path.display());
            io::Error::new(ErrorKind::InvalidInput, text)
        };
        let here = self.path == Path::new(".") && path.is_relative();
        let below = path.strip_prefix(&self.path).or(if here { Ok(path) } else { Err(()) });
        let below = below.map_err(|()| elsewhere())?;
        let name = |part| if let Component::Normal(name) = part { Some(name) } else { None };
        let mut names: Vec<&OsStr> = below.components().map(name).collect::<Option<_>>().ok_or_else(elsewhere)?;
        let last = names.pop().ok_or_else(elsewhere)?;
        Ok((names, last))
    }
}

/// The way in which a file is opened.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum OpenAs {
    /// An existing file, for reading.
    Read,
    /// An existing file, for writing. Its content is kept.
    Write,
    /// A file for appending, which is created if it is missing.
    Append,
    /// A file that must not exist yet.
    New,
}

impl FolderEntry {
    /// Fails if the entry exists and is not a plain file.
    fn only_file(&self) -> io::Result<()> {
        match self.kind()? {
            None | Some(FileKind::File) => Ok(()),
            Some(FileKind::Link) => Err(is_link(&self.path)),
            Some(FileKind::Folder) => Err(io::Error::new(ErrorKind::IsADirectory, "it is a folder, not a file")),
            Some(FileKind::Other) => {
                Err(io::Error::new(ErrorKind::InvalidInput, "it is a pipe or a device, not a file"))
            }
        }
    }

    /// Opens a plain file. Fails for a link and for anything else that is not a plain file.
    pub(crate) fn open(&self, how: OpenAs) -> io::Result<File> {
        if how != OpenAs::New {
            self.only_file()?;
        }
        system::open_file(self, how)
    }

    /// Removes a plain file.
    pub fn remove(&self) -> io::Result<()> {
        self.only_file()?;
        system::remove(self)
    }

    /// Renames a file and replaces any plain file that has the new name.
    pub(crate) fn rename(&self, to: &FolderEntry) -> io::Result<()> {
        to.only_file()?;
        system::rename(self, to)
    }

    /// Flushes the names in the parent folder to the disk, if the system can.
    pub(crate) fn sync_folder(&self) -> io::Result<()> {
        match system::sync(&self.parent) {
            // Some network file systems cannot flush a folder.
            Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
            synced => synced,
        }
    }
}

/// Returns the error for writing through a link.
pub(crate) fn is_link(path: &Path) -> io::Error {
    let text =
        format!("{} is a symbolic link, and nothing is written through one here; remove the link", path.display());
    io::Error::new(ErrorKind::InvalidInput, text)
}

/// Returns the error for an entry that should be a folder, or `error` if it is one or is missing.
fn not_a_folder(entry: &FolderEntry, error: io::Error) -> io::Error {
    match entry.kind().ok().flatten() {
        Some(FileKind::Link) => is_link(&entry.path),
        Some(FileKind::File | FileKind::Other) => is_file_on_the_way(ErrorKind::NotADirectory),
        Some(FileKind::Folder) | None => error,
    }
}

/// Returns the error for a file in the path of a folder.
pub(crate) fn is_file_on_the_way(kind: ErrorKind) -> io::Error {
    io::Error::new(kind, "a part of this path is a file, not a folder; choose another path")
}

/// An open folder. Empty on systems without such handles.
struct Handle(#[cfg(unix)] std::os::fd::OwnedFd);

#[cfg(unix)]
mod system {
    use std::ffi::{OsStr, OsString};
    use std::fs::File;
    use std::io::{self, ErrorKind};
    use std::os::unix::ffi::OsStrExt;
    use std::path::Path;

    use rustix::fs::{self, AtFlags, FileType, Mode, OFlags};

    use super::{FileKind, FolderEntry, Handle, OpenAs, RootedFolder, not_a_folder};

    const FOLDER: OFlags = OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC);
    /// `NONBLOCK` prevents a hang if a pipe replaces a file between the check and the open.
    const FILE: OFlags = OFlags::NOFOLLOW.union(OFlags::CLOEXEC).union(OFlags::NONBLOCK);
    /// Usual permissions of new files and folders, reduced by the user's umask.
    const FILE_MODE: Mode = Mode::from_bits_truncate(0o666);
    const FOLDER_MODE: Mode = Mode::from_bits_truncate(0o777);

    pub fn open(path: &Path) -> io::Result<Handle> {
        Ok(Handle(fs::open(path, FOLDER, Mode::empty())?))
    }

    pub fn copy(handle: &Handle) -> io::Result<Handle> {
        Ok(Handle(handle.0.try_clone()?))
    }

    impl RootedFolder {
        /// Reports whether the path no longer leads to the folder. Always false on systems without handles.
        pub fn has_moved(&self) -> bool {
            let id = |found: fs::Stat| (found.st_dev, found.st_ino);
            let differs = |own| fs::stat(&self.path).map_or(true, |there| id(there) != id(own));
            fs::fstat(&self.handle.0).is_ok_and(differs)
        }

        /// Returns the user ids `[owner, current user]`, or `None` on systems without user ids.
        pub fn owners(&self) -> io::Result<Option<[u32; 2]>> {
            Ok(Some([fs::fstat(&self.handle.0)?.st_uid, rustix::process::geteuid().as_raw()]))
        }
    }

    pub(crate) fn step(entry: &FolderEntry) -> io::Result<Handle> {
        let opened = fs::openat(&entry.parent.0, &entry.name, FOLDER | OFlags::NOFOLLOW, Mode::empty());
        opened.map(Handle).map_err(|error| not_a_folder(entry, error.into()))
    }

    pub(crate) fn create_folder(entry: &FolderEntry) -> io::Result<()> {
        Ok(fs::mkdirat(&entry.parent.0, &entry.name, FOLDER_MODE)?)
    }

    impl FolderEntry {
        /// Returns the type of the entry, or `None` if it does not exist.
        pub fn kind(&self) -> io::Result<Option<FileKind>> {
            Ok(self.stat()?.map(|there| match FileType::from_raw_mode(there.st_mode) {
                FileType::RegularFile => FileKind::File,
                FileType::Directory => FileKind::Folder,
                FileType::Symlink => FileKind::Link,
                _ => FileKind::Other,
            }))
        }

        /// Returns the number of names of an open file, or 0 if it does not have this one, because another file
        /// replaced it.
        pub(crate) fn links(&self, file: &File) -> io::Result<u64> {
            let (open, there) = (fs::fstat(file)?, self.stat()?);
            let same = there.is_some_and(|there| (open.st_dev, open.st_ino) == (there.st_dev, there.st_ino));
            #[allow(clippy::unnecessary_cast, reason = "the type depends on the system")]
            Ok(if same { open.st_nlink as u64 } else { 0 })
        }

        fn stat(&self) -> io::Result<Option<fs::Stat>> {
            match fs::statat(&self.parent.0, &self.name, AtFlags::SYMLINK_NOFOLLOW).map_err(io::Error::from) {
                Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
                there => there.map(Some),
            }
        }
    }

    #[cfg(target_os = "linux")]
    impl FolderEntry {
        /// Creates a file without a name in the entry's folder. It disappears with its process, unless
        /// [`FolderEntry::link`] names it. Returns `None` if the system cannot do this.
        pub(crate) fn create_unnamed(&self) -> Option<File> {
            let flags = OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC;
            let file = File::from(fs::openat(&self.parent.0, c".", flags, FILE_MODE).ok()?);
            // Naming it needs /proc.
            Path::new(&path_of(&file)).exists().then_some(file)
        }

        /// Gives a file of [`FolderEntry::create_unnamed`] this name. Fails if the name is taken.
        pub(crate) fn link(&self, file: &File) -> io::Result<()> {
            Ok(fs::linkat(fs::CWD, path_of(file), &self.parent.0, &self.name, AtFlags::SYMLINK_FOLLOW)?)
        }
    }

    pub(crate) fn open_file(entry: &FolderEntry, how: OpenAs) -> io::Result<File> {
        let flags = match how {
            OpenAs::Read => OFlags::RDONLY,
            OpenAs::Write => OFlags::WRONLY,
            OpenAs::Append => OFlags::WRONLY | OFlags::CREATE | OFlags::APPEND,
            OpenAs::New => OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL,
        };
        Ok(fs::openat(&entry.parent.0, &entry.name, FILE | flags, FILE_MODE)?.into())
    }

    #[cfg(target_os = "linux")]
    fn path_of(file: &File) -> String {
        format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(file))
    }

    pub(crate) fn remove(entry: &FolderEntry) -> io::Result<()> {
        Ok(fs::unlinkat(&entry.parent.0, &entry.name, AtFlags::empty())?)
    }

    pub(crate) fn rename(from: &FolderEntry, to: &FolderEntry) -> io::Result<()> {
        Ok(fs::renameat(&from.parent.0, &from.name, &to.parent.0, &to.name)?)
    }

    pub fn sync(handle: &Handle) -> io::Result<()> {
        Ok(fs::fsync(&handle.0)?)
    }

    pub(crate) fn list(entry: &FolderEntry, _: &Path) -> io::Result<Vec<OsString>> {
        let name =
            |entry: rustix::io::Result<fs::DirEntry>| Ok(OsStr::from_bytes(entry?.file_name().to_bytes()).into());
        let names = fs::Dir::read_from(&entry.parent.0)?.map(name).collect::<io::Result<Vec<OsString>>>()?;
        Ok(names.into_iter().filter(|name| name != "." && name != "..").collect())
    }
}

#[cfg(not(target_os = "linux"))]
impl FolderEntry {
    pub(crate) fn create_unnamed(&self) -> Option<File> {
        None
    }

    pub(crate) fn link(&self, _: &File) -> io::Result<()> {
        Err(ErrorKind::Unsupported.into())
    }
}

#[cfg(not(unix))]
mod system {
    use std::ffi::OsString;
    use std::fs::{self, File, OpenOptions};
    use std::io::{self, ErrorKind};
    use std::path::Path;

    use super::{FileKind, FolderEntry, Handle, OpenAs, RootedFolder, not_a_folder};

    pub fn open(path: &Path) -> io::Result<Handle> {
        match fs::metadata(path)?.is_dir() {
            true => Ok(Handle()),
            false => Err(ErrorKind::NotADirectory.into()),
        }
    }

    pub fn copy(_: &Handle) -> io::Result<Handle> {
        Ok(Handle())
    }

    impl RootedFolder {
        pub fn has_moved(&self) -> bool {
            false
        }

        pub fn owners(&self) -> io::Result<Option<[u32; 2]>> {
            Ok(None)
        }
    }

    pub(crate) fn step(entry: &FolderEntry) -> io::Result<Handle> {
        match entry.kind()? {
            Some(FileKind::Folder) => Ok(Handle()),
            _ => Err(not_a_folder(entry, ErrorKind::NotFound.into())),
        }
    }

    pub(crate) fn create_folder(entry: &FolderEntry) -> io::Result<()> {
        fs::create_dir(&entry.path)
    }

    impl FolderEntry {
        pub fn kind(&self) -> io::Result<Option<FileKind>> {
            match fs::symlink_metadata(&self.path) {
                Ok(there) if there.is_symlink() => Ok(Some(FileKind::Link)),
                Ok(there) if there.is_dir() => Ok(Some(FileKind::Folder)),
                Ok(there) if there.is_file() => Ok(Some(FileKind::File)),
                Ok(_) => Ok(Some(FileKind::Other)),
                Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
                Err(error) => Err(error),
            }
        }

        pub(crate) fn links(&self, _: &File) -> io::Result<u64> {
            Ok(1)
        }
    }

    pub(crate) fn open_file(entry: &FolderEntry, how: OpenAs) -> io::Result<File> {
        let mut options = OpenOptions::new();
        match how {
            OpenAs::Read => options.read(true),
            OpenAs::Write => options.write(true),
            OpenAs::Append => options.append(true).create(true),
            OpenAs::New => options.write(true).create_new(true),
        };
        options.open(&entry.path)
    }

    pub(crate) fn remove(entry: &FolderEntry) -> io::Result<()> {
        fs::remove_file(&entry.path)
    }

    pub(crate) fn rename(from: &FolderEntry, to: &FolderEntry) -> io::Result<()> {
        fs::rename(&from.path, &to.path)
    }

    pub fn sync(_: &Handle) -> io::Result<()> {
        Ok(())
    }

    pub(crate) fn list(_: &FolderEntry, path: &Path) -> io::Result<Vec<OsString>> {
        fs::read_dir(path)?.map(|entry| Ok(entry?.file_name())).collect()
    }
}
