//! The error of every use case: a stable code, a message and a remedy.

use std::fmt::{self, Display};
use std::io;

use serde::ser::{Serialize, Serializer};
use serde_json::json;

use crate::record::RecordError;
use crate::report::comparison::ComparisonError;
use crate::report::replay::ReplayError;
use crate::report::runs::ReadError;
use crate::run::RunError;
use flotilla::backend::BackendError;
use flotilla::backend::gpu::device::DeviceError;
use flotilla::config::ConfigError;
use flotilla::front::Failure;

/// An error with its remedy. It is displayed as one text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MessageWithRemedy {
    pub message: String,
    pub remedy: Option<String>,
}

pub fn with_remedy(message: impl Into<String>, remedy: impl Into<String>) -> MessageWithRemedy {
    MessageWithRemedy { message: message.into(), remedy: Some(remedy.into()) }
}

impl From<String> for MessageWithRemedy {
    fn from(message: String) -> MessageWithRemedy {
        MessageWithRemedy { message, remedy: None }
    }
}

impl From<&str> for MessageWithRemedy {
    fn from(message: &str) -> MessageWithRemedy {
        MessageWithRemedy::from(message.to_string())
    }
}

impl Display for MessageWithRemedy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let MessageWithRemedy { message, remedy } = self;
        match remedy {
            None => f.write_str(message),
            Some(remedy) if message.contains('\n') => write!(f, "{message}\n{remedy}"),
            Some(remedy) => write!(f, "{message}; {remedy}"),
        }
    }
}

impl From<&DeviceError> for MessageWithRemedy {
    fn from(error: &DeviceError) -> MessageWithRemedy {
        MessageWithRemedy { message: error.to_string(), remedy: device_help(error).map(String::from) }
    }
}

/// Returns advice on a device that could not be opened, or that failed. The engine does not know the flags.
fn device_help(error: &DeviceError) -> Option<&'static str> {
    Some(match error {
        DeviceError::NoRealAdapter { .. } => {
            "an adapter that may be a software renderer is used only with --adapter (--adapter 0); --backend cpu is faster"
        }
        DeviceError::Refused { .. } | DeviceError::Inexact { .. } => {
            "choose another with --adapter, or use --backend cpu"
        }
        DeviceError::Lost { .. } => "run again, or use --backend cpu",
        DeviceError::OutOfMemory { .. } | DeviceError::TooLarge { .. } => "or use --backend cpu",
        DeviceError::NoAdapter | DeviceError::Failed { .. } => "use --backend cpu",
        DeviceError::UnknownAdapter { found, .. } if found.is_empty() => "use --backend cpu",
        DeviceError::UnknownAdapter { .. } | DeviceError::Shader { .. } => return None,
    })
}

/// Returns advice on episodes that could not be played.
fn backend_help(error: &BackendError) -> Option<&'static str> {
    match error {
        BackendError::Gpu(error) => device_help(error),
        BackendError::TooLarge(_) => Some("pass --backend cpu, or --breed host"),
        BackendError::Gone => Some("run it again"),
        BackendError::InvalidInput(_) | BackendError::HeldElsewhere => None,
    }
}

