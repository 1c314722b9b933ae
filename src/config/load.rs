//! Configs from files.

use std::io::{ErrorKind, Read};
use std::path::Path;

use super::{Config, ConfigError};
use crate::escape::PathExt;
use crate::file;

/// Most bytes in a config file.
pub const MAX_FILE_BYTES: u64 = 1 << 20;

impl Config {
    /// Reads a config file.
    ///
    /// # Errors
    /// A file that cannot be read, or everything that is wrong with what it says.
    pub fn load(path: &Path) -> Result<Config, ConfigError> {
        Config::parse(&read_file(path)?, &name(path))
    }
}

/// Whether a config is to come from standard input, not from a file.
pub fn is_standard_input(path: &Path) -> bool {
    path == "-"
}

/// What errors call a config or sweep file.
pub fn name(path: &Path) -> String {
    if is_standard_input(path) { "standard input".into() } else { path.escaped().to_string() }
}

/// The text of a config or sweep file; of standard input, where that is what `-` means.
///
/// # Errors
/// No such file, not a file, larger than [`MAX_FILE_BYTES`], not UTF-8.
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
