//! Parallel iteration: rayon's, or the same calls on one thread without the feature `parallel`.
//!
//! Results do not depend on the number of threads, because parallel tasks write to disjoint memory.

#[cfg(feature = "parallel")]
pub(crate) use rayon::{current_num_threads, join, prelude::*, scope};

#[cfg(all(feature = "parallel", not(target_family = "wasm")))]
pub use crate::host::{Threads, start};

#[cfg(not(feature = "parallel"))]
pub(crate) use sequential::*;

/// Work that a thread of its own does, or where none can be started this one.
#[cfg(feature = "record")]
pub(crate) enum Aside<T> {
    Running(std::thread::JoinHandle<T>),
    Done(T),
}

#[cfg(feature = "record")]
impl<T: Send + 'static> Aside<T> {
    /// Starts the work; without another thread, comes back when it is done.
    pub(crate) fn start<W: FnOnce() -> T + Send + 'static>(work: W) -> Aside<T> {
        use std::sync::{Arc, Mutex, PoisonError};
        // A thread that cannot be started takes along what it was given, so it only gets a share.
        let place = Arc::new(Mutex::new(Some(work)));
        let take = |place: &Mutex<Option<W>>| place.lock().unwrap_or_else(PoisonError::into_inner).take();
        let shared = place.clone();
        match std::thread::Builder::new().spawn(move || take(&shared).expect("nobody else takes it")()) {
            Ok(thread) => Aside::Running(thread),
            Err(_) => Aside::Done(take(&place).expect("no thread took it")()),
        }
    }

    /// Whether [`Aside::finish`] comes back at once.
    pub(crate) fn is_finished(&self) -> bool {
        match self {
            Aside::Running(thread) => thread.is_finished(),
            Aside::Done(_) => true,
        }
    }

    /// Waits for the work, whatever comes of it.
    pub(crate) fn end(self) {
        if let Aside::Running(thread) = self {
            let _ = thread.join();
        }
    }

    /// Waits for the work, and returns its result.
    pub(crate) fn finish(self) -> T {
        match self {
            Aside::Running(thread) => thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
            Aside::Done(result) => result,
        }
    }
}

#[cfg(not(feature = "parallel"))]
mod sequential {
    #[cfg(feature = "gpu")]
    use std::slice::Iter;
    use std::slice::{ChunksExact, ChunksExactMut, ChunksMut, IterMut};

    /// Returns the number of threads, 1.
    pub(crate) fn current_num_threads() -> usize {
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
