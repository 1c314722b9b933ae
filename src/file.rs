//! Paths that a user or a folder names: what stands there is looked at before it is opened.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Opens a plain file to read it. Anything else is refused, since opening a pipe that nobody writes to waits for ever;
/// but what whoever started the process had opened for it (`/dev/stdin`, a shell's `<(…)`) is taken.
///
/// # Errors
/// There is no such file, it cannot be opened, or it is no file.
pub fn open(path: &Path) -> io::Result<File> {
    let kind = fs::metadata(path)?;
    if kind.is_dir() {
        return Err(io::Error::new(ErrorKind::IsADirectory, "it is a folder, where a file is needed"));
    }
    let handed_over = ["/dev/stdin", "/dev/fd", "/proc/self/fd"].iter().any(|open| path.starts_with(open));
    if !kind.is_file() && !handed_over {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is a pipe or a device, where a file is needed"));
    }
    File::open(path)
}

/// Why a text could not be read.
#[derive(Debug, thiserror::Error)]
pub enum TextError {
    /// It cannot be read.
    #[error(transparent)]
    Read(#[from] io::Error),
    /// It is larger than so many bytes.
    #[error("it is larger than {0} bytes, the most that such a file may have")]
    TooLarge(u64),
    /// This line, from 1, is not UTF-8.
    #[error("line {0} is not UTF-8 text")]
    NotText(usize),
}

/// A text of `most` bytes at most.
///
/// # Errors
/// It cannot be read, is larger, or is no UTF-8.
pub fn text(file: impl Read, most: u64) -> Result<String, TextError> {
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(TextError::TooLarge(most));
    }
    String::from_utf8(bytes).map_err(|error| {
        let before = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        TextError::NotText(before.iter().filter(|&&byte| byte == b'\n').count() + 1)
    })
}

/// Whether something stands at a path.
///
/// # Errors
/// That cannot be seen, for want of permission as a rule.
pub fn exists(path: &Path) -> io::Result<bool> {
    match path.try_exists() {
        // Below something that is no folder there is nothing.
        Err(error) if error.kind() == ErrorKind::NotADirectory => Ok(false),
        seen => seen,
    }
}

/// The folder that a path's last name is in: the present one of a bare name.
pub fn folder(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Where a path leads, all links followed, whether or not anything is there yet.
pub fn resolved(path: &Path) -> PathBuf {
    let beside = || Some(fs::canonicalize(folder(path)).ok()?.join(path.file_name()?));
    fs::canonicalize(path).ok().or_else(beside).unwrap_or_else(|| path.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bare_name_is_in_the_present_folder() {
        for (path, expected) in [("x.svg", "."), ("./x.svg", "."), ("a/x.svg", "a"), ("/x.svg", "/"), ("..", ".")] {
            assert_eq!(folder(Path::new(path)), Path::new(expected), "{path}");
        }
    }
}
