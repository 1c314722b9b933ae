//! The clock and blocking waits. No other module uses the system's directly.
//!
//! Native programs use the system's. WebAssembly has neither, so its embedder provides them with `install`. Without a
//! clock, time stands still there. Without a way to park, waiting polls in a loop.

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
        /// Returns the time since a fixed moment, and never less than before.
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

    /// Waits until a future is ready, and parks meanwhile as the host does.
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
