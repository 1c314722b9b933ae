//! Keeps backends open between calls, and starts threads, also in forked processes.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError, TryLockError};
use std::time::Duration;

use flotilla::backend::OpenBackend;
use flotilla::front::{self, Processor};
use flotilla::parallel;
use flotilla_app::choice::{self, Chosen, Work, WorkTotal};
use pyo3::exceptions::{PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;

use crate::errors::Raise;

/// Open backends that are not in use, by requested name. Opening a GPU takes longer than many rollouts.
static IDLE: Mutex<Vec<(String, OpenBackend)>> = Mutex::new(Vec::new());
/// The work that "auto" was asked to play in this process.
static WORK: Mutex<WorkTotal> = Mutex::new(WorkTotal::new());
/// Maximum number of idle backends.
const MAX_IDLE_BACKENDS: usize = 4;
/// Minimum time between checks for Ctrl-C.
pub const PATIENCE: Duration = Duration::from_millis(50);
/// Whether this process was forked. Threads of its parent do not exist in it.
static FORKED: AtomicBool = AtomicBool::new(false);

/// The threads of a forked process.
static POOL: Mutex<Option<&'static rayon::ThreadPool>> = Mutex::new(None);

/// Marks this process as forked: it must not use its parent's threads and devices.
#[pyfunction]
pub fn forked() {
    FORKED.store(true, Relaxed);
    if let Ok(mut pool) = POOL.try_lock() {
        // These threads, too, belong to the parent.
        *pool = None;
    }
    if let Ok(mut idle) = IDLE.try_lock() {
        // These backends belong to the parent, so they must not be dropped here.
        std::mem::forget(std::mem::take(&mut *idle));
    }
}

/// Runs `work` with as many threads as the system allows.
///
/// A forked process does not have its parent's threads. Its first calling thread becomes part of a new pool, in which
/// all other threads work, too.
fn with_threads<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    if !FORKED.load(Relaxed) {
        parallel::start(None);
        return work();
    }
    let pool = {
        let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
        if pool.is_none() && rayon::current_thread_index().is_none() {
            // The calling thread is idle between its calls, so there has to be one more for the others.
            let threads = std::thread::available_parallelism().map_or(2, |threads| threads.get().max(2));
            let builder = rayon::ThreadPoolBuilder::new().num_threads(wanted_threads(threads)).use_current_thread();
            *pool = builder.build().ok().map(|pool| &*Box::leak(Box::new(pool)));
        }
        *pool
    };
    match pool {
        Some(pool) if rayon::current_thread_index().is_none() => pool.install(work),
        _ => work(),
    }
}

/// Returns the number of threads that `RAYON_NUM_THREADS` asks for, at least 2, or else the given one.
fn wanted_threads(otherwise: usize) -> usize {
    let wanted = std::env::var("RAYON_NUM_THREADS").ok().and_then(|text| text.parse().ok());
    wanted.filter(|&threads: &usize| threads > 0).map_or(otherwise, |threads| threads.max(2))
}

/// Returns the number of threads that play.
#[pyfunction]
pub fn threads(py: Python<'_>) -> usize {
    aside(py, rayon::current_num_threads)
}

/// Returns what a Python object holds, or an error with this message if another thread uses it. Waiting would hide that
/// two threads share the object.
pub fn locked<'a, T>(inner: &'a Mutex<T>, shared: &'static str) -> PyResult<MutexGuard<'a, T>> {
    match inner.try_lock() {
        Ok(inner) => Ok(inner),
        Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
        Err(TryLockError::WouldBlock) => Err(PyValueError::new_err(shared)),
    }
}

/// Runs `work` without the interpreter's lock.
pub fn aside<R: Send>(py: Python<'_>, work: impl FnOnce() -> R + Send) -> R {
    py.detach(|| with_threads(work))
}

/// Plays `work` on a backend, without the interpreter's lock.
///
/// `backend` is "auto", "cpu", "gpu", or an adapter's number or part of its name. With "auto", the work decides.
pub fn play<R: Send>(
    py: Python<'_>,
    backend: &str,
    work: Work,
    play: impl FnOnce(&mut OpenBackend) -> PyResult<R> + Send,
) -> PyResult<R> {
    aside(py, || {
        let mut lent = Lent::open(backend, work)?;
        let done = play(&mut lent.backend)?;
        lent.give_back();
        Ok(done)
    })
}

/// A backend in use.
pub struct Lent {
    name: String,
    /// The open backend.
    pub backend: OpenBackend,
    /// The backend for people, with the reason if nobody asked for it.
    pub description: String,
}

impl Lent {
    /// Takes an idle backend, or opens one.
    pub fn open(name: &str, work: Work) -> PyResult<Lent> {
        if name == "auto" {
            return Lent::choose(work);
        }
        let backend = match take(name) {
            Some(backend) => backend,
            None => find(name, None)?.0.unwrap_or_else(front::cpu),
        };
        Ok(Lent::of(name, backend, None))
    }

    fn of(name: &str, backend: OpenBackend, reason: Option<String>) -> Lent {
        let reason = reason.map_or(String::new(), |reason| format!(" [auto: {reason}]"));
        let description = format!("{}{reason}", backend.0.describe());
        Lent { name: name.into(), backend, description }
    }

    /// Takes or opens the backend that is expected to finish first. An idle backend "auto" is a GPU.
    fn choose(work: Work) -> PyResult<Lent> {
        let work = WORK.lock().unwrap_or_else(PoisonError::into_inner).add(work);
        if let Some(backend) = take("auto") {
            return Ok(Lent::of("auto", backend, None));
        }
        let cpu = || take("cpu").unwrap_or_else(front::cpu);
        let Some(work) = work else { return Ok(Lent::of("cpu", cpu(), None)) };
        Ok(match find("auto", Some(work))? {
            (Some(backend), reason) => Lent::of("auto", backend, reason),
            (None, reason) => Lent::of("cpu", cpu(), reason),
        })
    }

    /// Keeps the backend for the next call. Call this only if the backend did not fail.
    pub fn give_back(self) {
        // Training that lost its GPU has continued on the CPU.
        let is_other = self.name != "cpu" && self.backend.1.backend == "cpu";
        if !is_other
            && let Ok(mut idle) = IDLE.try_lock()
            && idle.len() < MAX_IDLE_BACKENDS
        {
            idle.push((self.name, self.backend));
        }
    }
}

fn take(backend: &str) -> Option<OpenBackend> {
    let mut idle = IDLE.try_lock().ok()?;
    let place = idle.iter().position(|(name, _)| name == backend)?;
    Some(idle.swap_remove(place).1)
}

/// Opens the GPU that a name stands for, if any, and returns why it was chosen or not. Some work decides about "auto".
fn find(backend: &str, work: Option<Work>) -> PyResult<(Option<OpenBackend>, Option<String>)> {
    let processor = match backend {
        "auto" => Processor::Auto,
        "cpu" => Processor::Cpu,
        "gpu" => Processor::Gpu,
        name => Processor::Adapter(name.into()),
    };
    let Chosen { gpu, reason, passed_over } = choice::find(&processor, None, work).raise()?;
    if let Some(text) = passed_over.map(|error| format!("no GPU is used: {error}")) {
        let text = std::ffi::CString::new(text.replace('\0', " ")).unwrap_or_default();
        Python::attach(|py| PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 2))?;
    }
    Ok((gpu.map(front::on_gpu), reason.map(String::from)))
}
