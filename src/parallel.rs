//! Parallel iteration: rayon's, or the same calls on one thread without the feature `parallel`.
//!
//! Results do not depend on the number of threads, because parallel tasks write to disjoint memory.

use std::sync::{Mutex, MutexGuard, PoisonError};

#[cfg(feature = "parallel")]
pub use rayon::{current_num_threads, join, prelude::*, scope};

#[cfg(all(feature = "parallel", not(target_family = "wasm")))]
pub use crate::host::{Threads, start};

#[cfg(not(feature = "parallel"))]
pub use sequential::*;

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

#[cfg(not(feature = "parallel"))]
mod sequential {
    #[cfg(feature = "gpu")]
    use std::slice::Iter;
    use std::slice::{ChunksExact, ChunksExactMut, ChunksMut, IterMut};

    /// Returns the number of threads, 1.
    pub fn current_num_threads() -> usize {
        1
    }

    /// Runs both functions.
    pub(crate) fn join<A, B>(one: impl FnOnce() -> A, other: impl FnOnce() -> B) -> (A, B) {
        (one(), other())
    }

    /// Runs a function that could start tasks in a scope.
    pub(crate) fn scope<R>(run: impl FnOnce(&()) -> R) -> R {
        run(&())
    }

    /// The methods of rayon's slices.
    pub(crate) trait ParallelSlices<T> {
        #[cfg(feature = "gpu")]
        fn par_iter(&self) -> Iter<'_, T>;
        fn par_iter_mut(&mut self) -> IterMut<'_, T>;
        fn par_chunks_mut(&mut self, size: usize) -> ChunksMut<'_, T>;
        fn par_chunks_exact(&self, size: usize) -> ChunksExact<'_, T>;
        fn par_chunks_exact_mut(&mut self, size: usize) -> ChunksExactMut<'_, T>;
        fn par_chunks(&self, size: usize) -> std::slice::Chunks<'_, T>;
    }

    impl<T> ParallelSlices<T> for [T] {
        #[cfg(feature = "gpu")]
        fn par_iter(&self) -> Iter<'_, T> {
            self.iter()
        }

        fn par_iter_mut(&mut self) -> IterMut<'_, T> {
            self.iter_mut()
        }

        fn par_chunks_mut(&mut self, size: usize) -> ChunksMut<'_, T> {
            self.chunks_mut(size)
        }

        fn par_chunks_exact(&self, size: usize) -> ChunksExact<'_, T> {
            self.chunks_exact(size)
        }

        fn par_chunks_exact_mut(&mut self, size: usize) -> ChunksExactMut<'_, T> {
            self.chunks_exact_mut(size)
        }

        fn par_chunks(&self, size: usize) -> std::slice::Chunks<'_, T> {
            self.chunks(size)
        }
    }

    /// The conversion of collections to rayon's iterators.
    pub(crate) trait ParallelItems: IntoIterator + Sized {
        fn into_par_iter(self) -> Self::IntoIter {
            self.into_iter()
        }
    }

    impl<I: IntoIterator> ParallelItems for I {}

    /// The methods of rayon's iterators.
    pub(crate) trait ParallelCut: Iterator + Sized {
        fn with_min_len(self, _: usize) -> Self {
            self
        }

        fn with_max_len(self, _: usize) -> Self {
            self
        }

        fn flat_map_iter<R: IntoIterator>(self, each: impl FnMut(Self::Item) -> R) -> impl Iterator<Item = R::Item> {
            self.flat_map(each)
        }
    }

    impl<I: Iterator> ParallelCut for I {}
}
