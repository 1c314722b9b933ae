//! What episodes are played on, kept from call to call, and the threads of processes that were forked.

use std::cell::Cell;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use flotilla::backend::OpenBackend;
use flotilla::front::{self, Processor};
use flotilla::parallel;
use pyo3::exceptions::PyRuntimeWarning;
use pyo3::prelude::*;

use crate::errors::Raise;

/// Backends that nobody plays on, each with what it was asked for by: opening a GPU takes longer than many a rollout.
static IDLE: Mutex<Vec<(String, OpenBackend)>> = Mutex::new(Vec::new());
/// Most of them.
const MOST: usize = 4;
/// Whether this process is the copy of one that may have had threads, which are not copied.
static FORKED: AtomicBool = AtomicBool::new(false);

thread_local! { static HAS_THREADS: Cell<bool> = const { Cell::new(false) }; }

/// Tells a forked process that its threads and devices are its parent's.
#[pyfunction]
pub fn forked() {
    FORKED.store(true, Relaxed);
    if let Ok(mut idle) = IDLE.try_lock() {
        // What they would give back is not this process's.
        std::mem::forget(std::mem::take(&mut *idle));
    }
}

/// Starts as many threads as the system allows. A thread of a forked process gets workers of its own: those of the parent
/// would never answer.
fn gain_threads() {
    if !FORKED.load(Relaxed) {
        parallel::start(None);
    } else if !HAS_THREADS.replace(true) {
        // Where that fails, the thread has some.
        std::mem::forget(rayon::ThreadPoolBuilder::new().use_current_thread().build());
    }
}

/// Does something without holding the interpreter.
pub fn aside<R: Send>(py: Python<'_>, work: impl FnOnce() -> R + Send) -> R {
    py.detach(|| {
        gain_threads();
        work()
    })
}

/// Plays on a backend without holding the interpreter: "auto", "cpu", "gpu", or the number or a part of the name of an
/// adapter.
pub fn play<R: Send>(
    py: Python<'_>,
    backend: &str,
    work: impl FnOnce(&mut OpenBackend) -> PyResult<R> + Send,
) -> PyResult<R> {
    aside(py, || {
        let mut player = match take(backend) {
            Some(player) => player,
            None => open(backend)?,
        };
        let done = work(&mut player);
        if done.is_ok()
            && let Ok(mut idle) = IDLE.try_lock()
            && idle.len() < MOST
        {
            idle.push((backend.into(), player));
        }
        done
    })
}

fn take(backend: &str) -> Option<OpenBackend> {
    let mut idle = IDLE.try_lock().ok()?;
    let place = idle.iter().position(|(name, _)| name == backend)?;
    Some(idle.swap_remove(place).1)
}

fn open(backend: &str) -> PyResult<OpenBackend> {
    let processor = match backend {
        "auto" => Processor::Auto,
        "cpu" => Processor::Cpu,
        "gpu" => Processor::Gpu,
        name => Processor::Adapter(name.into()),
    };
    let (player, passed_over) = front::open(&processor).raise()?;
    if let Some(error) = passed_over {
        let text = format!("no GPU is used: {error}").replace('\0', " ");
        let text = std::ffi::CString::new(text).unwrap_or_default();
        Python::attach(|py| PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 2))?;
    }
    Ok(player)
}
