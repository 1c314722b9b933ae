//! Why a GPU could not be opened, or failed.

use super::adapter::{AdapterInfo, is_index};
use crate::backend::gpu::exact::{Pass, ShaderError};

/// Where a person finds out why.
const REASONS: &str = "the page on GPUs (docs/help/gpus.md) has usual reasons";

/// Why a GPU could not be opened, or failed.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// There is no adapter.
    #[error("no GPU adapter found: no Vulkan, Metal or DirectX 12 driver answers; {REASONS}")]
    NoAdapter,
    /// There are only adapters that are not certainly GPUs. They are opened only by name or number.
    #[error("no GPU among the adapters, only {}; {REASONS}", list(.found))]
    NoRealAdapter {
        /// The adapters.
        found: Vec<AdapterInfo>,
    },
    /// No adapter has this name or number.
    #[error("no adapter {} \"{name}\"; found: {}", if is_index(name) { "has the number" } else { "matches" }, list(.found))]
    UnknownAdapter {
        /// The name or number.
        name: String,
        /// The adapters.
        found: Vec<AdapterInfo>,
    },
    /// The driver refuses to open it.
    #[error("{adapter}: cannot be opened: {reason}")]
    Refused {
        /// The adapter, with its driver.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// The device's arithmetic differs from the CPU's under every pass.
    #[error("{adapter}: not bit-exact, so it cannot be used: {}", inexact(.failures))]
    Inexact {
        /// The adapter, with its driver.
        adapter: String,
        /// Per pass, the first difference.
        failures: Vec<(Pass, String)>,
    },
    /// The driver lost the device, and everything on it.
    #[error("{adapter}: the device was lost ({reason})")]
    Lost {
        /// The adapter, with its driver.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// The device has too little memory for a buffer.
    #[error("{adapter}: out of memory for {what}; use a smaller batch")]
    OutOfMemory {
        /// The adapter, with its driver.
        adapter: String,
        /// The use of the buffer.
        what: String,
    },
    /// A buffer or binding exceeds the device's limit.
    #[error("{adapter}: {what} needs {bytes} bytes, the device allows {allowed}; use a smaller batch")]
    TooLarge {
        /// The adapter, with its driver.
        adapter: String,
        /// The use of the buffer.
        what: String,
        /// Bytes needed.
        bytes: u64,
        /// Bytes allowed.
        allowed: u64,
    },
    /// A shader does not compile for the device.
    #[error("shader {label} {source}")]
    Shader {
        /// The shader's name.
        label: String,
        /// The error.
        source: ShaderError,
    },
    /// Any other error of wgpu.
    #[error("{adapter}: {what} failed: {reason}")]
    Failed {
        /// The adapter, with its driver.
        adapter: String,
        /// The operation.
        what: String,
        /// The driver's message.
        reason: String,
    },
}

fn list(found: &[AdapterInfo]) -> String {
    let all: Vec<_> = found.iter().enumerate().map(|(index, info)| format!("{index}: {info}")).collect();
    if all.is_empty() { "none".into() } else { all.join(", ") }
}

fn inexact(failures: &[(Pass, String)]) -> String {
    failures.iter().map(|(pass, failure)| format!("under the {pass} pass, {failure}")).collect::<Vec<_>>().join("; ")
}

/// Formats an error with all its causes.
pub(super) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let inner = error.to_string();
        if !text.contains(&inner) {
            text += &format!(": {inner}");
        }
        cause = error.source();
    }
    text
}
