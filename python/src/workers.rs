//! Keeps backends open between calls, and starts threads, also in forked processes.

use std::cell::Cell;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use flotilla::backend::OpenBackend;
use flotilla::front::{self, Processor};
use flotilla::parallel;
use pyo3::exceptions::PyRuntimeWarning;
use pyo3::prelude::*;

use crate::errors::Raise;

/// Open backends that are not in use, by requested name. Opening a GPU takes longer than many rollouts.
static IDLE: Mutex<Vec<(String, OpenBackend)>> = Mutex::new(Vec::new());
/// Maximum number of idle backends.
const MOST: usize = 4;
/// Whether this process was forked. Threads of its parent do not exist in it.
static FORKED: AtomicBool = AtomicBool::new(false);

thread_local! { static HAS_THREADS: Cell<bool> = const { Cell::new(false) }; }

/// Marks this process as forked: it must not use its parent's threads and devices.
#[pyfunction]
pub fn forked() {
    FORKED.store(true, Relaxed);
    if let Ok(mut idle) = IDLE.try_lock() {
        // These backends belong to the parent, so they must not be dropped here.
        std::mem::forget(std::mem::take(&mut *idle));
    }
}

/// Starts as many threads as the system allows.
///
/// In a forked process, each calling thread gets its own workers, because those of the parent would never answer.
fn gain_threads() {
    if !FORKED.load(Relaxed) {
        parallel::start(None);
    } else if !HAS_THREADS.replace(true) {
        // This fails if the thread already belongs to a pool, which is fine.
        std::mem::forget(rayon::ThreadPoolBuilder::new().use_current_thread().build());
    }
}

/// Runs `work` without the interpreter's lock.
pub fn aside<R: Send>(py: Python<'_>, work: impl FnOnce() -> R + Send) -> R {
    py.detach(|| {
        gain_threads();
        work()
    })
}

/// Runs `work` on a backend, without the interpreter's lock.
///
/// `backend` is "auto", "cpu", "gpu", or an adapter's number or part of its name.
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
