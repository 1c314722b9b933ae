//! Parallel iteration with rayon, which uses the calling thread alone where there are no others, as on WebAssembly.
//!
//! Results do not depend on the number of threads, because parallel tasks write to disjoint memory.

use std::sync::{Mutex, MutexGuard, PoisonError};

pub use rayon::{current_num_threads, join, prelude::*, scope};

#[cfg(not(target_family = "wasm"))]
pub use crate::host::{Threads, start, start_with_caller};

/// Locks a mutex, also after another thread panicked while it held the lock.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Work on a thread of its own. If no thread can be started, [`BackgroundTask::start`] does the work itself.
pub enum BackgroundTask<T> {
    Running(std::thread::JoinHandle<T>),
    Done(T),
}

impl<T: Send + 'static> BackgroundTask<T> {
    /// Starts the work on another thread. If none can be started, returns after the work is done.
    pub fn start<W: FnOnce() -> T + Send + 'static>(work: W) -> BackgroundTask<T> {
        // A thread that fails to start drops its closure, and `work` with it. So the closure only shares `work`.
        let shared = std::sync::Arc::new(Mutex::new(Some(work)));
        let of_thread = shared.clone();
        let run = move || (lock(&of_thread).take().expect("only one thread takes it"))();
        match std::thread::Builder::new().spawn(run) {
            Ok(thread) => BackgroundTask::Running(thread),
            Err(_) => {
                let work = lock(&shared).take().expect("no thread took it");
                BackgroundTask::Done(work())
            }
        }
    }

    /// Reports whether [`BackgroundTask::finish`] returns without waiting.
    pub fn is_finished(&self) -> bool {
        match self {
            BackgroundTask::Running(thread) => thread.is_finished(),
            BackgroundTask::Done(_) => true,
        }
    }

    /// Waits for the work, and ignores its result and whether it panicked.
    pub fn end(self) {
        if let BackgroundTask::Running(thread) = self {
            let _ = thread.join();
        }
    }

    /// Waits for the work, and returns its result.
    pub fn finish(self) -> T {
        match self {
            BackgroundTask::Running(thread) => thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
            BackgroundTask::Done(result) => result,
        }
    }
}
