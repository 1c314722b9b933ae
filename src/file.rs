//! Files that users name. Their kind and size are checked before they are read.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};

use crate::escape::PathExt;

/// Opens a regular file for reading. Opening a pipe without a writer would block, so other kinds are refused, except
/// files that the parent process opened: `/dev/stdin`, or `<(…)` in a shell.
///
/// # Errors
/// The file is missing, cannot be opened, or is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let kind = fs::metadata(path)?;
    if kind.is_dir() {
        return Err(io::Error::new(ErrorKind::IsADirectory, "it is a folder, not a file"));
    }
    let is_inherited = ["/dev/stdin", "/dev/fd", "/proc/self/fd"].iter().any(|prefix| path.starts_with(prefix));
    if !kind.is_file() && !is_inherited {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is a pipe or a device, not a file"));
    }
    File::open(path)
}

/// The reason why a text could not be read.
#[derive(Debug, thiserror::Error)]
pub enum TextError {
    /// Reading failed.
    #[error(transparent)]
    Read(#[from] io::Error),
    /// The text is larger than this many bytes.
    #[error("it is larger than {0} bytes, the maximum for such a file")]
    TooLarge(u64),
    /// The file is a zip file.
    #[error("it is a zip file; unpack it, for example with `unzip`")]
    Zip,
    /// The line with this number, from 1, is not UTF-8.
    #[error("line {0} is not UTF-8 text")]
    NotText(usize),
}

/// Reads a text of up to `max_bytes` bytes.
///
/// # Errors
/// Reading fails, or the text is larger or not UTF-8.
pub fn text(file: impl Read, max_bytes: u64) -> Result<String, TextError> {
    let mut bytes = Vec::new();
    file.take(max_bytes + 1).read_to_end(&mut bytes)?;
    if bytes.starts_with(b"PK\x03\x04") {
        return Err(TextError::Zip);
    }
    if bytes.len() as u64 > max_bytes {
        return Err(TextError::TooLarge(max_bytes));
    }
    String::from_utf8(bytes).map_err(|error| {
        let before = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        TextError::NotText(before.iter().filter(|&&byte| byte == b'\n').count() + 1)
    })
}

/// Returns a file's name without its extension. A name made of dots alone would be the current folder or the one above,
/// so `default` takes its place.
pub fn stem(path: &Path, default: &str) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    if stem.trim_matches('.').is_empty() { default.into() } else { stem.into_owned() }
}

/// Returns whether a path is named like a zip file, such as the runs that the browser page saves.
pub fn is_zip(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"))
}

/// Returns whether a path exists.
///
/// # Errors
/// The system does not tell, for example without permission.
pub fn exists(path: &Path) -> io::Result<bool> {
    match path.try_exists() {
        // A path below a file cannot exist.
        Err(error) if error.kind() == ErrorKind::NotADirectory => Ok(false),
        result => result,
    }
}

/// Returns the error for a file whose folder does not exist.
pub fn no_folder(path: &Path) -> io::Error {
    io::Error::new(ErrorKind::NotFound, format!("the folder {} does not exist; make it first", folder(path).escaped()))
}

/// Returns the folder that contains a path: the current one for a bare name.
pub fn folder(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Returns a path with all links resolved, even if its last component does not exist yet.
pub fn resolved(path: &Path) -> PathBuf {
    let in_folder = || Some(fs::canonicalize(folder(path)).ok()?.join(path.file_name()?));
    fs::canonicalize(path).ok().or_else(in_folder).unwrap_or_else(|| path.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stem_is_never_a_folder() {
        for (path, expected) in [("a/x.toml", "x"), ("...toml", "default"), ("..", "default"), ("....toml", "default")]
        {
            assert_eq!(stem(Path::new(path), "default"), expected, "{path}");
        }
        assert_eq!(stem(Path::new(".toml"), "default"), ".toml");
        assert_eq!(stem(Path::new("..x.toml"), "default"), "..x");
    }

    #[test]
    fn a_bare_name_is_in_the_current_folder() {
        for (path, expected) in [("x.svg", "."), ("./x.svg", "."), ("a/x.svg", "a"), ("/x.svg", "/"), ("..", ".")] {
            assert_eq!(folder(Path::new(path)), Path::new(expected), "{path}");
        }
    }
}
