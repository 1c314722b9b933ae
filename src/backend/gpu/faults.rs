//! Faults that tests inject into a device, to see that the backend notices each of them. Only builds with debug
//! assertions have them.

use std::time::Duration;

/// The faults of a device. By default nothing fails.
#[doc(hidden)]
pub trait Faults: Send + Sync {
    /// Reports whether a submission is dropped although the driver reports it as done. `iterations` is its estimated
    /// work.
    fn drops(&self, _what: &str, _iterations: u64) -> bool {
        false
    }

    /// Returns the bytes to read from a buffer instead of its own, if any.
    fn reads(&self, _buffer: &wgpu::Buffer, _bytes: &[u8]) -> Option<Vec<u8>> {
        None
    }

    /// Reports whether a wait ends without progress.
    fn stalls(&self) -> bool {
        false
    }

    /// Reports whether there is no memory for a buffer.
    fn lacks_memory(&self, _what: &str) -> bool {
        false
    }

    /// Returns how long a submission seems to take, if not as long as it does.
    fn takes(&self, _iterations: u64) -> Option<Duration> {
        None
    }

    /// Returns the text of a shader to compile instead of its own.
    fn edits(&self, text: String) -> String {
        text
    }
}
