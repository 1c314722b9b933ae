//! The clock, blocking waits, threads, large pages and the cache. Only this module asks the system for them.
//!
//! WebAssembly has no clock and cannot block, so its embedder provides both with `install`. Without that, time stands
//! still, and waiting polls in a loop.

/// Asks the processor to load numbers into its cache, without waiting for them. A no-op except on x86-64.
#[inline(always)]
pub(crate) fn prefetch(numbers: &[f32]) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        const LINE: usize = 64 / size_of::<f32>();
        // The last number may be in one more line.
        numbers.chunks(LINE).filter_map(<[f32]>::first).chain(numbers.last()).for_each(|number| {
            #[expect(unsafe_code, reason = "a hint, which reads nothing")]
            unsafe {
                _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(number).cast());
            }
        });
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = numbers;
}

/// Returns zeros, in large pages of memory where the system offers them. Parents are in random places of a population, so
/// that with small pages most reads would have to look up the address of their page, too.
pub(crate) fn zeros(count: usize) -> Vec<f32> {
    let numbers = vec![0.0f32; count];
    #[cfg(target_os = "linux")]
    {
        const PAGE: usize = 2 << 20;
        let (first, bytes) = (numbers.as_ptr().cast_mut(), size_of_val(&numbers[..]));
        let before = first.align_offset(PAGE) * size_of::<f32>();
        if let Some(whole) = bytes.checked_sub(before).map(|bytes| bytes / PAGE * PAGE).filter(|&bytes| bytes > 0) {
            let advice = rustix::mm::Advice::LinuxHugepage;
            #[expect(unsafe_code, reason = "a hint about whole pages of this array, which changes no contents")]
            // Without large pages, the array works as well.
            let _ = unsafe { rustix::mm::madvise(first.wrapping_byte_add(before).cast(), whole, advice) };
        }
    }
    numbers
}

#[cfg(not(target_family = "wasm"))]
mod native {
    use std::time::{Duration, SystemTime, UNIX_EPOCH};

    pub use std::time::Instant;

    /// Returns the time since the start of 1970.
    pub fn since_1970() -> Duration {
        SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
    }

    /// Blocks this thread until a future is ready. Results of a GPU become ready while its device is polled.
    #[cfg(feature = "gpu")]
    pub fn wait<F: Future>(future: F) -> F::Output {
        pollster::block_on(future)
    }
}

#[cfg(not(target_family = "wasm"))]
pub use native::*;

#[cfg(target_family = "wasm")]
mod embedded {
    use std::ops::Sub;
    use std::sync::OnceLock;
    use std::time::Duration;

    /// The functions of an embedder.
    pub struct Host {
        /// Returns the time since a fixed moment. It never decreases.
        pub now: fn() -> Duration,
        /// Returns the time since the start of 1970.
        pub since_1970: fn() -> Duration,
        /// Yields, for example to the event loop of a browser, until `wake` is called after the previous return.
        pub park: fn(),
        /// Lets `park` return. Callbacks call this.
        pub wake: fn(),
    }

    static HOST: OnceLock<Host> = OnceLock::new();

    /// Installs the functions of the embedder. Returns false if some are installed already.
    pub fn install(host: Host) -> bool {
        HOST.set(host).is_ok()
    }

    /// Returns the time since the start of 1970.
    pub fn since_1970() -> Duration {
        HOST.get().map_or(Duration::ZERO, |host| (host.since_1970)())
    }

    /// A moment. [`std::time::Instant`] is not available on this platform.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
    pub struct Instant(Duration);

    impl Instant {
        /// Returns the current moment, or always the same one if no host is installed.
        pub fn now() -> Instant {
            Instant(HOST.get().map_or(Duration::ZERO, |host| (host.now)()))
        }

        /// Returns the time since this moment.
        pub fn elapsed(self) -> Duration {
            Instant::now() - self
        }
    }

    impl Sub for Instant {
        type Output = Duration;

        fn sub(self, earlier: Instant) -> Duration {
            self.0.saturating_sub(earlier.0)
        }
    }

    /// Blocks until a future is ready, using the embedder's `park`.
    #[cfg(feature = "gpu")]
    pub fn wait<F: Future>(future: F) -> F::Output {
        use std::sync::Arc;
        use std::task::{Context, Poll, Wake};

        struct Bell;
        impl Wake for Bell {
            fn wake(self: Arc<Bell>) {
                HOST.get().inspect(|host| (host.wake)());
            }
        }
        let mut future = std::pin::pin!(future);
        let waker = Arc::new(Bell).into();
        loop {
            match future.as_mut().poll(&mut Context::from_waker(&waker)) {
                Poll::Ready(output) => return output,
                Poll::Pending => drop(HOST.get().inspect(|host| (host.park)())),
            }
        }
    }
}

#[cfg(target_family = "wasm")]
pub use embedded::*;

#[cfg(not(target_family = "wasm"))]
pub use threads::MAX_THREADS;
#[cfg(not(target_family = "wasm"))]
pub use threads::{Threads, start, start_with_caller};

/// Starts the threads that rayon shares work between, as many as the system allows.
#[cfg(not(target_family = "wasm"))]
mod threads {
    use std::fmt::{self, Display};
    use std::sync::{OnceLock, mpsc};
    use std::{io, thread};