/// The error of a use case.
///
/// It serialises as `code`, `message` and `remedy`, which is null if there is no advice. Its text is the message with
/// the remedy.
#[derive(Debug, thiserror::Error)]
#[error("{}", MessageWithRemedy { message: self.message(), remedy: self.remedy() })]
pub enum Error {
    /// A config that cannot be read or is invalid.
    Config(#[from] ConfigError),
    /// A GPU that could not be opened, or episodes that could not be played.
    Backend(#[from] BackendError),
    /// There is no GPU to compare with the CPU.
    NoneToVerify(DeviceError),
    /// Files of runs that could not be written, read or used.
    Record(#[from] RecordError),
    /// A run that could not continue.
    Run(#[from] RunError),
    /// A run that could not be read to show it.
    Read(#[from] ReadError),
    /// An episode that could not be replayed.
    Replayed(#[from] ReplayError),
    /// Results that could not be printed.
    Output(io::Error),
    /// Signal handlers that could not be installed.
    Signals(io::Error),
    /// Wrong usage that is only found when flags are read together.
    Usage(MessageWithRemedy),
    /// Results that differ but should be equal.
    Different(MessageWithRemedy),
    /// A command that is refused, for example because it would overwrite files.
    Refused(MessageWithRemedy),
    /// Results that do not exist yet.
    Missing(MessageWithRemedy),
    /// Stopped by a signal. Runs are saved and can be resumed.
    Stopped(MessageWithRemedy),
}

impl Error {
    /// Returns the kind of the error as a word that stays the same from version to version.
    pub fn code(&self) -> &'static str {
        match self {
            _ if self.is_usage() => "usage",
            Error::Config(ConfigError::Unreadable { .. }) => "config_unreadable",
            Error::Config(ConfigError::Invalid { .. }) => "config_invalid",
            Error::Record(error) | Error::Run(RunError::Record(error)) | Error::Read(ReadError::Record(error)) => {
                of_record(error)
            }
            Error::Run(RunError::TooLittle(_) | RunError::Memory { .. }) => "memory",
            Error::Run(RunError::Config(_)) => "config_invalid",
            Error::Backend(_)
            | Error::Run(RunError::Backend { .. } | RunError::Fetch(_))
            | Error::Replayed(ReplayError::Backend(_)) => "backend",
            Error::NoneToVerify(_) => "no_adapter",
            Error::Read(error) | Error::Replayed(ReplayError::Run(error)) => of_read(error),
            Error::Replayed(ReplayError::Differs(_)) | Error::Different(_) => "different",
            Error::Replayed(_) | Error::Refused(_) => "refused",
            Error::Output(_) => "output",
            Error::Signals(_) => "signals",
            Error::Usage(_) => "usage",
            Error::Missing(_) => "missing",
            Error::Stopped(_) => "stopped",
        }
    }

    /// Returns what went wrong, without advice.
    pub fn message(&self) -> String {
        let error: &dyn Display = match self {
            Error::Config(error) => error,
            Error::Backend(error) => error,
            Error::NoneToVerify(error) => error,
            Error::Record(error) => error,
            Error::Run(error) => error,
            Error::Read(error) => error,
            Error::Replayed(error) => error,
            Error::Output(error) => &format!("standard output cannot be written: {error}"),
            Error::Signals(error) => &format!("signal handlers cannot be installed: {error}"),
            Error::Usage(text)
            | Error::Different(text)
            | Error::Refused(text)
            | Error::Missing(text)
            | Error::Stopped(text) => &text.message,
        };
        error.to_string()
    }

    /// Returns the remedy, if there is one.
    pub fn remedy(&self) -> Option<String> {
        let help = match self {
            Error::Config(ConfigError::Unreadable { is_missing: true, .. }) => {
                Some("check the path, or write a config with `flotilla init`")
            }
            Error::Backend(error) | Error::Replayed(ReplayError::Backend(error)) => backend_help(error),
            Error::NoneToVerify(_) => Some("--adapter cpu compares the processor's instruction sets"),
            Error::Replayed(ReplayError::NoSuch(_, remedy)) => *remedy,
            Error::Record(error) => return error.help("run it again"),
            Error::Run(error) => return error.help(),
            Error::Read(error) | Error::Replayed(ReplayError::Run(error)) => return error.help(),
            Error::Usage(text)
            | Error::Different(text)
            | Error::Refused(text)
            | Error::Missing(text)
            | Error::Stopped(text) => return text.remedy.clone(),
            Error::Config(_) | Error::Replayed(_) | Error::Output(_) | Error::Signals(_) => None,
        };
        help.map(String::from)
    }

    /// Adds a remedy to wrong usage, a missing result, a refused request or a stop, unless it has one. The caller knows
    /// which command was called.
    pub fn or_advise(mut self, remedy: impl FnOnce() -> String) -> Error {
        if let Error::Usage(text) | Error::Refused(text) | Error::Missing(text) | Error::Stopped(text) = &mut self {
            text.remedy.get_or_insert_with(remedy);
        }
        self
    }

    /// Returns the process's exit code: 1 for a failure, 2 for wrong usage, 3 for results that differ but should be
    /// equal, 75 if stopped and ready to be resumed.
    ///
    /// A flag's value that does not fit the file or the machine is wrong usage, too. If the file is also invalid, the
    /// code is 1.
    pub fn exit_code(&self) -> u8 {
        match self {
            _ if self.is_usage() => 2,
            Error::Different(_) => 3,
            Error::Stopped(_) => 75,
            _ => 1,
        }
    }

    /// Reports whether the request was wrong, as opposed to a failure of a valid request.
    pub fn is_usage(&self) -> bool {
        match self {
            Error::Usage(_)
            | Error::Backend(BackendError::Gpu(DeviceError::UnknownAdapter { .. }))
            | Error::NoneToVerify(DeviceError::UnknownAdapter { .. })
            | Error::Record(RecordError::NoTrial { .. })
            | Error::Replayed(ReplayError::NoSuch(..)) => true,
            Error::Config(error) => error.is_usage(),
            _ => false,
        }
    }
}

impl From<Failure> for Error {
    fn from(error: Failure) -> Error {
        match error {
            Failure::Config(error) => error.into(),
            Failure::Backend(error) => error.into(),
            Failure::TooLittle(error) => Error::Run(error.into()),
            Failure::Memory { what, bytes } => {
                Error::Run(RunError::Memory { what, bytes: bytes.try_into().unwrap_or(u64::MAX) })
            }
            error => Error::Refused(error.to_string().into()),
        }
    }
}

impl From<ComparisonError> for Error {
    fn from(error: ComparisonError) -> Error {
        Error::Refused(error.to_string().into())
    }
}

impl From<DeviceError> for Error {
    fn from(error: DeviceError) -> Error {
        Error::Backend(error.into())
    }
}

impl Serialize for Error {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        json!({ "code": self.code(), "message": self.message(), "remedy": self.remedy() }).serialize(serializer)
    }
}

fn of_record(error: &RecordError) -> &'static str {
    match error {
        RecordError::Write { .. } => "not_written",
        RecordError::Read { .. } => "not_read",
        RecordError::Exists { .. } => "exists",
        RecordError::NotOurs { .. } | RecordError::OfAnotherUser { .. } => "not_ours",
        RecordError::Locked { .. } => "locked",
        RecordError::Damaged { .. } | RecordError::Differs { .. } | RecordError::Edited { .. } => "damaged",
        _ => "refused",
    }
}

fn of_read(error: &ReadError) -> &'static str {
    match error {
        ReadError::Missing(_) | ReadError::NoFolder(_) => "no_run",
        ReadError::Unfinished { .. } | ReadError::Untested { .. } => "unfinished",
        ReadError::Config { .. } => "damaged",
        ReadError::Record(error) => of_record(error),
        ReadError::Foreign { .. } | ReadError::Collection { .. } => "refused",
    }
}
