//! Reads configs from files and standard input.

use std::io::{ErrorKind, Read};
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
    if is_standard_input(path) { "standard input".into() } else { path.escaped().to_string() }
}

/// Reads the text of a config or sweep file, or of standard input if the path is `-`.
///
/// # Errors
/// Fails if the file cannot be read, is a folder, is larger than [`MAX_FILE_BYTES`] or is not UTF-8.
pub fn read_file(path: &Path) -> Result<String, ConfigError> {
    let fail = |reason: String| ConfigError::Unreadable { name: name(path), reason, is_missing: false };
    let missing = |error: std::io::Error| ConfigError::Unreadable {
        name: name(path),
        reason: error.to_string(),
        is_missing: error.kind() == ErrorKind::NotFound,
    };
    let file: Box<dyn Read> = if is_standard_input(path) {
        Box::new(std::io::stdin())
    } else if path.is_dir() {
        return Err(fail("it is a directory; name a config file in it".into()));
    } else {
        Box::new(file::open(path).map_err(missing)?)
    };
    file::text(file, MAX_FILE_BYTES).map_err(|error| fail(error.to_string()))
}
