//! Helpers for tests on GPUs.
#![allow(dead_code, reason = "no test program uses all helpers")]

use flotilla::backend::gpu::device::{self, AdapterChoice, AdapterInfo, Request};

/// Returns whether an edit changes at least one shader, so that a renamed variable is noticed without a GPU.
pub fn edits_a_shader(edit: fn(String) -> String) -> bool {
    flotilla::backend::gpu::shaders().into_iter().any(|(_, text)| edit(text.clone()) != text)
}

/// Returns every adapter, each with the request that opens it.
///
/// If there is none, prints that the test was skipped. With `FLOTILLA_REQUIRE_GPU=1`, panics instead.
pub fn adapters(test: &str) -> Vec<(Request, AdapterInfo)> {
    let found = device::adapters();
    if found.is_empty() {
        let set = |name: &str| std::env::var(name).map_or(format!("{name} not set"), |value| format!("{name}={value}"));
        let reason = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "WGPU_BACKEND"].map(set).join(", ");
        let reason = format!("no GPU adapter found ({reason})");
        assert!(std::env::var("FLOTILLA_REQUIRE_GPU").as_deref() != Ok("1"), "{test}: {reason}, but one is required");
        crate::support::skip(test, &reason);
    }
    let request = |index: usize| Request::from(AdapterChoice::Named(index.to_string()));
    found.into_iter().enumerate().map(|(index, info)| (request(index), info)).collect()
}
