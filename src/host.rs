//! What flotilla takes from where it runs: the time, and a way to wait. Nothing else in the crate asks for either.
//!
//! Native programs have both from the system. WebAssembly has neither: there, whoever embeds the crate `install`s
//! them. Without a clock, time stands still there; without a way to park, waiting asks again and again.

#[cfg(not(target_family = "wasm"))]
mod native {
    use std::time::{Duration, SystemTime, UNIX_EPOCH};

    pub use std::time::Instant;

    /// Time since the start of 1970 by the system's clock.
    pub fn since_1970() -> Duration {
        SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
    }

    /// Lets this thread wait until a future is there. What a GPU has promised comes while its device is polled.
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

    /// What an embedder offers.
    pub struct Host {
        /// Time since some moment, never less than before.
        pub now: fn() -> Duration,
        /// Time since the start of 1970.
        pub since_1970: fn() -> Duration,
        /// Lets others run (a browser: its event loop) until `wake` was called since the last time this came back.
        pub park: fn(),
        /// Ends the waiting of `park`; called from callbacks.
        pub wake: fn(),
    }

    static HOST: OnceLock<Host> = OnceLock::new();

    /// Takes what an embedder offers, once; false where there is a host already.
    pub fn install(host: Host) -> bool {
        HOST.set(host).is_ok()
    }

    /// Time since the start of 1970.
    pub fn since_1970() -> Duration {
        HOST.get().map_or(Duration::ZERO, |host| (host.since_1970)())
    }

    /// A moment, as [`std::time::Instant`], which is not to be had here.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
    pub struct Instant(Duration);

    impl Instant {
        /// This moment; the same one again and again where no host is installed.
        pub fn now() -> Instant {
            Instant(HOST.get().map_or(Duration::ZERO, |host| (host.now)()))
        }

        /// Time since this moment.
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

    /// Waits until a future is there, parked wherever the host parks.
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
