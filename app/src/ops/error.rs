//! The error of every use case: a stable code, a message and a remedy.

use std::fmt::{self, Display};
use std::io;

use serde::ser::{Serialize, SerializeStruct, Serializer};

use super::remedy;
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
    /// The error.
    pub message: String,
    /// The remedy, if there is one.
    pub remedy: Option<String>,
}

/// Returns a message with its remedy.
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

/// The error of a use case.
///
/// It serialises as `code`, `message` and `remedy`, which is null if there is no advice. Its text is the message with
/// the remedy.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A config that cannot be read or is invalid.
    #[error("{}{}", .0, remedy::config(.0))]
    Config(#[from] ConfigError),
    /// A GPU that could not be opened, or episodes that could not be played.
    #[error("{}{}", .0, remedy::backend(.0))]
    Backend(#[from] BackendError),
    /// There is no GPU to compare with the CPU.
    #[error("{}{}", .0, remedy::NONE_TO_VERIFY)]
    NoneToVerify(DeviceError),
    /// Files of runs that could not be written, read or used.
    #[error("{}{}", .0, remedy::record(.0, "run it again"))]
    Record(#[from] RecordError),
    /// A run that could not continue.
    #[error("{}{}", .0, remedy::run(.0))]
    Run(#[from] RunError),
    /// A run that could not be read to show it.
    #[error("{}{}", .0, remedy::read(.0))]
    Read(#[from] ReadError),
    /// An episode that could not be replayed.
    #[error("{}{}", .0, remedy::replayed(.0))]
    Replayed(#[from] ReplayError),
    /// Results that could not be printed.
    #[error("standard output cannot be written: {0}")]
    Output(io::Error),
    /// Signal handlers that could not be installed.
    #[error("signal handlers cannot be installed: {0}")]
    Signals(io::Error),
    /// Wrong usage that is only found when flags are read together.
    #[error("{0}")]
    Usage(MessageWithRemedy),
    /// Results that differ but should be equal.
    #[error("{0}")]
    Different(MessageWithRemedy),
    /// A command that is refused, for example because it would overwrite files.
    #[error("{0}")]
    Refused(MessageWithRemedy),
    /// Results that do not exist yet.
    #[error("{0}")]
    Missing(MessageWithRemedy),
    /// Stopped by a signal. Runs are saved and can be resumed.
    #[error("{0}")]
    Stopped(MessageWithRemedy),
}

impl Error {
    /// Converts the error of a training in memory.
    pub(crate) fn of_training(error: Failure) -> Error {
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
            Error::Replayed(ReplayError::Differs { .. }) | Error::Different(_) => "different",
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
        match self {
            Error::Config(error) => error.to_string(),
            Error::Backend(error) => error.to_string(),
            Error::NoneToVerify(error) => error.to_string(),
            Error::Record(error) => error.to_string(),
            Error::Run(error) => error.to_string(),
            Error::Read(error) => error.to_string(),
            Error::Replayed(error) => error.to_string(),
            Error::Usage(text)
            | Error::Different(text)
            | Error::Refused(text)
            | Error::Missing(text)
            | Error::Stopped(text) => text.message.clone(),
            Error::Output(_) | Error::Signals(_) => self.to_string(),
        }
    }

    /// Returns the remedy, if there is one.
    pub fn remedy(&self) -> Option<String> {
        let (whole, message) = (self.to_string(), self.message());
        // The library's errors are followed by advice in the same sentence.
        let advice = whole.strip_prefix(&message)?.trim_start_matches([';', ',', ':', ' ', '\n']);
        let advice = advice.strip_prefix('(').and_then(|inner| inner.strip_suffix(')')).unwrap_or(advice);
        (!advice.is_empty()).then(|| advice.to_string())
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
            | Error::Replayed(
                ReplayError::NoTrial { .. } | ReplayError::NoGeneration { .. } | ReplayError::NoTeam { .. },
            ) => true,
            Error::Config(error) => error.is_usage(),
            _ => false,
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
        let mut fields = serializer.serialize_struct("Error", 3)?;
        fields.serialize_field("code", self.code())?;
        fields.serialize_field("message", &self.message())?;
        fields.serialize_field("remedy", &self.remedy())?;
        fields.end()
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
        ReadError::Unfinished { .. } => "unfinished",
        ReadError::Config { .. } => "damaged",
        ReadError::Record(error) => of_record(error),
        ReadError::Foreign { .. } | ReadError::Collection { .. } => "refused",
    }
}
