//! The program itself, and what it can play on.

use std::ffi::OsString;

use flotilla::backend::gpu::device;
use flotilla::cli;
use pyo3::prelude::*;

use crate::workers;

/// Does what was typed, the program's name first; gives the exit code.
#[pyfunction]
pub fn main(py: Python<'_>, words: Vec<OsString>) -> u8 {
    // It starts its own threads, as many as the command says.
    py.detach(|| cli::main(Some(words)))
}

/// Adapters that a driver offers: name, driver, interface, kind.
#[pyfunction]
pub fn adapters(py: Python<'_>) -> Vec<(String, String, String, String)> {
    let found = workers::aside(py, device::adapters);
    found.into_iter().map(|info| (info.name, info.driver, info.backend.to_string(), info.kind.to_string())).collect()
}
