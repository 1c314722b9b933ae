//! Reads configs from files and standard input.

use std::io::{self, ErrorKind, Read};
use std::path::Path;

use super::{Config, ConfigError};
use crate::escape::PathExt;
use crate::file;

/// Maximum size of a config file, in bytes.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 20;

impl Config {
    /// Reads a config file.
    ///
    /// # Errors
    /// Fails if the file cannot be read or its config is invalid. The error lists all problems.
    pub fn load(path: &Path) -> Result<Config, ConfigError> {
        Config::parse(&read_file(path)?, &name(path))
    }
}

/// Reports whether a path is `-`, which means standard input.
pub fn is_standard_input(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Returns the name of a config or sweep file in errors.
pub fn name(path: &Path) -> String {
    if is_standard_input(path) { "standard input".into() } else { path.escaped() }
}

/// Reads the text of a config or sweep file, or of standard input if the path is `-`.
///
/// # Errors
/// Fails if the file cannot be read, is a folder, is larger than [`MAX_FILE_BYTES`] or is not UTF-8.
pub fn read_file(path: &Path) -> Result<String, ConfigError> {
    let name = name(path);
    if is_standard_input(path) {
        read_text(Ok(std::io::stdin()), &name)
    } else if path.is_dir() {
        let reason = "it is a directory; name a config file in it".into();
        Err(ConfigError::Unreadable { name, reason, is_missing: false })
    } else {
        read_text(file::open(path), &name)
    }
}

/// Reads the text of an open file as [`read_file`] does.
///
/// # Errors
/// See [`read_file`].
pub fn read_text(file: io::Result<impl Read>, name: &str) -> Result<String, ConfigError> {
    let unreadable = |reason: String, is_missing| ConfigError::Unreadable { name: name.into(), reason, is_missing };
    let file = file.map_err(|error| unreadable(error.to_string(), error.kind() == ErrorKind::NotFound))?;
    file::text(file, MAX_FILE_BYTES).map_err(|error| unreadable(error.to_string(), false))
}
