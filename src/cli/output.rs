//! Files that a command was told to write.

use std::io::{self, Write};
use std::path::Path;

use super::Error;
use crate::file;
use crate::record::disk::Disk;
use crate::record::{RecordError, folder};

/// Refuses to write over what is read, over another output, or over what a run needs. Each file comes with its flag.
///
/// # Errors
/// An output stands for something else already.
pub fn check(outputs: &[(&str, Option<&Path>)], inputs: &[&Path]) -> Result<(), Error> {
    let mut taken: Vec<_> = inputs.iter().map(|path| (file::resolved(path), "is read from".to_string())).collect();
    for &(flag, path) in outputs {
        let Some(path) = path else { continue };
        // Devices take whatever comes.
        if path.exists() && !path.is_file() && !path.is_dir() {
            continue;
        }
        // Better told before hours of playing than after.
        if let Err(error) = std::fs::metadata(file::folder(path)) {
            return Err(RecordError::Write { path: path.into(), error }.into());
        }
        let resolved = file::resolved(path);
        let refused =
            |why: &str| Err(Error::Usage(format!("{flag} {}: this file {why}; name another to write", path.display())));
        if let Some((_, why)) = taken.iter().find(|(other, _)| *other == resolved) {
            return refused(why);
        }
        if let Some(owner) = folder::owner(path) {
            return refused(&format!("belongs to what is in {}", owner.display()));
        }
        taken.push((resolved, format!("is written by {flag}")));
    }
    Ok(())
}

/// Writes a file, whole or not at all.
///
/// # Errors
/// It cannot be written.
pub fn write(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), Error> {
    Ok(Disk::default().deliver(path, content).map_err(|error| RecordError::Write { path: path.into(), error })?)
}
