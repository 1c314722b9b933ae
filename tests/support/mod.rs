//! What tests of the GPU backend share.

use std::io::Write;

use flotilla::backend::gpu::device::{self, AdapterInfo, Request, Wanted};

/// Every adapter, each with the request that opens it.
///
/// Without any, the test is skipped in plain sight, or fails where `FLOTILLA_REQUIRE_GPU=1` says that a GPU is needed.
pub fn adapters(test: &str) -> Vec<(Request, AdapterInfo)> {
    let found = device::adapters();
    if found.is_empty() {
        let set = |name: &str| std::env::var(name).map_or(format!("{name} not set"), |value| format!("{name}={value}"));
        let reason = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "WGPU_BACKEND"].map(set).join(", ");
        let message = format!("{test}: skipped: no GPU adapter found ({reason})");
        assert!(std::env::var("FLOTILLA_REQUIRE_GPU").as_deref() != Ok("1"), "{message}, but one is required");
        // Straight to the stream: what a passing test prints by macro is not shown.
        writeln!(std::io::stderr(), "\n{message}").expect("standard error takes a line");
    }
    let request = |index: usize| Request::from(Wanted::Named(index.to_string()));
    found.into_iter().enumerate().map(|(index, info)| (request(index), info)).collect()
}
