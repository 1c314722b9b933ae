//! Converts the crate's errors to Python exceptions with the same messages.

use flotilla::backend::BackendError;
use flotilla::backend::gpu::device::DeviceError;
use flotilla::config::{ConfigError, Problem};
use flotilla::front::Failure;
use flotilla::stepping::StepError;
use flotilla_app::ops;
use flotilla_app::record::RecordError;
use flotilla_app::report::runs;
use pyo3::exceptions::{PyFileExistsError, PyKeyboardInterrupt, PyMemoryError, PyValueError};
use pyo3::prelude::*;

/// Converts an error of the crate to a Python exception.
pub trait Raised {
    fn raised(self) -> PyErr;
}

/// Converts the error of a result to a Python exception.
pub trait Raise<T> {
    fn raise(self) -> PyResult<T>;
}

impl<T, E: Raised> Raise<T> for Result<T, E> {
    fn raise(self) -> PyResult<T> {
        self.map_err(Raised::raised)
    }
}

/// Returns an exception made by the function or class `by` of `flotilla/_errors.py`.
fn made(by: &str, arguments: impl for<'py> pyo3::call::PyCallArgs<'py>) -> PyErr {
    Python::attach(|py| {
        let made = py.import("flotilla._errors").and_then(|module| module.call_method1(by, arguments));
        made.map_or_else(|error| error, PyErr::from_value)
    })
}

/// Returns a message of the program with its flags as arguments of Python.
fn in_python(text: String) -> String {
    Python::attach(|py| {
        let named = py.import("flotilla._errors").and_then(|module| module.call_method1("keywords", (&text,)));
        named.and_then(|named| named.extract()).unwrap_or(text)
    })
}

/// Returns a `flotilla.Error`: the request was valid, but failed.
pub fn failed(text: impl ToString) -> PyErr {
    made("Error", (text.to_string(),))
}

/// Returns the elements of an array, or an error if they are not contiguous in C order. `what` is the start of the error:
/// "actions are".
pub fn contiguous<T, E>(what: &str, slice: Result<T, E>) -> PyResult<T> {
    slice.map_err(|_| PyValueError::new_err(format!("{what} not C-contiguous")))
}

impl Raised for ConfigError {
    fn raised(self) -> PyErr {
        let text = self.to_string();
        let problems = match self {
            ConfigError::Invalid { problems, .. } => problems,
            ConfigError::Unreadable { reason, .. } => vec![Problem { line: None, key: String::new(), message: reason }],
        };
        let problems: Vec<_> =
            problems.into_iter().map(|Problem { line, key, message }| (line, key, message)).collect();
        made("config_error", (text, problems))
    }
}

impl Raised for StepError {
    fn raised(self) -> PyErr {
        match self {
            StepError::Memory { .. } => PyMemoryError::new_err(self.to_string()),
            _ => PyValueError::new_err(self.to_string()),
        }
    }
}

impl Raised for Failure {
    fn raised(self) -> PyErr {
        let text = self.to_string();
        match self {
            Failure::Config(error) => error.raised(),
            Failure::Step(error) => error.raised(),
            Failure::TooLittle(_) | Failure::Memory { .. } => PyMemoryError::new_err(text),
            Failure::Backend(error) => error.raised(),
            _ => PyValueError::new_err(text),
        }
    }
}

impl Raised for RecordError {
    fn raised(self) -> PyErr {
        match self {
            RecordError::Exists { .. } => {
                PyFileExistsError::new_err(format!("{self}; choose another folder, or pass force=True"))
            }
            _ => failed(self),
        }
    }
}

impl Raised for runs::ReadError {
    fn raised(self) -> PyErr {
        match self {
            runs::ReadError::Unfinished { .. } => {
                failed(format!("{self}; finish the run with flotilla.train(config, out=..., resume=True)"))
            }
            _ => failed(self),
        }
    }
}

impl Raised for ops::Error {
    fn raised(self) -> PyErr {
        // Advice is about flags of the program.
        let text = in_python(self.message());
        match self {
            ops::Error::Config(error) => error.raised(),
            ops::Error::Stopped(_) => PyKeyboardInterrupt::new_err(text),
            error if error.is_usage() => PyValueError::new_err(text),
            error => match error.code() {
                "exists" => PyFileExistsError::new_err(format!("{text}; choose another folder, or pass force=True")),
                "memory" => PyMemoryError::new_err(text),
                _ => failed(text),
            },
        }
    }
}

impl Raised for BackendError {
    fn raised(self) -> PyErr {
        match self {
            BackendError::Gpu(DeviceError::UnknownAdapter { .. }) => PyValueError::new_err(self.to_string()),
            _ => failed(self),
        }
    }
}

impl Raised for std::io::Error {
    fn raised(self) -> PyErr {
        self.into()
    }
}
