//! The command-line program, its use cases, and the adapters it can use.

use std::cell::Cell;
use std::ffi::OsString;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Instant;

use flotilla::backend::OpenBackend;
use flotilla::backend::gpu::device;
use flotilla::trainer::Row;
use flotilla_app::choice::Work;
use flotilla_app::ops::{self, BackendSource, Context, Event};
use flotilla_cli::request::{self, Request};
use pyo3::exceptions::{PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;

use crate::errors::Raise;
use crate::workers::{self, Lent, PATIENCE};

/// Runs a command line, with the program's name first, and returns the exit code.
#[pyfunction]
pub fn main(py: Python<'_>, words: Vec<OsString>) -> u8 {
    // Without `workers::aside`, because the program starts as many threads as the command line asks for.
    py.detach(|| flotilla_cli::main(Some(words)))
}

/// Returns the available adapters: name, driver, graphics API and kind.
#[pyfunction]
pub fn adapters(py: Python<'_>) -> Vec<(String, String, String, String)> {
    let found = workers::aside(py, device::adapters);
    found.into_iter().map(|info| (info.name, info.driver, info.backend.to_string(), info.kind.to_string())).collect()
}

/// Runs a use case of `flotilla_app::ops`. The request and the outcome are JSON.
#[pyfunction]
pub fn answer(py: Python<'_>, request: &str, backend: &str, command: &str) -> PyResult<String> {
    let request: Request = serde_json::from_str(request).map_err(|error| PyValueError::new_err(error.to_string()))?;
    perform(py, backend, command, &|_, _, _| Ok(false), |backends, context| {
        request::answer(&request, backends, context)
    })
    .map(|outcome| outcome.to_string())
}

/// Receives the rows of a generation, the number of the last one, and champions if they were asked for. Reports whether
/// to end the training there.
type Watch<'a> = &'a (dyn Fn(&[Row], usize, Option<&[f32]>) -> PyResult<bool> + Sync);

/// Runs a use case, shows its warnings, and checks for Ctrl-C.
pub fn perform<R: Send>(
    py: Python<'_>,
    backend: &str,
    command: &str,
    watch: Watch<'_>,
    work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, ops::Error> + Send,
) -> PyResult<R> {
    let mut backends = Lazy { name: backend, open: None, error: None };
    let (outcome, interrupted) = workers::aside(py, || {
        let [stop, end] = [false; 2].map(AtomicBool::new);
        let (asked, interrupted) = (Cell::new(Instant::now()), Cell::new(None));
        let (last, ended) = (Cell::new(0), Cell::new(false));
        let report = |event: Event<'_>| {
            let is_due = asked.get().elapsed() >= PATIENCE;
            let generation = |a: &Row, b: &Row| a.generation == b.generation;
            let found = match event {
                Event::Warning(text) => Python::attach(|py| warn(py, &text)).map(|()| false),
                Event::Note(text) if text.starts_with("note: ") => Python::attach(|py| warn(py, &text)).map(|()| false),
                Event::Begin(_, _, to) => {
                    last.set(to);
                    Ok(false)
                }
                Event::Rows { rows, champions, .. } if !ended.get() => {
                    let mut told = rows.chunk_by(generation).map(|rows| watch(rows, last.get(), champions));
                    told.find(|told| !matches!(told, Ok(false))).unwrap_or(Ok(false))
                }
                _ => Ok(false),
            };
            let found = match found {
                Ok(false) if is_due => {
                    asked.set(Instant::now());
                    Python::attach(|py| py.check_signals()).map(|()| false)
                }
                found => found,
            };
            let ends = found.unwrap_or_else(|error| {
                interrupted.set(Some(error));
                stop.store(true, Relaxed);
                false
            });
            if ends {
                ended.set(true);
                end.store(true, Relaxed);
                stop.store(true, Relaxed);
            }
        };
        let mut context = Context::new(&report);
        (context.stop, context.end, context.command) = (&stop, &end, command);
        let outcome = work(&mut backends, context);
        (outcome, interrupted.into_inner())
    });
    if let Some(error) = interrupted.or(backends.error) {
        return Err(error);
    }
    let outcome = outcome.raise()?;
    if let Some(lent) = backends.open {
        lent.give_back();
    }
    Ok(outcome)
}

/// Warns the code that called the package.
fn warn(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = text.trim_start_matches("warning: ").trim_start_matches("note: ");
    let warn = py.import("flotilla._errors")?.getattr("warn")?;
    warn.call1((text, py.get_type::<PyRuntimeWarning>())).map(drop)
}

/// A backend by name, opened when it is needed.
struct Lazy<'a> {
    name: &'a str,
    open: Option<Lent>,
    /// Why it could not be opened.
    error: Option<PyErr>,
}

impl BackendSource for Lazy<'_> {
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
        let Lent { backend, description, .. } = self.open.as_mut().expect("it was opened above");
        Ok((backend, description.clone()))
    }
}