    /// The threads that a process asked for and has.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Threads {
        /// The number that was asked for.
        pub wanted: usize,
        /// The number that could be started. If it is 0, the thread that asked does all work.
        pub started: usize,
    }

    impl Threads {
        /// Reports whether there are fewer threads than were asked for.
        pub fn is_short(&self) -> bool {
            self.started < self.wanted
        }
    }

    impl Display for Threads {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            let Threads { wanted, started } = self;
            write!(
                f,
                "only {started} of {wanted} threads could be started, so this takes longer: the system allows no more \
                 threads or memory here; see `ulimit -u` and `ulimit -v`"
            )
        }
    }

    /// Starts the threads of this process. The default is `RAYON_NUM_THREADS`, or else one per core. Only the first
    /// call does anything; later calls return what it returned.
    ///
    /// If rayon fails to start a thread, it cannot be set up again. So this starts the threads first, and rayon gets
    /// those that could be started.
    pub fn start(threads: Option<usize>) -> Threads {
        start_once(threads, false)
    }

    /// Starts the threads of this process like [`start`], but the calling thread is one of them. It then wakes no other
    /// for a small piece of work. It must never wait, as with `JoinHandle::join`, for another thread's parallel work:
    /// if it is the only one of these threads, both wait forever.
    pub fn start_with_caller(threads: Option<usize>) -> Threads {
        start_once(threads, true)
    }

    fn start_once(threads: Option<usize>, with_caller: bool) -> Threads {
        static STARTED: OnceLock<Threads> = OnceLock::new();
        let threads = || threads.unwrap_or_else(|| usual(std::env::var("RAYON_NUM_THREADS").ok()));
        *STARTED.get_or_init(|| start_now(threads(), with_caller))
    }

    /// Maximum number of threads. More would spend their time waiting for each other.
    pub const MAX_THREADS: usize = 1024;

    /// Returns how many threads rayon would start, given the value of `RAYON_NUM_THREADS`, but at most [`MAX_THREADS`].
    fn usual(set: Option<String>) -> usize {
        let set = set.and_then(|text| text.parse().ok()).filter(|&threads| threads > 0);
        set.unwrap_or_else(|| thread::available_parallelism().map_or(1, usize::from)).min(MAX_THREADS)
    }

    type Worker = mpsc::Sender<rayon::ThreadBuilder>;

    /// Starts a thread that waits to become one of rayon's.
    fn spawn() -> io::Result<Worker> {
        let (sender, receiver) = mpsc::channel::<rayon::ThreadBuilder>();
        thread::Builder::new().spawn(move || receiver.recv().map(rayon::ThreadBuilder::run))?;
        Ok(sender)
    }

    /// Starts threads until there are enough or one cannot be started.
    fn workers(wanted: usize, mut spawn: impl FnMut() -> io::Result<Worker>) -> Vec<Worker> {
        (0..wanted).map_while(|_| spawn().ok()).collect()
    }

    /// Returns a function that turns one waiting thread at a time into a thread of rayon's pool.
    fn hand_over(workers: Vec<Worker>) -> impl FnMut(rayon::ThreadBuilder) -> io::Result<()> {
        let mut workers = workers.into_iter();
        move |thread| {
            let gone = || io::Error::other("no thread is left");
            let worker = workers.next().ok_or_else(gone)?;
            worker.send(thread).map_err(|_| gone())
        }
    }

    fn start_now(wanted: usize, with_caller: bool) -> Threads {
        let workers = workers(wanted.saturating_sub(usize::from(with_caller)), spawn);
        let started = workers.len() + usize::from(with_caller);
        let plays = with_caller || workers.is_empty();
        let builder = rayon::ThreadPoolBuilder::new().num_threads(started.max(1)).spawn_handler(hand_over(workers));
        let built = if plays { builder.use_current_thread().build_global() } else { builder.build_global() };
        match built {
            Ok(()) => Threads { wanted, started },
            // The process has already started a pool.
            Err(_) => Threads { wanted: rayon::current_num_threads(), started: rayon::current_num_threads() },
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn the_environment_cannot_ask_for_more_threads_than_the_flag() {
            let asked = |text: &str| usual(Some(text.into()));
            assert_eq!((asked("7"), asked("1024"), asked("3000")), (7, MAX_THREADS, MAX_THREADS));
            assert_eq!(asked("0"), usual(None));
        }

        #[test]
        fn as_many_threads_are_started_as_the_system_allows() {
            let mut left = 2;
            let limited = || match left {
                0 => Err(io::ErrorKind::WouldBlock.into()),
                _ => {
                    left -= 1;
                    spawn()
                }
            };
            let workers = workers(5, limited);
            assert_eq!(workers.len(), 2);
            let pool =
                rayon::ThreadPoolBuilder::new().num_threads(2).spawn_handler(hand_over(workers)).build().unwrap();
            assert_eq!(pool.current_num_threads(), 2);
            assert_eq!(pool.join(|| 1, || 2), (1, 2));
            let threads = Threads { wanted: 5, started: 2 };
            assert!(threads.is_short() && threads.to_string().contains("only 2 of 5 threads"));
        }
    }
}
