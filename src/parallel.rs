//! Parallel iteration: rayon's, or the same calls on one thread without the feature `parallel`.
//!
//! Results do not depend on the number of threads, because parallel tasks write to disjoint memory.

#[cfg(feature = "parallel")]
pub(crate) use rayon::{current_num_threads, join, prelude::*, scope};

#[cfg(not(feature = "parallel"))]
pub(crate) use sequential::*;

#[cfg(not(feature = "parallel"))]
mod sequential {
    use std::slice::{ChunksExact, ChunksExactMut, ChunksMut, Iter, IterMut};

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
        fn par_iter(&self) -> Iter<'_, T>;
        fn par_iter_mut(&mut self) -> IterMut<'_, T>;
        fn par_chunks_mut(&mut self, size: usize) -> ChunksMut<'_, T>;
        fn par_chunks_exact(&self, size: usize) -> ChunksExact<'_, T>;
        fn par_chunks_exact_mut(&mut self, size: usize) -> ChunksExactMut<'_, T>;
        fn par_chunks(&self, size: usize) -> std::slice::Chunks<'_, T>;
    }

    impl<T> ParallelSlices<T> for [T] {
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
