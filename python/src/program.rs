//! The command-line program, its use cases, and the adapters it can use.

use std::cell::RefCell;
use std::ffi::{CString, OsString};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use flotilla::backend::OpenBackend;
use flotilla::backend::gpu::device;
use flotilla::choice::Work;
use flotilla::cli;
use flotilla::ops::{self, Context, Event, Player, Request};
use pyo3::exceptions::{PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;

use crate::errors::Raise;
use crate::workers::{self, Lent};

/// Runs a command line, with the program's name first, and returns the exit code.
#[pyfunction]
pub fn main(py: Python<'_>, words: Vec<OsString>) -> u8 {
    // Without `workers::aside`, because the program starts as many threads as the command line asks for.
    py.detach(|| cli::main(Some(words)))
}

/// Returns the available adapters: name, driver, graphics API and kind.
#[pyfunction]
pub fn adapters(py: Python<'_>) -> Vec<(String, String, String, String)> {
    let found = workers::aside(py, device::adapters);
    found.into_iter().map(|info| (info.name, info.driver, info.backend.to_string(), info.kind.to_string())).collect()
}

/// Minimum time between checks for Ctrl-C.
const PATIENCE: Duration = Duration::from_millis(50);

/// Runs a use case of `flotilla::ops`. The request and the outcome are JSON.
#[pyfunction]
pub fn answer(py: Python<'_>, request: &str, backend: &str, command: &str) -> PyResult<String> {
    let request: Request = serde_json::from_str(request).map_err(|error| PyValueError::new_err(error.to_string()))?;
    let mut player = Lazy { name: backend, open: None, error: None };
    let (outcome, interrupted) = workers::aside(py, || {
        let (stop, save) = (AtomicBool::new(false), AtomicBool::new(false));
        let (asked, interrupted) = (RefCell::new(Instant::now()), RefCell::new(None));
        let check = |event: Event<'_>| {
            let is_due = asked.borrow().elapsed() >= PATIENCE;
            let found = Python::attach(|py| match event {
                Event::Warning(text) if !text.starts_with("note: ") => warn(py, text.trim_start_matches("warning: ")),
                _ if is_due => py.check_signals(),
                _ => Ok(()),
            });
            if is_due {
                asked.replace(Instant::now());
            }
            if let Err(error) = found {
                stop.store(true, Relaxed);
                interrupted.replace(Some(error));
            }
        };
        let context = Context { tell: &check, stop: &stop, save: &save, command, falls_back: false };
        let outcome = ops::answer(&request, &mut player, context);
        (outcome, interrupted.into_inner())
    });
    match (interrupted, player.error) {
        (Some(error), _) | (None, Some(error)) => Err(error),
        (None, None) => {
            let outcome = outcome.raise()?;
            if let Some(lent) = player.open {
                lent.give_back();
            }
            Ok(outcome.to_string())
        }
    }
}

fn warn(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = CString::new(text.replace('\0', " ")).unwrap_or_default();
    PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 2)
}

/// A backend by name, opened when it is needed.
struct Lazy<'a> {
    name: &'a str,
    open: Option<Lent>,
    /// Why it could not be opened.
    error: Option<PyErr>,
}

impl Player for Lazy<'_> {
    fn open(&mut self, work: Work) -> Result<(&mut OpenBackend, String), ops::Error> {
        if self.open.is_none() {
            match Lent::open(self.name, work) {
                Ok(open) => self.open = Some(open),
                Err(error) => {
                    let message = error.to_string();
                    self.error = Some(error);
                    return Err(ops::Error::Refused(message.into()));
                }
            }
        }
        let Lent { player, description, .. } = self.open.as_mut().expect("it was opened above");
        Ok((player, description.clone()))
    }
}
