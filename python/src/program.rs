//! The command-line program, and the adapters it can use.

use std::ffi::OsString;

use flotilla::backend::gpu::device;
use flotilla::cli;
use pyo3::prelude::*;

use crate::workers;

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
