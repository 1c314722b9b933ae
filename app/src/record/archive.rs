//! Runs in zip files, as the browser page saves them.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use zip::ZipArchive;

use super::RecordError;
use super::disk::Disk;
use super::folder::{CHECKPOINTS, CONFIG, METRICS, POLICIES, RUN};
use flotilla::file;

/// Maximum number of bytes that are unpacked from one zip file.
const MAX_BYTES: u64 = 16 << 30;
/// Every zip file that is not empty starts with these bytes.
const MAGIC: [u8; 4] = *b"PK\x03\x04";

/// The folder of a run: the named folder, or a temporary one with the unpacked zip file, which is removed at the end.
#[derive(Debug)]
pub(crate) struct RunFolder {
    path: PathBuf,
    unpacked: Option<TempDir>,
}

impl RunFolder {
    /// Opens a run. A zip file is unpacked, without its checkpoints; any other path is taken as it is.
    ///
    /// # Errors
    /// The zip file cannot be read or unpacked, or does not hold exactly one run.
    pub fn open(path: &Path) -> Result<RunFolder, RecordError> {
        RunFolder::open_and_unpack(path, false)
    }

    /// Opens a run as [`RunFolder::open`] does, with its checkpoints, which may take gigabytes.
    ///
    /// # Errors
    /// As for [`RunFolder::open`].
    pub fn open_with_checkpoints(path: &Path) -> Result<RunFolder, RecordError> {
        RunFolder::open_and_unpack(path, true)
    }

    fn open_and_unpack(path: &Path, checkpoints: bool) -> Result<RunFolder, RecordError> {
        let Some(file) = zip_file(path)? else { return Ok(RunFolder { path: path.into(), unpacked: None }) };
        let temporary = TempDir::new().map_err(RecordError::write(&std::env::temp_dir()))?;
        // Pictures and messages show the folder's name.
        let folder = temporary.path().join(file::stem(path, "run"));
        unpack(path, file, &folder, checkpoints)?;
        Ok(RunFolder { path: folder, unpacked: Some(temporary) })
    }

    /// Returns the path of the folder. It exists until this value is dropped.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reports whether the run came from a zip file, so that nothing may be written into its folder.
    pub(crate) fn is_unpacked(&self) -> bool {
        self.unpacked.is_some()
    }
}

/// Opens a zip file. Returns none if the path is anything else.
fn zip_file(path: &Path) -> Result<Option<File>, RecordError> {
    // Only regular files are opened: opening a pipe would wait for its writer.
    if !path.metadata().is_ok_and(|metadata| metadata.is_file()) {
        return Ok(None);
    }
    let mut file = file::open(path).map_err(RecordError::read(path))?;
    let mut start = [0; MAGIC.len()];
    if file.read_exact(&mut start).is_err() || start != MAGIC {
        return Ok(None);
    }
    file.seek(SeekFrom::Start(0)).map_err(RecordError::read(path))?;
    Ok(Some(file))
}

/// Returns the folder of the run within a zip file, empty at the top. Returns `None` unless the path is a zip file with
/// a run.
pub(crate) fn run_prefix(path: &Path) -> Option<String> {
    let archive = ZipArchive::new(zip_file(path).ok()??).ok()?;
    let names: Vec<String> = archive.file_names().flatten().map(Into::into).collect();
    Some(names.iter().find_map(|name| inside(name, CONFIG))?.trim_end_matches('/').into())
}

/// Unpacks the files of a run, with or without its checkpoints. Other files of the archive are ignored, so no name in it
/// leads out of the folder.
fn unpack(path: &Path, file: File, folder: &Path, checkpoints: bool) -> Result<(), RecordError> {
    let damaged = |error: zip::result::ZipError| RecordError::damaged(path, error);
    let mut archive = ZipArchive::new(file).map_err(damaged)?;
    let names: Vec<String> = archive.file_names().flatten().map(Into::into).collect();
    let runs: Vec<&str> = names.iter().filter_map(|name| inside(name, CONFIG)).collect();
    let &[top] = &runs[..] else {
        let reason = match runs.len() {
            0 => format!("it is not the archive of a run (no {CONFIG})"),
            count => format!("it has {count} runs; unpack it and name the folder of one"),
        };
        return Err(RecordError::damaged(path, reason));
    };
    let disk = Disk::default();
    disk.create_folder(&folder.join(CHECKPOINTS)).map_err(RecordError::write(folder))?;
    let mut room = MAX_BYTES;
    for name in &names {
        let Some(own) = name.strip_prefix(top) else { continue };
        let checkpoint = own.strip_prefix(CHECKPOINTS).and_then(|rest| rest.strip_prefix('/'));
        let is_checkpoint = checkpoint.filter(|_| checkpoints).is_some_and(|rest| {
            rest.ends_with(".safetensors")
                && rest.bytes().all(|byte| byte.is_ascii_alphanumeric() || b".-_".contains(&byte))
        });
        if !is_checkpoint && ![CONFIG, METRICS, POLICIES, RUN].contains(&own) {
            continue;
        }
        let target = folder.join(own);
        let mut content = archive.by_name(name).map_err(damaged)?.take(room);
        let written = disk.replace(&target, |output| {
            room -= io::copy(&mut content, output)?;
            Ok(())
        });
        written.map_err(RecordError::write(&target))?;
        if room == 0 {
            return Err(RecordError::damaged(path, format!("it holds more than {} GiB", MAX_BYTES >> 30)));
        }
    }
    Ok(())
}

/// Returns the folder of a file in the archive, empty or ending in `/`, if that is the file's name.
fn inside<'a>(path: &'a str, name: &str) -> Option<&'a str> {
    let folder = path.strip_suffix(name)?;
    (folder.is_empty() || folder.ends_with('/')).then_some(folder)
}
