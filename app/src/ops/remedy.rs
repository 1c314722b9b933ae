//! Advice on errors of the library, which does not know the command line's flags. Each function returns the text that
//! follows the error's own.

use std::ffi::OsString;
use std::io;
use std::io::ErrorKind::{
    FileTooLarge, NotADirectory, NotFound, PermissionDenied, QuotaExceeded, ReadOnlyFilesystem, StorageFull,
};
use std::path::Path;

use crate::record::RecordError;
use crate::record::folder::CONFIG;
use crate::report::replay::ReplayError;
use crate::report::runs;
use crate::run::RunError;
use crate::shell;
use flotilla::backend::BackendError;
use flotilla::backend::gpu::device::DeviceError;
use flotilla::config::ConfigError;
use flotilla::escape::PathExt;
use flotilla::file;

/// `EMFILE`: the process has too many open files. The number is the same on every Unix, and the standard library has no
/// name for it.
const TOO_MANY_FILES: i32 = 24;
/// `EIO`: a device failed to read or write. The number is the same on every Unix.
const INPUT_OUTPUT: i32 = 5;

/// Advice on a comparison without a GPU.
pub const NONE_TO_VERIFY: &str = "; --adapter cpu compares the processor's instruction sets";

/// Returns advice on a device that could not be opened, or that failed.
pub fn device(error: &DeviceError) -> &'static str {
    match error {
        DeviceError::NoRealAdapter { .. } => {
            "; an adapter that may be a software renderer is used only with --adapter (--adapter 0); --backend cpu is faster"
        }
        DeviceError::Refused { .. } | DeviceError::Inexact { .. } => {
            "; choose another with --adapter, or use --backend cpu"
        }
        DeviceError::Lost { .. } => "; run again, or use --backend cpu",
        DeviceError::OutOfMemory { .. } | DeviceError::TooLarge { .. } => ", or --backend cpu",
        DeviceError::NoAdapter | DeviceError::Failed { .. } => "; use --backend cpu",
        DeviceError::UnknownAdapter { found, .. } if found.is_empty() => "; use --backend cpu",
        DeviceError::UnknownAdapter { .. } | DeviceError::Shader { .. } => "",
    }
}

/// Returns advice on episodes that could not be played.
pub fn backend(error: &BackendError) -> &'static str {
    match error {
        BackendError::Gpu(error) => device(error),
        BackendError::TooLarge(_) => "; pass --backend cpu, or --breed host",
        BackendError::Gone => "; run it again",
        BackendError::InvalidInput(_) | BackendError::HeldElsewhere => "",
    }
}

/// Returns advice on a file that cannot be read.
fn unread(error: &io::Error) -> &'static str {
    match error.kind() {
        NotFound | NotADirectory => "; check the path",
        PermissionDenied => "; ask its owner for permission to read it",
        _ => "",
    }
}

/// Returns advice on a config or a sweep that cannot be used.
pub fn config(error: &ConfigError) -> &'static str {
    match error {
        ConfigError::Unreadable { is_missing: true, .. } => "; check the path, or write a config with `flotilla init`",
        ConfigError::Unreadable { .. } | ConfigError::Invalid { .. } => "",
    }
}

/// Returns advice on files of runs. `again` is the next action after the advice, such as "run it again".
pub fn record(error: &RecordError, again: &str) -> String {
    match error {
        RecordError::Write { error, .. } | RecordError::Read { error, .. }
            if cfg!(unix) && error.raw_os_error() == Some(TOO_MANY_FILES) =>
        {
            format!("; the system allows no more open files here (see `ulimit -n`): raise that, then {again}")
        }
        RecordError::Write { error, .. } => match error.kind() {
            StorageFull | QuotaExceeded => format!("; free some space, then {again}"),
            FileTooLarge => {
                format!("; the system allows no larger file here (see `ulimit -f`): raise that, then {again}")
            }
            PermissionDenied | ReadOnlyFilesystem => "; choose a place you may write to".into(),
            _ if cfg!(unix) && error.raw_os_error() == Some(INPUT_OUTPUT) => format!("; check the disk, then {again}"),
            _ => String::new(),
        },
        RecordError::Exists { .. } => {
            "; pass --resume to continue it or --force to overwrite it, or choose another --out".into()
        }
        RecordError::NotOurs { .. } => "; move it away, or choose another --out".into(),
        RecordError::OfAnotherUser { .. } => "; to write there all the same, name it with --out".into(),
        RecordError::NoFolder { .. } => "; choose a folder with --out".into(),
        RecordError::Shorter { existing, .. } => {
            format!("; resume with --generations {existing} or more, or choose another --out")
        }
        RecordError::Locked { .. } => "; wait for it, stop it, or choose another --out".into(),
        RecordError::ConfigDiffers { path, .. } => format!(
            "\nresume with the config it was started with ({}/{CONFIG}), or choose another --out",
            path.escaped()
        ),
        RecordError::InitDiffers { existing: Some(_), .. } => {
            "; resume without --init or with that file, or choose another --out".into()
        }
        RecordError::InitDiffers { existing: None, .. } => "; resume without --init, or choose another --out".into(),
        RecordError::OriginUnknown { .. } => {
            "; pass the policies that it started from with --init, or start over with --force".into()
        }
        RecordError::OwnFitness { .. } => {
            "; start a new run from its policies with --init, or choose another --out".into()
        }
        RecordError::Edited { path } => format!(
            "; restore what it was, or move {} away and name the run's own config, or choose another --out",
            path.display()
        ),
        RecordError::Differs { path } => {
            let folder = file::folder(path).display().to_string();
            let config = file::folder(path).join(CONFIG).display().to_string();
            let again = match path.ends_with(CONFIG) {
                true => String::new(),
                false => {
                    let command = shell::command(["flotilla", "train", &config, "--out", &folder, "--resume"]);
                    format!(", make it again with `{command}`")
                }
            };
            format!("; restore it{again}, or read it all the same with --unverified")
        }
        RecordError::Newer { .. } => "; use that version, or choose another --out".into(),
        RecordError::InitNeeded { .. } => "; pass that file with --init".into(),
        RecordError::Read { error, .. } => unread(error).into(),
        RecordError::Damaged { .. } | RecordError::NoTrial { .. } => String::new(),
    }
}

/// Returns advice on a run that could not continue.
pub fn run(error: &RunError) -> String {
    match error {
        RunError::Record(error) => record(error, "continue with --resume"),
        RunError::TooLittle(_) => {
            " (flotilla check shows what a config needs; `ulimit -v` and limits of a job or container count)".into()
        }
        RunError::Backend { saved: Ok(()), .. } => {
            ": continue with --resume, with --backend cpu to change to the CPU".into()
        }
        RunError::Backend { saved: Err(error), .. } => run(error),
        RunError::Fetch(_) => "; --resume continues from the last checkpoint or the start".into(),
        RunError::Memory { .. } | RunError::Config(_) => String::new(),
    }
}

/// The folder for runs whose folder is not named.
pub const RUNS: &str = "runs";

/// Returns advice on a run that could not be read.
pub fn read(error: &runs::ReadError) -> String {
    match error {
        runs::ReadError::Missing(folder) if Path::new(RUNS).join(folder).is_dir() => {
            format!("; did you mean {}?", Path::new(RUNS).join(folder).escaped())
        }
        runs::ReadError::Missing(folder) => {
            let words = ["flotilla", "train", "CONFIG", "--out"].map(OsString::from);
            let command = shell::command(words.into_iter().chain([shell::argument(folder)]));
            format!("; `{command}` makes a run there")
        }
        runs::ReadError::NoFolder(path) if file::is_zip(path) => {
            format!("; unpack it with `{}`", shell::command(["unzip".into(), shell::argument(path)]))
        }
        runs::ReadError::NoFolder(_) => ", which `flotilla train` makes".into(),
        runs::ReadError::Foreign { .. } => "; `flotilla train CONFIG --out DIR` makes one".into(),
        runs::ReadError::Config { .. } => {
            "\nfind a config that is whole, and repeat the run with `flotilla train CONFIG --out DIR`".into()
        }
        runs::ReadError::Unfinished { folder, .. } => {
            let [config, out] = [folder.join(CONFIG), folder.clone()].map(|path| shell::argument(&path));
            let words: [OsString; 6] =
                ["flotilla".into(), "train".into(), config, "--out".into(), out, "--resume".into()];
            let command = shell::command(words);
            format!("; finish the run with `{command}`")
        }
        runs::ReadError::Record(error) => record(error, "try again"),
        runs::ReadError::Collection { .. } => String::new(),
    }
}

/// Returns advice on an episode that could not be replayed.
pub fn replayed(error: &ReplayError) -> String {
    match error {
        ReplayError::Run(error) => read(error),
        ReplayError::Backend(error) => backend(error).into(),
        ReplayError::NoGeneration { newest: Some(_), .. } => ", or finish the run with --resume".into(),
        ReplayError::NoGeneration { .. }
        | ReplayError::NoTrial { .. }
        | ReplayError::NoTeam { .. }
        | ReplayError::NoStart { .. }
        | ReplayError::OwnFitness { .. }
        | ReplayError::Differs { .. }
        | ReplayError::Stopped => String::new(),
    }
}
